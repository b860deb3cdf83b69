"""The arm: model, kinematics, dynamics and control points."""

from rmp_mjx.robot.errors import RobotError as RobotError
from rmp_mjx.robot.errors import RobotWarning as RobotWarning
from rmp_mjx.robot.library import robots as robots
from rmp_mjx.robot.model import Robot as Robot

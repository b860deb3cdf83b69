"""The arm: model, kinematics, dynamics and control points."""

from rmp_mjx.robot.model import Robot as Robot
from rmp_mjx.robot.model import RobotError as RobotError

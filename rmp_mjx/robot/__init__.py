"""The arm: model, kinematics, dynamics and control points."""

from rmp_mjx.robot.mjcf import RobotError as RobotError
from rmp_mjx.robot.model import Robot as Robot

"""Leaves: the behaviours at the ends of an RMP-tree."""

from rmp_mjx.rmp.leaves.attractor import OrientationAttractor as OrientationAttractor
from rmp_mjx.rmp.leaves.attractor import PositionAttractor as PositionAttractor
from rmp_mjx.rmp.leaves.attractor import orientation_attractor as orientation_attractor
from rmp_mjx.rmp.leaves.barrier import Barrier as Barrier
from rmp_mjx.rmp.leaves.collision import PaperCollision as PaperCollision
from rmp_mjx.rmp.leaves.collision import collision_near as collision_near
from rmp_mjx.rmp.leaves.collision import collision_transit as collision_transit
from rmp_mjx.rmp.leaves.joint_limit import JointLimitBarrier as JointLimitBarrier
from rmp_mjx.rmp.leaves.joint_limit import RMPflowJointLimit as RMPflowJointLimit
from rmp_mjx.rmp.leaves.joint_limit import joint_limit_barrier as joint_limit_barrier
from rmp_mjx.rmp.leaves.posture import Posture as Posture
from rmp_mjx.rmp.leaves.posture import soft_posture as soft_posture

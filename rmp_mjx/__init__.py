"""Safe, contact-rich manipulation: an RMP-tree with a learned impedance target."""

from rmp_mjx.control import ACTION_SIZE as ACTION_SIZE
from rmp_mjx.control import RMPVICES as RMPVICES
from rmp_mjx.control import VICES as VICES
from rmp_mjx.control import ActionRange as ActionRange
from rmp_mjx.control import ContactObserver as ContactObserver
from rmp_mjx.control import Controller as Controller
from rmp_mjx.control import Leaves as Leaves
from rmp_mjx.control import OrientationRelaxation as OrientationRelaxation
from rmp_mjx.control import SetpointDither as SetpointDither
from rmp_mjx.control import StopGuard as StopGuard
from rmp_mjx.control import WeightedActionRange as WeightedActionRange
from rmp_mjx.control import per_link as per_link
from rmp_mjx.control import rmp_vices_literal as rmp_vices_literal
from rmp_mjx.obstacles import Obstacles as Obstacles
from rmp_mjx.rmp import RMP as RMP
from rmp_mjx.rmp import Leaf as Leaf
from rmp_mjx.rmp import Node as Node
from rmp_mjx.rmp import ScalarLeaf as ScalarLeaf
from rmp_mjx.rmp import Siblings as Siblings
from rmp_mjx.rmp import TaskMap as TaskMap
from rmp_mjx.rmp import evaluate as evaluate
from rmp_mjx.rmp import pullback as pullback
from rmp_mjx.rmp import pushforward as pushforward
from rmp_mjx.rmp import resolve as resolve
from rmp_mjx.robot import Robot as Robot
from rmp_mjx.robot import RobotError as RobotError
from rmp_mjx.robot import RobotWarning as RobotWarning
from rmp_mjx.robot import robots as robots
from rmp_mjx.types import Action as Action
from rmp_mjx.types import ControlOutput as ControlOutput
from rmp_mjx.types import LeafWeights as LeafWeights
from rmp_mjx.types import Setpoint as Setpoint

__version__ = "0.2.0"

"""Controllers: from a policy's action to joint torques."""

from rmp_mjx.control.action import ACTION_SIZE as ACTION_SIZE
from rmp_mjx.control.action import ActionRange as ActionRange
from rmp_mjx.control.action import WeightedActionRange as WeightedActionRange
from rmp_mjx.control.avoidance import per_link as per_link
from rmp_mjx.control.controller import Controller as Controller
from rmp_mjx.control.dither import SetpointDither as SetpointDither
from rmp_mjx.control.guard import StopGuard as StopGuard
from rmp_mjx.control.leaves import Leaves as Leaves
from rmp_mjx.control.literal import rmp_vices_literal as rmp_vices_literal
from rmp_mjx.control.observer import ContactObserver as ContactObserver
from rmp_mjx.control.relaxation import OrientationRelaxation as OrientationRelaxation
from rmp_mjx.control.rmp_vices import RMPVICES as RMPVICES
from rmp_mjx.control.vices import VICES as VICES

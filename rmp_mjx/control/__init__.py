"""Controllers: from a policy's action to joint torques."""

from rmp_mjx.control.action import ACTION_SIZE as ACTION_SIZE
from rmp_mjx.control.action import ActionRange as ActionRange
from rmp_mjx.control.rmp_vices import RMPVICES as RMPVICES
from rmp_mjx.control.vices import VICES as VICES

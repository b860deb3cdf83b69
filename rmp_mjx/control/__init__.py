"""Controllers: from a policy's action to joint torques."""

from rmp_mjx.control.action import ACTION_SIZE as ACTION_SIZE
from rmp_mjx.control.action import ActionRange as ActionRange
from rmp_mjx.control.avoidance import per_link as per_link
from rmp_mjx.control.literal import rmp_vices_literal as rmp_vices_literal
from rmp_mjx.control.rmp_vices import RMPVICES as RMPVICES
from rmp_mjx.control.stirring import Stirring as Stirring
from rmp_mjx.control.vices import VICES as VICES
from rmp_mjx.control.yielding import Yielding as Yielding

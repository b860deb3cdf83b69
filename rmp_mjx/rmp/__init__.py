"""RMP algebra, task maps, leaves and trees: pure functions of arrays."""

from rmp_mjx.rmp.algebra import RMP as RMP
from rmp_mjx.rmp.algebra import pullback as pullback
from rmp_mjx.rmp.algebra import resolve as resolve
from rmp_mjx.rmp.leaf import Leaf as Leaf
from rmp_mjx.rmp.leaf import ScalarLeaf as ScalarLeaf
from rmp_mjx.rmp.taskmap import NodeState as NodeState
from rmp_mjx.rmp.taskmap import TaskMap as TaskMap
from rmp_mjx.rmp.taskmap import identity_map as identity_map
from rmp_mjx.rmp.taskmap import pushforward as pushforward
from rmp_mjx.rmp.tree import Node as Node
from rmp_mjx.rmp.tree import Siblings as Siblings
from rmp_mjx.rmp.tree import evaluate as evaluate

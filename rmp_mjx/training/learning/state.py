"""What training carries from one iteration to the next."""

from brax.training.acme import running_statistics
from jaxtyping import Array, Int, PRNGKeyArray

from rmp_mjx.pytree import Pytree
from rmp_mjx.training.learning.learner import Learner
from rmp_mjx.training.learning.rollout import RolloutState
from rmp_mjx.training.learning.value_scale import ValueScale


class TrainState(Pytree):
    """Everything that training carries from one iteration to the next."""

    learner: Learner
    """Networks and optimizers."""
    normalizer: running_statistics.RunningStatisticsState
    """Observation statistics."""
    scale: ValueScale
    """Scale of the value targets."""
    rollout: RolloutState
    """Environments and unfinished episodes."""
    key: PRNGKeyArray
    """Source of all further randomness."""
    iteration: Int[Array, ""]
    """Finished iterations."""

"""Tasks of training configurations."""

from __future__ import annotations

import envs
from rmp_mjx.training.config import TrainConfig


def load(config: TrainConfig) -> envs.ArmEnv:
    """The task of a configuration."""
    return envs.make(config.task)

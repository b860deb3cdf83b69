"""Tasks of training configurations."""

from __future__ import annotations

import envs
from rmp_mjx.training.config import TrainConfig


def load(config: TrainConfig) -> envs.ArmEnv:
    """The task of a configuration."""
    options = envs.parse_options(config.env, config.env_options)
    return envs.load(
        config.env, controller=config.controller, physics=config.physics, **options
    )

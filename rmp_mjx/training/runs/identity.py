"""Which environment a run was trained in: recorded, and compared before it is used.

An environment may have an `identity`: what makes it another one although its options
are the same, for instance its arm. A dictionary from what a thing is to which one it is.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rmp_mjx.training.config import ConfigError, read_record

KEY = "environment"
"""Entry of a run's config.json."""


def of(env: Any) -> dict[str, str]:
    """The identity of an environment; empty if it has none."""
    return dict(getattr(env, "identity", {}))


def saved(config: Path) -> dict[str, str]:
    """The identity in a run's config.json; empty if the run recorded none."""
    return read_record(config).get(KEY, {}) if config.exists() else {}


def check(before: Mapping[str, str], env: Any, trained: Any) -> None:
    """Refuse an environment that is not what something was trained in.

    Args:
        before: Identity of the environment that it was trained in.
        env: The environment it is to be used in.
        trained: What was trained: a folder or a file.

    Raises:
        ConfigError: The environment is another one.
    """
    now = of(env)
    for thing, which in before.items():
        if now.get(thing) != which:
            other = now.get(thing, "the usual one")
            raise ConfigError(
                f"{trained} was trained with the {thing} {which}, not with {other}: "
                f"make the environment with that {thing}, from Python"
            )

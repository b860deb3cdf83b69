"""Which run it is and in which environment it was trained, recorded and compared.

An environment may have an `identity`: what makes it another one although its options
are the same, for instance its arm. It is a dictionary from what a thing is to which one
it is.
"""

import secrets
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rmp_mjx.training.config import ConfigError
from rmp_mjx.training.records import read_record

KEY, RUN = "environment", "run_id"
"""Entries of a run's config.json."""


def of(env: Any) -> dict[str, str]:
    """The identity of an environment; empty if it has none."""
    return dict(getattr(env, "identity", {}))


def saved(config: Path) -> dict[str, str]:
    """The environment's identity in a run's config.json; empty if it recorded none.

    Raises:
        ConfigError: The file is damaged.
    """
    found = read_record(config).get(KEY, {}) if config.exists() else {}
    if not isinstance(found, dict):
        raise ConfigError(f"{config}: {KEY} must be a JSON object")
    return found


def new_run() -> str:
    """A name that no other run has."""
    return secrets.token_hex(8)


def run_id(config: Path) -> str | None:
    """The name in a run's config.json; None: the run is older than these names.

    Raises:
        ConfigError: The file is damaged.
    """
    return read_record(config).get(RUN) if config.exists() else None


ARM = "arm"
"""What an environment's identity calls its arm."""


def check(
    before: Mapping[str, str], env: Any, trained: Any, besides: Sequence[str] = ()
) -> None:
    """Refuse an environment that is not what something was trained in.

    Args:
        before: Identity of the environment that it was trained in.
        env: The environment it is to be used in.
        trained: What was trained: a folder or a file.
        besides: Things that may be others.

    Raises:
        ConfigError: The environment is another one.
    """
    now = of(env)
    for thing, which in before.items():
        if thing not in besides and now.get(thing) != which:
            other = now.get(thing, "the usual one")
            raise ConfigError(
                f"{trained} was trained with the {thing} {which}, not with {other}: "
                f"make the environment with that {thing}"
            )

"""Training configurations as JSON: written, read, compared."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rmp_mjx.files import read_json, with_tuples, write_text
from rmp_mjx.training.config import (
    AnyTask,
    ConfigError,
    PPOConfig,
    RunConfig,
    TrainConfig,
)


@dataclass(frozen=True)
class RecordedTask:
    """A task's options as they were recorded; the task itself is not needed."""

    options: Mapping[str, Any]
    """Options by name."""

    @property
    def title(self) -> str:
        """Task and controller, as far as they are recorded."""
        words = (self.options.get(name) for name in ("env", "controller"))
        return ", ".join(str(word) for word in words if word)

    def record(self) -> dict[str, Any]:
        """The options by name."""
        return dict(self.options)


def defining(record: Mapping[str, Any]) -> dict[str, Any]:
    """What defines a run, by flat name: its task, its learning, its trainer.

    Args:
        record: `TrainConfig.record()`, or what JSON gives back of it.
    """
    trainer = {"trainer": record["trainer"]} if "trainer" in record else {}
    return {**record.get("task", {}), **record.get("ppo", {}), **trainer}


def differing_fields(
    saved: Mapping[str, Any], config: TrainConfig
) -> dict[str, tuple[Any, Any]]:
    """Options that define a run and differ between a saved record and a configuration.

    What an older record does not say has its default.

    Raises:
        ConfigError: The record is of version 0.1.
    """
    if "ppo" not in saved:
        raise ConfigError(
            "a run of version 0.1 cannot be resumed: evaluate it as it is, or finish "
            "it with that version"
        )
    usual = TrainConfig(type(config.task)())
    default, given, new = (
        defining(json.loads(json.dumps(record)))
        for record in (usual.record(), saved, config.record())
    )
    old = default | given
    return {
        name: (old.get(name), new.get(name))
        for name in old | new
        if old.get(name) != new.get(name)
    }


def save_config(config: TrainConfig, path: Path, **more: Any) -> None:
    """Write a configuration as JSON, and what else is to be kept with it."""
    write_text(path, json.dumps(config.record() | more, indent=2) + "\n")


def config_of(
    record: Mapping[str, Any], task: Callable[[Mapping[str, Any]], AnyTask]
) -> TrainConfig[AnyTask]:
    """A configuration from a record that JSON gives back; missing fields take defaults.

    Args:
        record: As `TrainConfig.record` makes it.
        task: The task's options from their part of the record.

    Raises:
        ConfigError: An unknown field, or a value that cannot be run.
    """
    parts: list[Any] = [record.get(name) for name in ("task", "ppo", "run")]
    if not all(isinstance(part, dict) for part in parts):
        raise ConfigError("task, ppo and run must be JSON objects")
    options, ppo, run = parts
    trainer: Any = record.get("trainer", "ours")
    try:
        return TrainConfig(
            task(options), PPOConfig(**with_tuples(ppo)), RunConfig(**run), trainer
        )
    except (TypeError, ValueError) as error:
        raise ConfigError(str(error)) from error


def read_record(path: Path) -> dict[str, Any]:
    """The record in a file written by `save_config`.

    Raises:
        ConfigError: The file is missing, is not JSON, or is no record.
    """
    try:
        record = read_json(path)
    except FileNotFoundError as error:
        raise ConfigError(f"{path.parent} is no run folder: no {path.name}") from error
    except ValueError as error:
        raise ConfigError(str(error)) from error
    if not isinstance(record, dict):
        raise ConfigError(f"{path} cannot be read as a configuration: no JSON object")
    return record

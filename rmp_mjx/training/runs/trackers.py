"""Trackers that also get the rows of a run: TensorBoard, Weights & Biases, MLflow."""

import dataclasses
import importlib.util
import time
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Protocol

from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import (
    Event,  # pyright: ignore[reportAttributeAccessIssue]
    SessionLog,  # pyright: ignore[reportAttributeAccessIssue]
)
from tensorboardX.summary import scalar

from rmp_mjx.files import write_text
from rmp_mjx.training.config import ConfigError, TrainConfig
from rmp_mjx.training.records import defining

OPTIONAL = ("wandb", "mlflow")
"""Trackers that need an extra. The name is the option, the module and the extra."""

Values = Mapping[str, float]


class Tracker(Protocol):
    """Takes numbers during training."""

    def add(self, steps: int, values: Values) -> None:
        """Note the values after this many policy steps."""
        ...

    def close(self, exit_code: int) -> None:
        """Finish; 0: training ended normally."""
        ...


def check(config: TrainConfig) -> None:
    """Refuse trackers that are configured but not installed.

    Raises:
        ConfigError: With the command that installs the tracker.
    """
    for name in OPTIONAL:
        if getattr(config.run, name) and importlib.util.find_spec(name) is None:
            raise ConfigError(
                f"--{name} needs a package that is not installed: "
                f"pip install 'rmp-mjx[{name}]'"
            )


def open_trackers(
    config: TrainConfig, folder: Path, tensorboard: Path, after: int | None
) -> list[Tracker]:
    """The trackers of a run: TensorBoard and the configured ones.

    Args:
        config: Configuration; the trackers store it.
        folder: Run folder; a file in it names the entry of a resumed run.
        tensorboard: Folder of TensorBoard's event files.
        after: Policy steps that a resumed run keeps; None: it is new.
    """
    trackers: list[Tracker] = [TensorBoard(tensorboard, after)]
    if config.run.wandb:
        trackers.append(WeightsAndBiases(config, folder))
    if config.run.mlflow:
        trackers.append(MLflow(config, folder))
    return trackers


class TensorBoard:
    """Event files, written in this thread, so that the caller sees an error.

    tensorboardX's own writer passes events to a thread. When that thread meets a full
    disk, its queue fills up and training would wait for ever.
    """

    FLUSH_INTERVAL = 10.0
    """Seconds between writes to the disk."""

    def __init__(self, folder: Path, after: int | None):
        """Begin an event file; older files lose what is later than `after`."""
        folder.mkdir(parents=True, exist_ok=True)
        self._writer = EventsWriter(str(folder / "events"), f".{uuid.uuid4().hex[:8]}")
        self._flushed = time.monotonic()
        if after is not None:
            start = SessionLog(status=SessionLog.START)
            self._writer.write_event(Event(step=after + 1, session_log=start))

    def add(self, steps: int, values: Values) -> None:
        """Write a scalar for each value."""
        now = time.time()
        for name, value in values.items():
            event = Event(summary=scalar(name, value), step=steps, wall_time=now)
            self._writer.write_event(event)
        if time.monotonic() - self._flushed > self.FLUSH_INTERVAL:
            self._flushed = time.monotonic()
            self._writer.flush()

    def close(self, exit_code: int) -> None:
        """Close the file."""
        del exit_code
        self._writer.close()


class WeightsAndBiases:
    """A run of a project at wandb.ai, or offline with WANDB_MODE=offline."""

    def __init__(self, config: TrainConfig, folder: Path):
        """Begin the run, or go on with it."""
        import wandb  # pyright: ignore[reportMissingImports]

        self._run = wandb.init(
            project=config.run.wandb,
            name=folder.name,
            id=_remembered(folder / "wandb_run", lambda: uuid.uuid4().hex),
            resume="allow",
            dir=str(folder),
            config=flat(config),
        )

    def add(self, steps: int, values: Values) -> None:
        """Log the values."""
        self._run.log(dict(values), step=steps)

    def close(self, exit_code: int) -> None:
        """Upload the rest."""
        self._run.finish(exit_code=exit_code)


class MLflow:
    """A run of an experiment where MLFLOW_TRACKING_URI says."""

    def __init__(self, config: TrainConfig, folder: Path):
        """Begin the run, or go on with it."""
        import mlflow  # pyright: ignore[reportMissingImports]

        def create() -> str:
            experiment = mlflow.set_experiment(config.run.mlflow).experiment_id
            run = client.create_run(experiment, run_name=folder.name)
            for name, value in flat(config).items():
                client.log_param(run.info.run_id, name, value)
            return run.info.run_id

        client = self._client = mlflow.MlflowClient()
        self._id = _remembered(folder / "mlflow_run", create)
        self._client.update_run(self._id, status="RUNNING")

    def add(self, steps: int, values: Values) -> None:
        """Log the values."""
        for name, value in values.items():
            self._client.log_metric(self._id, name, value, step=steps)

    def close(self, exit_code: int) -> None:
        """Mark the run as finished, stopped or failed."""
        status = {0: "FINISHED", 1: "FAILED"}.get(exit_code, "KILLED")
        self._client.set_terminated(self._id, status)


def flat(config: TrainConfig) -> dict[str, object]:
    """All options by name."""
    return {**defining(config.record()), **dataclasses.asdict(config.run)}


def _remembered(path: Path, make: Callable[[], str]) -> str:
    """The name in a file; a new one is written if there is none."""
    if not path.exists():
        write_text(path, make())
    return path.read_text()

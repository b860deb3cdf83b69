"""What a metric is: its name, how it adds up over an episode, how it is shown.

An environment declares each of its metrics once. Training, evaluation, the terminal,
tables and figures read the declaration; none of them knows a metric by its name.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Literal, get_args

from rmp_mjx.names import unknown

Reduction = Literal["sum", "mean", "max", "min", "last"]
"""How the values of an episode's policy steps become the episode's value."""
REDUCTIONS: tuple[Reduction, ...] = get_args(Reduction)
"""All reductions."""
Statistic = Literal["mean", "rate", "max", "min"]
"""What a table shows of many episodes: `rate` is the share of those with a value
above 0; the others are taken over the episodes' values."""

_SHOWN_AS = {"m": ("mm", 1e3), "share": ("%", 100.0)}
"""Units that people read in another one: its name and the factor to it."""


@dataclasses.dataclass(frozen=True)
class Metric:
    """A number that an environment reports at every policy step."""

    name: str
    """Name in files, for instance `contact_force`."""
    reduction: Reduction
    """How an episode's steps become the episode's value."""
    label: str = ""
    """What people call it; default: the name."""
    unit: str = ""
    """Unit of the stored value: an SI unit, `share` (0 to 1), or empty for a count."""
    event: bool = False
    """Whether it counts unwanted events. Curves show it per 1,000 policy steps."""
    headline: str = ""
    """Short label. A metric that has one is on the terminal's line and on the first
    page of the learning curve."""
    table: tuple[Statistic, ...] = ()
    """What the table of an evaluation shows of it."""
    fault: str = ""
    """What is wrong where it is not 0; empty for a metric that may be anything."""

    def __post_init__(self) -> None:
        """Check the reduction and fill in the label.

        Raises:
            ValueError: Not a reduction; the message lists them.
        """
        if self.reduction not in REDUCTIONS:
            raise ValueError(
                unknown(f"reduction of metric {self.name}", self.reduction, REDUCTIONS)
            )
        if not self.label:
            object.__setattr__(self, "label", self.name.replace("_", " "))

    @property
    def shown_unit(self) -> str:
        """The unit that people read: `mm` for `m`, `%` for `share`."""
        return _SHOWN_AS.get(self.unit, (self.unit, 1.0))[0]

    @property
    def factor(self) -> float:
        """From the stored value to the shown one."""
        return _SHOWN_AS.get(self.unit, (self.unit, 1.0))[1]

    @property
    def column(self) -> str:
        """Column of a run's metrics that shows it best over training."""
        return f"{'per_1000_steps' if self.event else 'episode'}/{self.name}"


RETURN = Metric("return", "sum", headline="return", table=("mean",))
"""Sum of an episode's rewards, counted by the caller."""
LENGTH = Metric("length", "sum", "episode length", "steps", table=("mean",))
"""Policy steps of an episode, counted by the caller."""
SUCCESS = Metric("success", "max", "", "share", headline="success", table=("rate",))
"""Whether the task was solved: a metric of every environment."""


def number(value: float) -> str:
    """A number for people: three digits, or whole with separators from 1,000 on."""
    return f"{value:,.0f}" if abs(value) >= 999.5 else f"{value:.3g}"


def by_name(metrics: Iterable[Metric]) -> dict[str, Metric]:
    """Metrics by name, in their order.

    Raises:
        ValueError: Two of them have the same name.
    """
    metrics = list(metrics)
    found = {metric.name: metric for metric in metrics}
    if len(found) < len(metrics):
        names = [metric.name for metric in metrics]
        twice = sorted({name for name in names if names.count(name) > 1})
        raise ValueError(f"metrics declared twice: {', '.join(twice)}")
    return found


def of_fields(record: type) -> dict[str, Metric]:
    """The metrics that the fields of a dataclass declare, by name.

    A field declares its metric as `metadata={"metric": Metric(...)}`.

    Raises:
        ValueError: A field and its metric have different names.
    """
    found = {}
    for field in dataclasses.fields(record):
        metric = field.metadata["metric"]
        if metric.name != field.name:
            raise ValueError(f"field {field.name!r} declares metric {metric.name!r}")
        found[field.name] = metric
    return found


def reductions(metrics: Mapping[str, Metric]) -> dict[str, Reduction]:
    """How each metric becomes an episode's value, by name."""
    return {name: metric.reduction for name, metric in metrics.items()}

"""What every task measures once per policy step, besides its safety record."""

from __future__ import annotations

import dataclasses
from typing import Any

from flax import struct
from jaxtyping import Array, Bool, Float, Int

from envs import safety
from rmp_mjx.metric import SUCCESS, Metric, of_fields
from rmp_mjx.pytree import Pytree


def measured(metric: Metric) -> Any:
    """A field of `Measures`: the metric that it is."""
    return struct.field(metadata={"metric": metric})


class Measures(Pytree):
    """Measures of one policy step; each field declares its metric."""

    success: Bool[Array, ""] = measured(SUCCESS)
    """Whether the task is solved in this step."""
    contact_impulse: Float[Array, ""] = measured(
        Metric("contact_impulse", "sum", unit="N s")
    )
    """Impulse of the collisions' normal forces [N s]."""
    clearance: Float[Array, ""] = measured(
        Metric("clearance", "min", unit="m", table=("mean", "min"))
    )
    """Least distance of a control point to the table, a fixture or a sphere, at the
    end of the step [m]."""
    tracking_error: Float[Array, ""] = measured(
        Metric("tracking_error", "mean", unit="m", table=("mean",))
    )
    """Distance of the grip to its set-point at the end of the step [m]."""
    unplaced_obstacles: Int[Array, ""] = measured(
        Metric("unplaced_obstacles", "max", fault="some spheres found no place")
    )
    """Spheres of this episode that found no place."""
    nonfinite: Bool[Array, ""] = measured(Metric("nonfinite", "max"))
    """Whether the state is not finite or absurdly fast."""

    @property
    def values(self) -> dict[str, Array]:
        """Every field by name."""
        fields = dataclasses.fields(self)
        return {field.name: getattr(self, field.name) for field in fields}


METRICS = {SUCCESS.name: SUCCESS} | safety.METRICS | of_fields(Measures)
"""Metrics of every task by name; a table shows them in this order."""

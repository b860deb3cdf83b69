"""Where a loop's obstacles come from: any thread puts them, with a time stamp."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

Slots = dict[str, dict[str, np.ndarray]]
"""Obstacle slots by kind, as `Deployed.obstacles` makes them."""


class Seen(NamedTuple):
    """Obstacles as they were last put."""

    slots: Slots
    """The obstacles; nobody writes into them."""
    stamp: float
    """When they were measured, on the source's clock [s]."""
    number: int
    """How often there were new ones."""


class ObstacleSource:
    """The newest obstacles. A loop reads while other threads write."""

    def __init__(self, slots: Slots, clock: Callable[[], float] = time.monotonic):
        """Start without obstacles, measured now.

        Args:
            slots: From `Deployed.obstacles`; nothing is in use.
            clock: Gives the time of the stamps [s].
        """
        self.clock = clock
        self._lock = threading.Lock()
        self._seen = Seen(slots, clock(), 0)

    def get(self) -> Seen:
        """The newest obstacles."""
        with self._lock:
            return self._seen

    def fresh(self, stamp: float | None = None) -> None:
        """Say that the obstacles are still as they were.

        Args:
            stamp: When that was measured [s]; default now.
        """
        with self._lock:
            now = self.clock() if stamp is None else stamp
            self._seen = self._seen._replace(stamp=now)

    def put(self, kind: str, stamp: float | None = None, **fields: Any) -> None:
        """Use the first k slots of a kind.

        Args:
            kind: For instance `spheres`.
            stamp: When they were measured [s]; default now.
            **fields: Values of each, (k, ...): for spheres `center` (k, 3) [m],
                `radius` (k,) [m], perhaps `velocity` (k, 3) [m/s]; for planes `point`
                and `normal`, (k, 3). What is not given is zero.

        Raises:
            ValueError: There are no such slots or fields, too few slots, or numbers
                that are not finite.
        """
        with self._lock:
            slots = self._seen.slots
            if kind not in slots:
                raise ValueError(f"no slots for {kind}, only for {', '.join(slots)}")
            new = {name: np.zeros_like(old) for name, old in slots[kind].items()}
            count = {len(np.asarray(value)) for value in fields.values()}
            room = len(new["active"])
            if len(count) != 1 or max(count) > room:
                raise ValueError(f"{kind}: give at most {room}, each field as many")
            (k,) = count
            for name, value in fields.items():
                if name not in new or name == "active":
                    raise ValueError(f"{kind} have no {name}, only {', '.join(new)}")
                given = np.asarray(value, new[name].dtype)
                if not np.all(np.isfinite(given)):
                    raise ValueError(f"{name} of {kind} must be finite")
                new[name][:k] = given
            new["active"][:k] = True
            now = self.clock() if stamp is None else stamp
            self._seen = Seen({**slots, kind: new}, now, self._seen.number + 1)

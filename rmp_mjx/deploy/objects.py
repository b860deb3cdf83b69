"""A task's objects, as something measures them: any thread puts them, with a stamp."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from rmp_mjx.deploy.deployed import Deployed
from rmp_mjx.deploy.sources import ObstacleSource


class Objects:
    """What `PolicyTargets` tells the policy of objects that an arm does not measure.

    The names are `names`: the objects' joints as in MuJoCo, and the task's own. For a
    door, `hinge` [rad], `hinge_rate` [rad/s] and `grip_force` [N], of which only the
    sign counts; for a block, `block` (7,), its position [m] and unit quaternion, `w`
    first, `block_rate` (6,), velocity [m/s] and angular velocity in its own frame
    [rad/s], and `goal` (3,) [m].
    """

    def __init__(
        self,
        deployed: Deployed,
        obstacles: ObstacleSource,
        stale: float = 0.25,
        clock: Callable[[], float] = time.monotonic,
    ):
        """Nothing is known yet.

        Args:
            deployed: The file.
            obstacles: Gets the objects that the controller must avoid, with their
                stamp, at every `put`.
            stale: Older values stop the arm [s].
            clock: Gives the time of the stamps [s].

        Raises:
            ValueError: The file has no `observe`.
        """
        deployed.check_observes()
        self._told = deployed.examples("observe")[2]
        self._fixed, self._fixtures = {}, None
        if "fixtures" in deployed.programs:
            (self._fixed,) = deployed.examples("fixtures")
            self._fixtures = deployed.flat("fixtures")
        self._like = self._told | self._fixed
        self._obstacles, self.stale, self.clock = obstacles, stale, clock
        self._lock = threading.Lock()
        self._known: tuple[dict[str, np.ndarray], float] | None = None

    @property
    def names(self) -> dict[str, tuple[int, ...]]:
        """Shapes of what `put` takes, by name."""
        return {name: x.shape for name, x in self._like.items()}

    def put(self, stamp: float | None = None, **values: Any) -> None:
        """Say how the objects are.

        Args:
            stamp: When that was measured [s]; default now.
            **values: All of `names`.

        Raises:
            ValueError: Names or shapes are others, or numbers are not finite.
        """
        if set(values) != set(self._like):
            raise ValueError(f"give {', '.join(self._like)}; got {', '.join(values)}")
        known = {}
        for name, like in self._like.items():
            known[name] = np.array(values[name], like.dtype)
            if known[name].shape != like.shape:
                raise ValueError(f"{name} must have shape {like.shape}")
            if not np.all(np.isfinite(known[name])):
                raise ValueError(f"{name} must be finite")
        stamp = self.clock() if stamp is None else stamp
        with self._lock:
            if self._fixtures is not None:
                self._fixtures.put(0, {name: known[name] for name in self._fixed})
                for kind, fields in self._fixtures().items():
                    self._obstacles.put(kind, stamp, **fields)
            self._known = known, stamp

    def told(self, p: np.ndarray, time: float) -> dict[str, Any]:
        """What the policy is told; neither the grip's place nor the time matters.

        Raises:
            ValueError: Nothing was put yet, or too long ago: the loop stops the arm.
        """
        del p, time
        if self._known is None:
            raise ValueError("nothing is known of the objects yet")
        known, stamp = self._known
        age = self.clock() - stamp
        if age > self.stale:
            raise ValueError(f"objects stale: {1e3 * age:.0f} ms old")
        return {name: known[name] for name in self._told}

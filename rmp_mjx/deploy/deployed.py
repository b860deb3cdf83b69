"""What was exported, ready to call: needs JAX and NumPy, no simulator.

Neither this module nor what it imports reaches MuJoCo, Brax or Flax: a robot's computer
runs the programs and never builds them. `import rmp_mjx` loads its controllers only
when one of their names is asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import export

from rmp_mjx.deploy.artefact import DeployError, read
from rmp_mjx.deploy.flat import Flat
from rmp_mjx.deploy.numpy_policy import NumpyPolicy, weights

SUFFIX = ".stablehlo"
"""How the name of a program's part ends."""
NEEDED = ("policy", "setpoint", "control", "grip")
"""Programs that every file has; `observe` is there where a task is told, not seen."""


class Limits(NamedTuple):
    """Limits of the arm, (n,) each."""

    q_lower: np.ndarray
    """Lowest joint positions [rad]."""
    q_upper: np.ndarray
    """Highest joint positions [rad]."""
    qd: np.ndarray
    """Greatest joint speeds [rad/s]; infinite where the arm states none."""
    tau: np.ndarray
    """Greatest torques [N m]."""
    tau_rate: np.ndarray
    """Greatest rates of the torques [N m/s]; infinite where the arm states none."""


def load(path: str | Path) -> Deployed:
    """What `rmp-mjx-export` wrote.

    Raises:
        DeployError: The file is damaged, of another version or not ours. A ValueError.
        FileNotFoundError: There is no such file.
    """
    path = Path(path)
    metadata, parts = read(path)
    programs = {}
    for name, data in parts.items():
        if name.endswith(SUFFIX):
            try:
                found = export.deserialize(bytearray(data))
            except Exception as error:  # whatever JAX makes of another version's bytes
                raise DeployError(
                    f"{path}: {name} cannot be read by jax {jax.__version__}; it was "
                    f"written by jax {metadata.get('versions', {}).get('jax')}: {error}"
                ) from error
            programs[name.removesuffix(SUFFIX)] = found
    missing = [name for name in NEEDED if name not in programs]
    if missing:
        raise DeployError(f"{path} has no program {', '.join(missing)}")
    try:
        limits = _limits(metadata["robot"])
        return Deployed(
            metadata, parts["card.md"].decode(), weights(path, parts), programs, limits
        )
    except (KeyError, TypeError, UnicodeDecodeError) as error:
        raise DeployError(f"{path} lacks {error} in its metadata or parts") from error


class Deployed:
    """Policy and controller of one arm, as functions of plain arrays.

    The methods take batches, (b, ...), and compile for each new size. A `Loop` calls
    one state at a time, compiled ahead.
    """

    def __init__(
        self,
        metadata: dict[str, Any],
        card: str,
        arrays: dict[str, np.ndarray],
        programs: Mapping[str, export.Exported],
        limits: Limits,
    ):
        """Keep the parts of a file; `load` reads them."""
        self.metadata = metadata
        self.card = card
        self.numpy_policy = NumpyPolicy(arrays)
        self.limits = limits
        self.programs = dict(programs)
        self._flat: dict[str, Flat] = {}
        self._jitted = {name: jax.jit(each.call) for name, each in programs.items()}

    def __repr__(self) -> str:
        """The arm, the task and the rates."""
        return (
            f"Deployed('{self.metadata['task']}' on '{self.robot}', control every "
            f"{1e3 * self.period:g} ms, policy every {1e3 * self.policy_period:g} ms)"
        )

    @property
    def robot(self) -> str:
        """Name of the arm."""
        return self.metadata["robot"]["name"]

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.limits.tau)

    @property
    def period(self) -> float:
        """Time between two calls of the controller [s]."""
        return self.metadata["period"]

    @property
    def policy_period(self) -> float:
        """Time between two calls of the policy [s]."""
        return self.metadata["policy_period"]

    @property
    def start(self) -> np.ndarray:
        """Joint positions from which the task was trained, (n,) [rad]."""
        return np.array(self.metadata["robot"]["start"])

    def examples(self, name: str) -> tuple[Any, ...]:
        """Arguments of a program for one state, all zeros."""
        exported = self.programs[name]
        args, _ = jax.tree.unflatten(exported.in_tree, exported.in_avals)
        return jax.tree.map(lambda x: np.zeros(x.shape[1:], x.dtype), args)

    def obstacles(self) -> dict[str, dict[str, np.ndarray]]:
        """Obstacle slots for one state, none in use, by kind; fill them in."""
        return self.examples("control")[3]

    def memory(self) -> dict[str, np.ndarray]:
        """What `control` remembers before the first step, for one state."""
        return self.examples("control")[4]

    def policy(self, observation: Any) -> Any:
        """Actions in [-1, 1] for observations, (b, k) to (b, m)."""
        return self._jitted["policy"](np.asarray(observation, np.float32))

    def observe(self, q: Any, qd: Any, told: Any, obstacles: Any) -> Any:
        """Observations from what an arm measures.

        Args:
            q: Joint positions, (b, n) [rad].
            qd: Joint velocities, (b, n) [rad/s].
            told: What the robot is told of the task, batched; see `examples`.
            obstacles: Obstacles, batched.

        Raises:
            ValueError: The task's observation is not made of these alone.
        """
        self.check_observes()
        return self._jitted["observe"](*_floats(q, qd), told, obstacles)

    def check_observes(self) -> None:
        """See that there is an `observe`.

        Raises:
            ValueError: There is none.
        """
        if "observe" not in self.programs:
            raise ValueError(
                f"the observation of task '{self.metadata['task']}' takes more than "
                "joints and what can be told: make it yourself, entry by entry as "
                "metadata['observation'] lists them"
            )

    def setpoint(self, q: Any, action: Any, time: Any) -> dict[str, Any]:
        """Set-points from (b, n) [rad], actions (b, m) and times (b,) [s]."""
        return self._jitted["setpoint"](*_floats(q, action, time))

    def grip(self, q: Any, qd: Any) -> dict[str, Any]:
        """Position p [m], rotation R, velocity v and angular velocity w of the grip."""
        return self._jitted["grip"](*_floats(q, qd))

    def control(
        self, q: Any, qd: Any, setpoint: Any, obstacles: Any, memory: Any
    ) -> dict[str, Any]:
        """Torques and what belongs to them.

        Args:
            q: Joint positions, (b, n) [rad].
            qd: Joint velocities, (b, n) [rad/s].
            setpoint: From `setpoint`.
            obstacles: As `obstacles()`, batched.
            memory: As `memory()`, or of the last step, with `tau` the torque that was
                sent, gravity included.

        Returns:
            `tau` (b, n) [N m], gravity included; `brake`, the torque that brings the
            arm to rest and holds it; `gravity`, the torque that holds it at rest;
            `tau_ext`, the contacts' torque as the observer has it; `clearance` [m];
            `usable`, 0 where `tau` is a fall-back; and the next `memory`.
        """
        return self._jitted["control"](*_floats(q, qd), setpoint, obstacles, memory)

    def flat(self, name: str) -> Flat:
        """A program compiled for one state, with one array in and one out."""
        if name not in self._flat:
            self._flat[name] = Flat(self._single(name), self.examples(name))
        return self._flat[name].twin()

    def flat_plan(self) -> Flat:
        """From (q, qd, told, obstacles, time) to the set-point, as `flat`.

        Raises:
            ValueError: The file has no `observe`.
        """
        self.check_observes()
        if "plan" not in self._flat:
            observe, policy, setpoint = (
                self._single(name) for name in ("observe", "policy", "setpoint")
            )

            def plan(q, qd, told, obstacles, time):
                return setpoint(q, policy(observe(q, qd, told, obstacles)), time)

            *_, time = self.examples("setpoint")
            self._flat["plan"] = Flat(plan, (*self.examples("observe"), time))
        return self._flat["plan"].twin()

    def _single(self, name: str) -> Callable[..., Any]:
        """A program for one state."""
        call = self.programs[name].call

        def one(*arguments):
            batch = jax.tree.map(lambda x: x[None], arguments)
            return jax.tree.map(lambda x: x[0], call(*batch))

        return one


def _floats(*arrays: Any) -> list[np.ndarray]:
    return [np.asarray(x, np.float32) for x in arrays]


def _limits(robot: Mapping[str, Any]) -> Limits:
    """Limits as JSON has them; null is infinite."""

    def bound(name: str, infinite: float) -> np.ndarray:
        values = robot[name]
        return np.array([infinite if x is None else float(x) for x in values])

    return Limits(
        bound("q_lower", -np.inf),
        bound("q_upper", np.inf),
        bound("qd_max", np.inf),
        bound("tau_max", np.inf),
        bound("tau_rate_max", np.inf),
    )

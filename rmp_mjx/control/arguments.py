"""Messages for arguments of a wrong shape or dtype.

The checks look at shapes and dtypes only. They run while JAX traces a function, so they
cost a compiled controller nothing.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rmp_mjx.obstacles import Obstacles
from rmp_mjx.types import Action, LeafWeights, Setpoint

_KINDS = {"float": jnp.floating, "bool": np.bool_}


def check(name: str, value: Any, shape: tuple[int, ...], kind: str = "float") -> None:
    """Refuse what is not an array of this shape and kind.

    Args:
        name: The argument's name.
        value: What was given: an array, a tracer or a NumPy array.
        shape: Expected shape.
        kind: `float` (of any precision) or `bool`.

    Raises:
        ValueError: The message has the name, what is expected, and what was given.
    """
    given = getattr(value, "shape", None)
    if given == shape and jnp.issubdtype(value.dtype, _KINDS[kind]):
        return
    if given is None:
        given, found = (), type(value).__name__
    else:
        found = f"{value.dtype} {tuple(given)}"
    batched = len(given) > len(shape)
    hint = "; batches go through jax.vmap(ctrl)" if batched else ""
    raise ValueError(
        f"{name} must be a {kind} array of shape {shape}, got {found}{hint}"
    )


def check_state(
    n: int, q: Any, qd: Any, tau_ext: Any = None, tau_last: Any = None
) -> None:
    """Refuse joint positions, velocities and torques that are not (n,) floats.

    The torques may be None.

    Raises:
        ValueError: See `check`.
    """
    for name, value in {"q": q, "qd": qd}.items():
        check(name, value, (n,))
    for name, value in {"tau_ext": tau_ext, "tau_last": tau_last}.items():
        if value is not None:
            check(name, value, (n,))


def check_action(action: Any) -> None:
    """Refuse what is not an action in physical units.

    Raises:
        ValueError: See `check`; or it is of another type.
    """
    if not isinstance(action, Action):
        raise ValueError(
            f"action must be an Action, got {type(action).__name__}: "
            "ctrl.decode(...) makes one of a policy's numbers"
        )
    for name in ("dpos", "drot", "kp_pos", "kp_ori"):
        check(f"action.{name}", getattr(action, name), (3,))
    _check_numbers("action.weights", action.weights)


def check_setpoint(setpoint: Any) -> None:
    """Refuse what is not an impedance target.

    Raises:
        ValueError: See `check`; or it is of another type.
    """
    if not isinstance(setpoint, Setpoint):
        raise ValueError(
            f"setpoint must be a Setpoint, got {type(setpoint).__name__}: "
            "ctrl.setpoint(q, action, time) makes one"
        )
    shapes = {"p_des": (3,), "R_des": (3, 3), "kp_pos": (3,), "kp_ori": (3,)}
    for name, shape in shapes.items():
        check(f"setpoint.{name}", getattr(setpoint, name), shape)
    check_number("setpoint.time", setpoint.time)
    _check_numbers("setpoint.weights", setpoint.weights)


def check_number(name: str, value: Any) -> None:
    """Refuse what is not one number, of any type.

    Raises:
        ValueError: See `check`.
    """
    if np.shape(value) != ():
        check(name, value, ())


def _check_numbers(name: str, weights: LeafWeights | None) -> None:
    """Refuse weights that are not one number each; None are none."""
    for field, value in {} if weights is None else vars(weights).items():
        check_number(f"{name}.{field}", value)


def check_obstacles(obstacles: Any) -> None:
    """Refuse obstacle slots whose arrays do not fit together.

    Raises:
        ValueError: See `check`; or they are of another type.
    """
    if not isinstance(obstacles, Obstacles):
        raise ValueError(
            f"obstacles must be an Obstacles, got {type(obstacles).__name__}: "
            "Obstacles.empty(...) makes one"
        )
    kinds = ("spheres", "planes", "capsules", "boxes")
    slots = [np.shape(getattr(obstacles, kind).active)[-1:] for kind in kinds]
    wanted = _slots(*(size[0] if size else 0 for size in slots))
    for kind in kinds:
        for name, expected in vars(getattr(wanted, kind)).items():
            given = getattr(getattr(obstacles, kind), name)
            what = "bool" if expected.dtype == bool else "float"
            check(f"obstacles.{kind}.{name}", given, expected.shape, what)


@functools.cache
def _slots(*sizes: int) -> Any:
    """Shapes and dtypes of obstacle slots."""
    return jax.eval_shape(lambda: Obstacles.empty(*sizes))

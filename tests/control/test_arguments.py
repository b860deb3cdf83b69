"""Arguments of a wrong shape or dtype: the message names them."""

import inspect
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rmp_mjx import (
    RMPVICES,
    VICES,
    Action,
    ActionRange,
    LeafWeights,
    Obstacles,
    Robot,
)
from rmp_mjx.control.cbf import FilteredVICES
from rmp_mjx.control.controller import ImpedanceController
from tests.control.conftest import changed
from tests.robot.test_model import GRIPPER

Q = np.zeros(3, np.float32)
ZERO = np.zeros(3, np.float32)
ACTION = Action(ZERO, ZERO, ZERO, ZERO)
SLOTS = Obstacles.empty(spheres=2, boxes=1)
ONE = Obstacles.empty(spheres=1).spheres


@pytest.fixture(scope="module")
def robot():
    return Robot.from_mjcf(GRIPPER, site="tip", spacing=0.1)


@pytest.fixture(autouse=True)
def own_checks_only(monkeypatch):
    """Without jaxtyping's checks, which a run of the tests may add."""
    for cls in (ActionRange, ImpedanceController, RMPVICES, VICES, FilteredVICES):
        for name in {"decode", "setpoint", "__call__"} & vars(cls).keys():
            monkeypatch.setattr(cls, name, inspect.unwrap(vars(cls)[name]))


def call(ctrl, q: Any = Q, qd: Any = Q, obstacles: Any = SLOTS, **fields):
    """Trace the controller with these arguments and fields of the set-point."""
    setpoint = changed(ctrl.setpoint(Q, ACTION, 0.0), **fields)
    return jax.eval_shape(lambda: ctrl(q, qd, setpoint, obstacles))


def spheres(**fields):
    return {"obstacles": SLOTS.replace(spheres=changed(SLOTS.spheres, **fields))}


WRONG = {
    "an integer state": (
        {"q": np.zeros(3, int)},
        "q must be a float array of shape (3,), got int64 (3,)",
    ),
    "a state of another arm": (
        {"qd": np.zeros(7, "f")},
        "qd must be a float array of shape (3,), got float32 (7,)",
    ),
    "a batch": (
        {"q": np.zeros((8, 3), "f")},
        "q must be a float array of shape (3,), got float32 (8, 3); "
        "batches go through jax.vmap(ctrl)",
    ),
    "a list": (
        {"q": [0.0, 0.0, 0.0]},
        "q must be a float array of shape (3,), got list",
    ),
    "a quaternion": (
        {"R_des": np.zeros(4)},
        "setpoint.R_des must be a float array of shape (3, 3), got float64 (4,)",
    ),
    "one stiffness": (
        {"kp_pos": np.float32(100.0)},
        "setpoint.kp_pos must be a float array of shape (3,), got float32 ()",
    ),
    "times": (
        {"time": np.zeros(5)},
        "setpoint.time must be a float array of shape (), got float64 (5,); "
        "batches go through jax.vmap(ctrl)",
    ),
    "one radius": (
        spheres(radius=np.ones(1)),
        "obstacles.spheres.radius must be a float array of shape (2,), "
        "got float64 (1,)",
    ),
    "slots of a batch": (
        spheres(active=np.ones((8, 2), bool)),
        "obstacles.spheres.active must be a bool array of shape (2,), got bool (8, 2); "
        "batches go through jax.vmap(ctrl)",
    ),
    "a slot without a number": (
        {"obstacles": SLOTS.replace(spheres=changed(ONE, active=np.True_))},
        "obstacles.spheres.velocity must be a float array of shape (0, 3), got float32 "
        "(1, 3)",
    ),
    "numbers as flags": (
        spheres(active=np.ones(2)),
        "obstacles.spheres.active must be a bool array of shape (2,), got float64 (2,)",
    ),
    "no obstacles": (
        {"obstacles": None},
        "obstacles must be an Obstacles, got NoneType: Obstacles.empty(...) makes one",
    ),
}


@pytest.mark.parametrize(("wrong", "message"), WRONG.values(), ids=WRONG)
@pytest.mark.parametrize("make", [RMPVICES, VICES, FilteredVICES])
def test_a_wrong_argument_is_named(robot, make, wrong, message):
    with pytest.raises(ValueError, match=re.escape(message) + r"(\n|$)"):
        call(make(robot), **wrong)


def test_right_arguments_pass_in_any_precision_and_batched_by_vmap(robot):
    ctrl = VICES(robot)
    assert call(ctrl, q=Q.astype(np.float64)).tau.shape == (3,)
    setpoint = ctrl.setpoint(Q, ACTION, 0.0)
    batched = jax.vmap(ctrl, in_axes=(0, 0, None, None))
    out = jax.eval_shape(batched, jnp.zeros((8, 3)), jnp.zeros((8, 3)), setpoint, SLOTS)
    assert out.tau.shape == (8, 3)


def test_the_weights_of_the_leaves_are_checked_too(robot):
    ctrl: Any = VICES(robot)
    weights = LeafWeights(np.zeros(2), 1.0, 0.0)
    message = (
        r"weights\.attractor must be a float array of shape \(\), got float64 \(2,\)"
    )
    with pytest.raises(ValueError, match="setpoint." + message):
        call(ctrl, weights=weights)
    with pytest.raises(ValueError, match="action." + message):
        ctrl.setpoint(Q, changed(ACTION, weights=weights), 0.0)
    with pytest.raises(ValueError, match=r"time must be .* got float64 \(4,\)"):
        ctrl.setpoint(Q, ACTION, np.zeros(4))


def test_an_action_and_a_set_point_are_not_confused(robot):
    ctrl: Any = VICES(robot)
    with pytest.raises(ValueError, match=r"action must be an Action, got ndarray"):
        ctrl.setpoint(Q, np.zeros(12), 0.0)
    with pytest.raises(ValueError, match=r"action\.drot must be .* got float64 \(4,\)"):
        ctrl.setpoint(Q, changed(ACTION, drot=np.zeros(4)), 0.0)
    with pytest.raises(ValueError, match="setpoint must be a Setpoint, got Action"):
        ctrl(Q, Q, ACTION, SLOTS)


def test_a_policys_numbers_must_be_twelve_floats(robot):
    message = r"action must be a float array of shape \(12,\), got "
    for wrong, given in (
        (np.zeros(12, int), r"int64 \(12,\)$"),
        (np.zeros(6), r"float64 \(6,\)$"),
        (np.zeros((4, 12)), r"float64 \(4, 12\); batches go through"),
    ):
        with pytest.raises(ValueError, match=message + given):
            VICES(robot).decode(wrong)

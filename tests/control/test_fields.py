"""The fields of real objects are what their annotations say, shapes included."""

import dataclasses
import typing
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from beartype.door import is_bearable
from jaxtyping import jaxtyped

from rmp_mjx import RMPVICES, VICES, Obstacles, Robot, rmp_vices_literal
from rmp_mjx.control.cbf import FilteredVICES
from rmp_mjx.control.tree import rmp_vices_tree
from rmp_mjx.control.vices import OSC
from rmp_mjx.pytree import Pytree
from rmp_mjx.rmp import TaskMap, pushforward
from rmp_mjx.robot.dynamics import dynamics
from rmp_mjx.robot.kinematics import arm_state, site_state
from rmp_mjx.robot.point_state import point_state
from tests.control.conftest import QUICK
from tests.robot.test_model import GRIPPER


def untrue(tree: Any, name: str = "") -> list[str]:
    """Fields whose value is not what the annotation says, in this tree and below."""
    found = []
    if isinstance(tree, dict):
        return [bad for k, v in tree.items() for bad in untrue(v, f"{name}[{k!r}]")]
    if isinstance(tree, (tuple, list)):
        return [bad for k, v in enumerate(tree) for bad in untrue(v, f"{name}[{k}]")]
    if not dataclasses.is_dataclass(tree):
        return []
    hints = typing.get_type_hints(type(tree))
    with jaxtyped("context"):  # one size for each letter
        for field in dataclasses.fields(tree):
            value, hint = getattr(tree, field.name), hints[field.name]
            if not is_bearable(value, hint):
                found.append(f"{name}.{field.name}: {value!r} is not {hint}")
    for field in dataclasses.fields(tree):
        found += untrue(getattr(tree, field.name), f"{name}.{field.name}")
    return found


class Arm(Pytree):
    """What a wrong field would look like."""

    q: float
    link: str


def test_a_wrong_field_is_found():
    wrong = Arm(0.1, "hand").replace(q="far", link=2)
    assert untrue(Arm(0.1, "hand")) == []
    assert untrue({"arm": wrong}) == [
        "['arm'].q: 'far' is not <class 'float'>",
        "['arm'].link: 2 is not <class 'str'>",
    ]


@pytest.fixture(scope="module")
def small():
    return Robot.from_mjcf(GRIPPER, site="tip", spacing=0.1)


def test_robots_and_controllers_are_as_annotated(robot, small):
    for arm in (robot, small):
        assert untrue(arm) == []
        for make in (RMPVICES, VICES, FilteredVICES, OSC, rmp_vices_literal):
            assert untrue(make(arm)) == []


def test_obstacles_are_as_annotated():
    slots = Obstacles.empty(spheres=2, planes=1, capsules=3, boxes=1)
    assert untrue(slots) == []
    filled = slots.with_spheres([[0.4, 0.0, 0.4]], 0.1).with_boxes(
        np.zeros((1, 3)), np.ones((1, 3)), hand_may_touch=True
    )
    assert untrue(filled) == [] and untrue(jax.device_get(filled)) == []
    bad = jax.tree.map(lambda x: x[None], slots.spheres)
    assert untrue(bad) != []


def test_what_a_step_computes_is_as_annotated(small):
    ctrl = VICES(small)
    q, qd = jnp.array([0.1, 0.5, -0.3]), jnp.ones(3)
    action = ctrl.decode(jnp.full(12, 0.3))
    setpoint = ctrl.setpoint(q, action, 0.4)
    slots = Obstacles.empty(spheres=2, planes=1, capsules=1, boxes=1)

    @jax.jit(compiler_options=QUICK)
    def compute(q, qd):
        arm = arm_state(small, q, qd)
        states = arm, site_state(small, arm), point_state(small, arm)
        moved = pushforward(TaskMap(jnp.cos), q, qd)
        return states, moved, ctrl(q, qd, setpoint, slots)

    assert untrue((action, setpoint)) == []
    assert untrue(compute(q, qd)) == []
    Mq = jax.jit(lambda q, qd: dynamics(small, arm_state(small, q, qd))[0])(q, qd)
    leaves = RMPVICES(small).leaves
    tree = rmp_vices_tree(small, leaves, setpoint, slots, Mq, 1.0, 0.5)
    root_leaves = [child for child in tree.children if not hasattr(child, "child")]
    assert untrue(tuple(root_leaves)) == []

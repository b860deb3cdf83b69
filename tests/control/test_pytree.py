"""The controller as a pytree, and under jit, on an arm that compiles fast."""

import copy
import dataclasses
import re
import typing
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from beartype.door import is_bearable
from jaxtyping import jaxtyped

from rmp_mjx import RMPVICES, VICES, Leaves, Obstacles, Robot, rmp_vices_literal
from rmp_mjx.control.cbf import FilteredVICES
from rmp_mjx.control.tree import rmp_vices_tree
from rmp_mjx.control.vices import OSC
from rmp_mjx.pytree import Pytree
from rmp_mjx.rmp import TaskMap, pushforward
from rmp_mjx.robot.dynamics import dynamics
from rmp_mjx.robot.kinematics import arm_state, site_state
from rmp_mjx.robot.point_state import point_state
from tests.robot.test_model import GRIPPER


@pytest.fixture(scope="module")
def small():
    return RMPVICES(Robot.from_mjcf(GRIPPER, site="tip", spacing=0.1))


@pytest.fixture(scope="module")
def near():
    return Obstacles.empty(spheres=2).with_spheres([[0.4, 0.0, 0.4]], [0.1])


@pytest.fixture(scope="module")
def traces():
    return []


@pytest.fixture(scope="module")
def torque(traces):
    """The controller as a jitted function of itself, counting its traces."""

    @jax.jit
    def torque(ctrl, q, qd, action, obstacles):
        traces.append(1)
        return ctrl(q, qd, ctrl.setpoint(q, ctrl.decode(action), 0.0), obstacles).tau

    return torque


STATE = (np.array([0.1, 0.5, -0.3], "f"), np.ones(3, "f"), np.full(12, 0.3, "f"))


def test_leaves_are_numbers_and_survive_a_round_trip(small, torque, near):
    leaves, structure = jax.tree.flatten(small)
    assert all(np.issubdtype(np.asarray(leaf).dtype, np.floating) for leaf in leaves)
    again = jax.tree.unflatten(structure, leaves)
    assert jax.tree.structure(again) == structure
    doubled = jax.tree.map(lambda x: 2.0 * x, small)
    assert doubled.regularizer == 2.0 * small.regularizer
    np.testing.assert_array_equal(
        torque(again, *STATE, near), torque(small, *STATE, near)
    )


def test_jit_equals_eager(small, torque, near):
    """1e-4 of the torque: float32, with other fusions. Without the branches that take
    longest to run operation by operation."""
    leaves = small.leaves.replace(self_collision=None, joint_limit=None)
    bare = small.replace(leaves=leaves)
    q, qd, action = (jnp.asarray(x) for x in STATE)
    eager = bare(q, qd, bare.setpoint(q, bare.decode(action), 0.0), near).tau
    compiled = torque(bare, *STATE, near)
    np.testing.assert_allclose(compiled, eager, rtol=1e-4, atol=1e-4)


def test_new_values_do_not_retrace(small, torque, near, traces):
    torque(small, *STATE, near)
    before = len(traces)
    q, qd, action = STATE
    torque(small, q + 1, qd - 1, -action, near)
    torque(small, q, qd, action, near.with_spheres(np.ones((2, 3)), 0.2))
    torque(small.replace(regularizer=1e-2), q, qd, action, near)
    leaf = small.leaves.collision.replace(mu=1e-2, cap=10.0)
    torque(small.with_collision(leaf), q, qd, action, near)
    assert len(traces) == before


def test_vmap_over_a_leaf_parameter_equals_a_loop(small, torque, near):
    """1e-5 relative: float32, with other fusions."""
    values = jnp.array([1e-5, 1e-3, 1e-1])

    def tuned(mu, eps):
        leaf = small.leaves.collision.replace(mu=mu)
        return small.with_collision(leaf).replace(regularizer=eps)

    def at(mu, eps):
        return torque.__wrapped__(tuned(mu, eps), *STATE, near)

    batch = jax.jit(jax.vmap(at))(values, 10 * values)
    loop = [torque(tuned(mu, 10 * mu), *STATE, near) for mu in values]
    np.testing.assert_allclose(batch, np.array(loop), rtol=1e-4, atol=1e-5)
    assert np.abs(np.diff(batch, axis=0)).max() > 1e-3


def test_vmap_over_states_equals_a_loop(small, torque, near):
    rng = np.random.default_rng(0)
    q, qd = (rng.normal(size=(4, 3)).astype("f") for _ in range(2))
    action = rng.uniform(-1, 1, (4, 12)).astype("f")
    many = jax.vmap(torque.__wrapped__, in_axes=(None, 0, 0, 0, None))
    batch = jax.jit(many)(small, q, qd, action, near)
    loop = [torque(small, *state, near) for state in zip(q, qd, action, strict=True)]
    # Float32 with other fusions, through the root's condition: 1e-3 of the arm's limits
    # of 8 N m (3e-3 N m was seen), as for nine in ten states in test_precision.
    np.testing.assert_allclose(batch, np.array(loop), rtol=1e-4, atol=8e-3)


def test_any_branch_can_be_left_out(small, near):
    """None takes a branch out; the output keeps its shape."""
    q = STATE[0]

    def output(ctrl):
        setpoint = ctrl.setpoint(q, ctrl.decode(STATE[2]), 0.0)
        return ctrl(q, q, setpoint, near)

    for leaves in (Leaves(), small.leaves.replace(collision=None)):
        bare = small.replace(leaves=leaves)
        assert len(jax.tree.leaves(bare)) < len(jax.tree.leaves(small))
        out = jax.eval_shape(output, bare)
        assert out.tau.shape == out.qdd.shape == (3,)


def test_an_arm_among_no_obstacles_has_infinite_clearance(small):
    q, qd, action = (jnp.asarray(x) for x in STATE)
    bare = small.replace(leaves=Leaves(collision=small.leaves.collision))

    @jax.jit
    def run(ctrl, q):
        setpoint = ctrl.setpoint(q, ctrl.decode(action), 0.0)
        return ctrl(q, qd, setpoint, Obstacles.empty())

    out = run(bare, q)
    assert np.isinf(out.diagnostics["clearance"]) and np.isfinite(out.tau).all()


# What JAX users do with a callable pytree.

CONTROLLERS = {
    "rmp_vices": RMPVICES,
    "vices": VICES,
    "vices_cbf": FilteredVICES,
    "osc": OSC,
    "rmp_vices_literal": rmp_vices_literal,
}


def in_a_scan(f):
    """Two control steps at one state, as the environments run them."""

    def loop(q, qd, setpoint, near):
        def step(state, _):
            return state, f(*state, setpoint, near).tau

        return jax.lax.scan(step, (q, qd), length=2)[1]

    return loop


TRANSFORMS = {
    "jit": jax.jit,
    "vmap": lambda f: jax.vmap(f, in_axes=(None, 0, None, None)),
    "jacobian": lambda f: lambda *args: jax.jacfwd(f)(*args).tau,
    "checkpoint": jax.checkpoint,
    "scan": in_a_scan,
}


@pytest.mark.parametrize("name", CONTROLLERS)
def test_transformations_take_a_controller_like_a_function(small, near, name):
    """They give the same program as with a function that calls it; so does a copy."""
    ctrl = CONTROLLERS[name](small.robot)
    q, qd, action = (jnp.asarray(x) for x in STATE)
    args = (q, jnp.stack([qd, qd]), ctrl.setpoint(q, ctrl.decode(action), 0.4), near)
    again = copy.deepcopy(ctrl)

    def plain(q, qd, setpoint, obstacles):
        return ctrl(q, qd, setpoint, obstacles)

    for how, transform in TRANSFORMS.items():
        given = args if how == "vmap" else (q, qd, *args[2:])

        def program(f, transform=transform, given=given):
            jaxpr = str(jax.make_jaxpr(transform(f))(*given))
            named = re.sub(r"<?unnamed function>?", "plain", jaxpr)
            return "".join(named.split())  # the name's length moves line breaks

        assert program(ctrl) == program(plain), how
        if how == "jit":
            assert program(again) == program(plain)


def test_a_scan_of_the_jitted_controller_gives_its_torque(small, near):
    """Run, not only traced. 1e-4: other fusions in float32."""
    q, qd, action = (jnp.asarray(x) for x in STATE)
    ctrl = small.replace(leaves=small.leaves.replace(self_collision=None))
    args = (q, qd, ctrl.setpoint(q, ctrl.decode(action), 0.4), near)
    tau = jax.jit(ctrl)(*args).tau
    scanned = jax.jit(in_a_scan(ctrl))(*args)
    np.testing.assert_allclose(scanned, [tau, tau], rtol=1e-4, atol=1e-4)


def test_a_gradient_by_the_controller_is_a_controller(small: Any, near):
    """Every parameter's derivative, at its place."""
    q, qd, action = (jnp.asarray(x) for x in STATE)
    leaves = small.leaves.replace(self_collision=None)
    ctrl = jax.tree.map(jnp.float32, small.replace(leaves=leaves))

    @jax.jit
    @jax.grad
    def slope(ctrl):
        setpoint = ctrl.setpoint(q, ctrl.decode(action), 0.4)
        return jnp.sum(ctrl(q, qd, setpoint, near).tau ** 2)

    found = slope(ctrl)
    assert type(found) is RMPVICES
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(found))
    assert found.regularizer != 0.0
    assert found.leaves.posture is not None and found.leaves.posture.kq != 0.0


def test_controllers_are_compared_by_value(small):
    again = RMPVICES(Robot.from_mjcf(GRIPPER, site="tip", spacing=0.1))
    assert again == small and hash(again) == hash(small)
    assert small.robot == again.robot and small.leaves == again.leaves
    assert small != small.replace(regularizer=1e-2)
    assert small != small.with_collision(None)
    assert small != VICES(small.robot)
    assert small.robot != small.robot.replace(q_home=small.robot.q_home + 1e-9)
    assert len({small, again, small.replace(dither=None)}) == 2


def test_a_controller_is_printed_in_a_few_lines(small):
    lines = repr(small).splitlines()
    assert len(lines) <= 12 and max(map(len, lines)) <= 90
    assert repr(small.robot).startswith("Robot('arm', 3 joints to site 'tip'")
    assert lines[1].strip() == f"robot={small.robot},"
    assert "collision=Barrier(mu=7e-05, eps=0.007, r=0.2" in repr(small)
    assert repr(VICES(small.robot)) == f"VICES(robot={small.robot})"
    relaxed = small.replace(dither=None, regularizer=np.float32(0.1))
    assert "dither=None" in repr(relaxed) and "regularizer=0.1" in repr(relaxed)

    @jax.jit
    def traced(ctrl):
        shown.append(repr(ctrl))
        return ctrl.regularizer

    shown = []
    traced(small)
    assert "regularizer=float32[]" in shown[0]


@pytest.mark.parametrize("kind", [RMPVICES, VICES, OSC, FilteredVICES])
def test_a_batch_of_controllers_calls_no_lapack(small, near, kind):
    """Batched LAPACK calls can wait for ever where several CPU devices make them."""
    ctrl = kind(small.robot)
    setpoint = jax.eval_shape(
        lambda q: ctrl.setpoint(q, ctrl.decode(jnp.zeros(12)), 0.0), jnp.zeros(3)
    )
    q, batch = (
        jax.ShapeDtypeStruct((4, 3), jnp.float32),
        jax.tree.map(lambda x: jax.ShapeDtypeStruct((4, *x.shape), x.dtype), setpoint),
    )
    program = jax.jit(jax.vmap(ctrl, in_axes=(0, 0, 0, None)))
    assert "lapack" not in program.lower(q, q, batch, near).as_text()


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
def slim():
    return Robot.from_mjcf(GRIPPER, site="tip", spacing=0.1)


def test_robots_and_controllers_are_as_annotated(robot, slim):
    for arm in (robot, slim):
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


def test_what_a_step_computes_is_as_annotated(slim):
    ctrl = VICES(slim)
    q, qd = jnp.array([0.1, 0.5, -0.3]), jnp.ones(3)
    action = ctrl.decode(jnp.full(12, 0.3))
    setpoint = ctrl.setpoint(q, action, 0.4)
    slots = Obstacles.empty(spheres=2, planes=1, capsules=1, boxes=1)

    @jax.jit
    def compute(q, qd):
        arm = arm_state(slim, q, qd)
        states = arm, site_state(slim, arm), point_state(slim, arm)
        moved = pushforward(TaskMap(jnp.cos), q, qd)
        return states, moved, ctrl(q, qd, setpoint, slots)

    assert untrue((action, setpoint)) == []
    assert untrue(compute(q, qd)) == []
    Mq = jax.jit(lambda q, qd: dynamics(slim, arm_state(slim, q, qd))[0])(q, qd)
    leaves = RMPVICES(slim).leaves
    tree = rmp_vices_tree(slim, leaves, setpoint, slots, Mq, 1.0, 0.5)
    root_leaves = [child for child in tree.children if not hasattr(child, "child")]
    assert untrue(tuple(root_leaves)) == []

"""The fast evaluation against the tree that defines it, in float64."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.common import AutodiffRMPVICES
from rmp_mjx import RMPVICES, Leaves, Node, Siblings, per_link
from rmp_mjx.control.tree import rmp_vices_tree
from rmp_mjx.rmp.leaves import PaperCollision, collision_near, collision_transit
from rmp_mjx.robot.dynamics import dynamics
from rmp_mjx.robot.kinematics import arm_state
from tests.control.conftest import QUICK

quick_jit = functools.partial(jax.jit, compiler_options=QUICK)


@pytest.fixture(scope="module")
def inputs(states, obstacles):
    return *states(0), obstacles(0)


@pytest.fixture(scope="module")
def fast(run64, ctrl, inputs):
    return run64(ctrl, *inputs)


@pytest.fixture(scope="module")
def varied(robot):
    """A leaf for each kind of obstacle, one of them other for each link."""
    near = collision_near()
    return {
        "spheres": collision_transit(),
        "planes": near.replace(margin=per_link(robot, 5e-3 * np.arange(7.0))),
        "capsules": None,
        "boxes": PaperCollision(cap=1e3),
    }


def test_closed_form_is_the_autodiff_tree(run64, robot, inputs, varied):
    """500 states, all kinds of obstacles moving and turning, in contact or near.

    1e-9 of the largest entry: rounding of metrics that span 1e6. The acceleration gets
    the root's condition on top: 1e-7 of its largest entry.
    """
    leaves = Leaves.default(robot).with_collision(varied)
    fast = run64(RMPVICES(robot, leaves), *inputs)
    slow = run64(AutodiffRMPVICES(robot, leaves), *inputs)
    assert np.quantile(fast.diagnostics["clearance"], [0.1, 0.9]).tolist() < [0.0, 0.2]
    weight = fast.diagnostics["orientation_weight"]
    assert weight.max() > 50 * weight.min()
    for name, tolerance in (("f", 1e-9), ("M", 1e-9), ("qdd", 1e-7), ("tau", 1e-7)):
        a, b = (getattr(out, name).reshape(len(inputs[0]), -1) for out in (fast, slow))
        scale = np.abs(b).max(axis=1, keepdims=True) + 1e-6
        assert np.max(np.abs(a - b) / scale) < tolerance, name


@pytest.mark.parametrize("push", [3.0, 300.0])
def test_closed_form_is_the_autodiff_tree_in_contact(run64, robot, inputs, push):
    """Random contact torques, small ones and some beyond the cap: 1e-9 likewise."""
    rng = np.random.default_rng(1)
    tau_ext = push * rng.normal(size=(len(inputs[0]), 7)) * robot.tau_max / 30.5
    fast = run64(RMPVICES(robot), *inputs, tau_ext)
    slow = run64(AutodiffRMPVICES(robot), *inputs, tau_ext)
    alone = run64(RMPVICES(robot), *inputs)
    for name, tolerance in (("f", 1e-9), ("M", 1e-9), ("qdd", 1e-7), ("tau", 1e-7)):
        a, b, c = (
            getattr(out, name).reshape(len(inputs[0]), -1)
            for out in (fast, slow, alone)
        )
        scale = np.abs(b).max(axis=1, keepdims=True) + 1e-6
        assert np.max(np.abs(a - b) / scale) < tolerance, name
        assert np.max(np.abs(a - c) / scale) > 1e-3, name


def test_one_leaf_is_the_same_leaf_for_every_kind(robot, inputs, fast):
    """To rounding: 1e-9 of the largest entry."""
    near, n = collision_near(), len(robot.points.segment)
    each = {"boxes": near, "planes": near.replace(mu=np.full(n, near.mu))}
    split: Any = RMPVICES(robot).with_collision(each)
    assert split.leaves.collision["spheres"] == near
    for k in range(3):
        q, qd, action, obstacles = jax.tree.map(lambda x, k=k: x[k], inputs)
        with jax.enable_x64(True):
            out = jax.device_get(
                split(q, qd, split.setpoint(q, split.decode(action), 0.0), obstacles)
            )
        np.testing.assert_allclose(
            out.M, fast.M[k], rtol=0, atol=1e-9 * np.abs(fast.M[k]).max()
        )


def test_unknown_kind_of_obstacle_is_refused(robot):
    with pytest.raises(ValueError, match=r"spheres, planes, capsules, boxes.*Did you"):
        RMPVICES(robot).with_collision({"sphere": collision_near()})


def _coordinates(node, x, t):
    """All leaves below a node with their coordinates, siblings stacked: values only."""
    if isinstance(node, Siblings):
        axes = jax.tree.map(lambda a: 0 if jnp.ndim(a) else None, node.child)
        return jax.vmap(_coordinates, in_axes=(axes, None, None))(node.child, x, t)
    if isinstance(node, Node):
        y = node.psi.at_time(x, t)
        return [found for child in node.children for found in _coordinates(child, y, t)]
    return [(node, x)]


def test_acceleration_is_that_of_the_flattened_least_squares(run64, robot, inputs):
    """min sum |J_i qdd + c_i - a_i|^2_{M_i} + eps |qdd|^2_{Mq} by numpy's lstsq.

    One Jacobian of all leaf coordinates stacked, no message passing. 1e-7 relative:
    row weights span six orders. The motors have no limits.
    """
    ctrl = RMPVICES(robot.replace(tau_max=np.full(7, 1e12)))
    fast = run64(ctrl, *inputs)

    @quick_jit
    def leaf_terms(ctrl, q, qd, action, obstacles):
        Mq, _ = dynamics(ctrl.robot, arm_state(ctrl.robot, q, qd))
        setpoint = ctrl.setpoint(q, ctrl.decode(action), 0.0)
        weight = ctrl(q, qd, setpoint, obstacles).diagnostics["orientation_weight"]
        tree = rmp_vices_tree(
            ctrl.robot, ctrl.leaves, setpoint, obstacles, Mq, 1.0, weight
        )

        def values(q, t):
            return [y for _, y in _coordinates(tree, q, t)]

        def rates(s):
            return jax.jvp(lambda s: values(q + s * qd, s), (s,), (1.0,))

        (_, yd), (_, ydd) = jax.jvp(rates, (0.0,), (1.0,))
        J = jax.jacfwd(values)(q, 0.0)
        terms = []
        for (leaf, x), xd, c, j in zip(
            _coordinates(tree, q, 0.0), yd, ydd, J, strict=True
        ):
            evaluate = type(leaf).__call__
            for _ in range(x.ndim - 1):
                axes = jax.tree.map(lambda a: 0 if jnp.ndim(a) else None, leaf)
                evaluate = jax.vmap(evaluate, in_axes=(axes, 0, 0))
            terms.append((j, c, evaluate(leaf, x, xd)))
        return Mq, terms

    eps = ctrl.regularizer
    for k in range(10):
        q, qd, action, obstacles = jax.tree.map(lambda x, k=k: x[k], inputs)
        with jax.enable_x64(True):
            Mq, terms = jax.device_get(leaf_terms(ctrl, q, qd, action, obstacles))
        rows, rhs = [np.sqrt(eps) * np.linalg.cholesky(Mq).T], [np.zeros(7)]
        for J, c, rmp in terms:
            m = c.shape[-1]
            for j, curve, f, M in zip(
                J.reshape(-1, m, 7),
                c.reshape(-1, m),
                rmp.f.reshape(-1, m),
                rmp.M.reshape(-1, m, m),
                strict=True,
            ):
                values, vectors = np.linalg.eigh(M)
                keep = values > 1e-12 * max(values.max(), 1e-30)
                root = np.sqrt(values[keep])[:, None] * vectors[:, keep].T
                wanted = vectors[:, keep].T @ f / np.sqrt(values[keep])
                rows.append(root @ j)
                rhs.append(wanted - root @ curve)
        expected = np.linalg.lstsq(np.concatenate(rows), np.concatenate(rhs))[0]
        np.testing.assert_allclose(
            fast.qdd[k], expected, rtol=0.0, atol=1e-7 * np.abs(expected).max()
        )


def test_every_branch_matters(run64, ctrl, inputs, fast):
    """Weakening any leaf changes the torque: none is dead in the comparison above."""
    leaves = ctrl.leaves
    for name, changed in (
        ("collision", leaves.collision.replace(mu=1e-9)),
        ("self_collision", leaves.self_collision.replace(mu=1.0)),
        ("posture", leaves.posture.replace(kq=1.0)),
    ):
        out = run64(ctrl.replace(leaves=leaves.replace(**{name: changed})), *inputs)
        assert np.abs(out.M - fast.M).max() + np.abs(out.f - fast.f).max() > 1e-6, name
    for name in ("obstacle_relaxation", "limit_relaxation"):
        relaxed = getattr(ctrl, name).replace(min_weight=0.5)
        out = run64(ctrl.replace(**{name: relaxed}), *inputs)
        assert np.abs(out.M - fast.M).max() + np.abs(out.f - fast.f).max() > 1e-6, name

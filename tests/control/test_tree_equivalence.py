"""The fast evaluation against the tree that defines it, in float64."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.common import AutodiffRMPVICES
from rmp_mjx import (
    RMPVICES,
    Leaves,
    Node,
    Siblings,
    TaskMap,
    WeightedActionRange,
    per_link,
)
from rmp_mjx.control.tree import rmp_vices_tree
from rmp_mjx.rmp.leaves import PaperCollision, collision_near, collision_transit
from rmp_mjx.robot.dynamics import dynamics
from rmp_mjx.robot.kinematics import arm_state, point_positions, site_state
from tests.control.conftest import fresh


class Definition(AutodiffRMPVICES):
    """The tree behind a closed form whose results are spoilt: it takes none of them."""

    def unguarded(self, *args, **kwargs):
        """What the closed form gives, and wrong."""
        out = super().unguarded(*args, **kwargs)
        f, M, qdd = out.f + 1.0, out.M + 1.0, out.qdd + 1.0
        return out.replace(f=f, M=M, qdd=qdd, tau=0.5 * out.tau)


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
    slow = run64(Definition(robot, leaves), *inputs)
    assert np.quantile(fast.diagnostics["clearance"], [0.1, 0.9]).tolist() < [0.0, 0.2]
    weight = fast.diagnostics["orientation_weight"]
    assert weight.max() > 50 * weight.min()
    for name, tolerance in (("f", 1e-9), ("M", 1e-9), ("qdd", 1e-7), ("tau", 1e-7)):
        a, b = (getattr(out, name).reshape(len(inputs[0]), -1) for out in (fast, slow))
        scale = np.abs(b).max(axis=1, keepdims=True) + 1e-6
        assert np.max(np.abs(a - b) / scale) < tolerance, name


def test_the_closed_form_evaluates_no_task_map(monkeypatch, ctrl, robot, inputs):
    """So the tests above compare two programs, not one with itself."""

    def refuse(*args):
        raise AssertionError("a task map is evaluated")

    monkeypatch.setattr(TaskMap, "_at", refuse)
    q, qd, action, obstacles = jax.tree.map(lambda x: x[0], inputs)
    setpoint = ctrl.setpoint(q, ctrl.decode(action), 0.0)
    args = q, qd, setpoint, obstacles
    jax.eval_shape(fresh(ctrl), *args)
    with pytest.raises(AssertionError, match="a task map is evaluated"):
        jax.eval_shape(fresh(Definition(robot)), *args)


def with_weights(inputs, entries):
    """The inputs with three more entries in every action."""
    q, qd, action, obstacles = inputs
    entries = np.broadcast_to(entries, (len(q), 3))
    return q, qd, np.concatenate([action, entries], axis=1), obstacles


@pytest.fixture(scope="module")
def weighted(robot):
    return RMPVICES(robot, action_range=WeightedActionRange())


@pytest.mark.parametrize("push", [3.0, 300.0])
def test_closed_form_is_the_autodiff_tree_in_contact_and_weighed(
    run64, robot, inputs, varied, weighted, push
):
    """Random weights, and contact torques that are small or beyond the cap.

    The tolerances of `test_closed_form_is_the_autodiff_tree`. Both matter.
    """
    rng = np.random.default_rng(1)
    count = len(inputs[0])
    tau_ext = push * rng.normal(size=(count, 7)) * robot.tau_max / 30.5
    args = with_weights(inputs, rng.uniform(-1.0, 1.0, (count, 3)))
    leaves = Leaves.default(robot).with_collision(varied)
    closed = weighted.replace(leaves=leaves)
    fast = run64(closed, *args, tau_ext)
    alone = run64(closed, *args, 0.0 * tau_ext)
    even = run64(closed, *with_weights(inputs, 0.0), tau_ext)
    kind = Definition(robot, leaves, action_range=WeightedActionRange())
    slow = run64(kind, *args, tau_ext)
    for name, tolerance in (("f", 1e-9), ("M", 1e-9), ("qdd", 1e-7), ("tau", 1e-7)):
        a, b, *others = (
            getattr(out, name).reshape(count, -1) for out in (fast, slow, alone, even)
        )
        scale = np.abs(b).max(axis=1, keepdims=True) + 1e-6
        assert np.max(np.abs(a - b) / scale) < tolerance, name
        for other in others:
            assert np.max(np.abs(a - other) / scale) > 1e-3, name


def test_a_policy_that_weighs_nothing_has_the_default_tree(
    run64, inputs, fast, weighted
):
    """To rounding: multiplications by 1 and additions of 0."""
    out = run64(weighted, *with_weights(inputs, 0.0))
    for name in ("f", "M"):
        a, b = getattr(out, name), getattr(fast, name)
        np.testing.assert_allclose(a, b, rtol=0.0, atol=1e-9 * np.abs(b).max())


def test_a_policys_weights_leave_the_safety_leaves_on_top(run64, inputs, weighted):
    r"""The bound of `WeightedActionRange`: what is not a safety leaf stays light.

    With standoff 0 the metrics of any two choices differ by attractors and posture
    alone. Between the extremes every metric is ordered (positive semidefinite up to
    rounding, 1e-9 of the largest entry), and no choice is heavier than the default by
    more than nine times the posture, at most 0.18 of the inertia.
    """

    def metric(*entries):
        return run64(weighted, *with_weights(inputs, np.array(entries)))

    default, heavy, light = metric(0, 0, 0), metric(1, 1, 0), metric(-1, -1, 0)
    some = metric(-0.4, 0.7, 0)
    scale = np.abs(default.M).max(axis=(1, 2))

    def ordered(above, below):
        assert np.all(np.linalg.eigvalsh(above - below)[:, 0] > -1e-9 * scale)

    for one in (default, some):
        ordered(heavy.M, one.M)
        ordered(one.M, light.M)
    ordered(default.M + 0.18 * default.Mq, heavy.M)
    # A standoff only adds to the metrics of bodies that are not yet at the cap.
    wide = metric(0, 0, 1)
    assert np.mean(np.trace(wide.M - default.M, axis1=1, axis2=2) > 0.0) > 0.5


def test_the_heaviest_posture_takes_little_from_a_safety_leaf_at_its_cap(ctrl):
    """The table of docs/controller.md: shares that are missing, by link.

    Pushes in random directions on all control points, 300 poses about home.
    """
    robot, rng = ctrl.robot, np.random.default_rng(0)
    q = robot.q_home + rng.uniform(-0.8, 0.8, (300, 7))

    @jax.jit
    @jax.vmap
    def parts(q):
        arm = arm_state(robot, q, jnp.zeros(7))
        site, (Mq, _) = site_state(robot, arm), dynamics(robot, arm)
        J = jax.jacfwd(lambda q: point_positions(robot, q))(q)
        return J, site.J_pos.T @ site.J_pos, site.J_ori.T @ site.J_ori, Mq

    with jax.enable_x64(True):
        J, position, orientation, Mq = jax.device_get(parts(q))
    n = rng.normal(size=J.shape[:3])
    g = np.einsum("bpi,bpij->bpj", n / np.linalg.norm(n, axis=2, keepdims=True), J)
    segment = np.array(robot.points.segment)

    def missing(link, attractor, posture, percentile):
        H = attractor * (position + 1e-3 * orientation)
        H += (0.02 * posture + ctrl.regularizer) * Mq
        solved = np.linalg.solve(H, np.swapaxes(g, 1, 2))
        share = 1.0 / (1.0 + 1e3 * np.einsum("bpj,bjp->bp", g, solved))
        return np.percentile(share[:, segment == link], percentile)

    table = {
        (1.0, 1.0): [(5e-4, 0.05), (2e-4, 1e-3), (1e-3, 1e-3)],
        (0.1, 1.0): [(3e-4, 0.03), (2e-4, 5e-4), (2e-4, 4e-4)],
        (1.0, 10.0): [(3e-3, 0.24), (1e-3, 4e-3), (2e-3, 3e-3)],
    }
    for (attractor, posture), row in table.items():
        for link, shares in zip((2, 4, 6), row, strict=True):
            found = [missing(link, attractor, posture, p) for p in (50, 99)]
            # as rounded there, and other poses may be drawn
            np.testing.assert_allclose(found, shares, rtol=0.5)


def test_one_leaf_is_the_same_leaf_for_every_kind(run64, robot, inputs, fast):
    """To rounding: 1e-9 of the largest entry."""
    near, n = collision_near(), len(robot.points.segment)
    each = {"boxes": near, "planes": near.replace(mu=np.full(n, near.mu))}
    split: Any = RMPVICES(robot).with_collision(each)
    assert split.leaves.collision["spheres"] == near
    out = run64(split, *inputs)
    scale = np.abs(fast.M).max(axis=(1, 2), keepdims=True)
    assert np.max(np.abs(out.M - fast.M) / scale) < 1e-9


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

    @jax.jit
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

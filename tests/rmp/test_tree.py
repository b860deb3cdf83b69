"""The tree against two independent formulations of the same problem, in float64.

The test bed is a three-joint arm with every kind of node: shared and nested siblings, a
moving obstacle, vector, matrix and scalar coordinates.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rmp_mjx.math import exp_so3, safe_norm
from rmp_mjx.rmp import leaves
from rmp_mjx.rmp.algebra import resolve
from rmp_mjx.rmp.taskmap import TaskMap, identity_map
from rmp_mjx.rmp.tree import Node, Siblings, evaluate
from tests.rmp.outside import Drag, GeodesicBarrier

pytestmark = pytest.mark.usefixtures("x64")

AXES = np.array([[0, 0, 1], [0, 1, 0], [0.6, 0, 0.8]], float)
SKEW = -np.cross(np.eye(3), AXES[:, None], axis=-1).swapaxes(1, 2)
N = len(AXES)


def _pose(q):
    """End orientation and position of a chain of hinges 0.3 m apart."""
    R, p = jnp.eye(3), jnp.zeros(3)
    for i in range(N):
        K = SKEW[i]
        R = R + R @ (jnp.sin(q[i]) * K + (1.0 - jnp.cos(q[i])) * (K @ K))
        p = p + R @ jnp.asarray([0.0, 0.05, 0.3])
    return R, p


def _frame(q):
    """The same pose as one coordinate of twelve numbers."""
    R, p = _pose(q)
    return jnp.concatenate([R.reshape(9), p])


def _position(frame):
    return frame[9:]


def _tip(q):
    return _position(_frame(q))


def _orientation(frame):
    return frame[:9]


def _axis(frame):
    return frame[2:9:3]


def _point(offset, frame):
    return frame[9:] + frame[:9].reshape(3, 3) @ offset


def _distance(params, x):
    return safe_norm(x - params["center"]) - params["radius"]


def _spheres(rng, count):
    return {
        "center": jnp.asarray(rng.normal(size=(count, 3))),
        "radius": jnp.full(count, 0.05),
    }


def _obstacles(rng):
    barrier = leaves.Barrier(mu=0.1, r=3.0, eps=0.3)
    gds = GeodesicBarrier(mu=0.1, eps=0.1, alpha=0.3)
    spheres = TaskMap(_distance, _spheres(rng, 2), _spheres(rng, 2))
    return Siblings(Node(spheres, (barrier, gds)))


def _joint_leaves():
    lower = jnp.asarray([-1.0, -jnp.inf, -2.0])
    upper = jnp.asarray([1.0, jnp.inf, jnp.inf])
    posture = leaves.Posture(jnp.zeros(N), weight=0.3)
    return posture, leaves.JointLimitBarrier(lower, upper), Drag(2.0, 0.3)


def _tree():
    rng = np.random.default_rng(0)
    # Nested siblings: each point has its own copy of the obstacles.
    copies = jax.tree.map(
        lambda x: jnp.stack([x, x]) if jnp.ndim(x) else x, _obstacles(rng)
    )
    offsets = jnp.asarray(rng.normal(size=(2, 3)))
    R_des = exp_so3(jnp.asarray([0.3, 0.5, -0.2]))
    kp = jnp.asarray([50.0, 80.0, 20.0])
    position = leaves.PositionAttractor(jnp.asarray([0.4, 0.2, 0.9]), kp)
    orientation = leaves.OrientationAttractor(R_des, kp)
    axis = leaves.PositionAttractor(jnp.asarray([0.6, 0.0, 0.8]), 100.0)
    end = Node(
        TaskMap(_frame),
        (
            Node(TaskMap(_position), (position,)),
            Node(TaskMap(_orientation), (orientation,)),
            Node(TaskMap(_axis), (axis,)),
            Siblings(Node(TaskMap(_point, offsets), (copies,))),
        ),
    )
    return Node(identity_map(), (*_joint_leaves(), end))


def _small_tree():
    position = leaves.PositionAttractor(jnp.asarray([0.4, 0.2, 0.9]), 100.0)
    end = Node(
        TaskMap(_tip),
        (position, _obstacles(np.random.default_rng(0))),
    )
    return Node(identity_map(), (*_joint_leaves(), end))


@pytest.fixture(scope="module")
def tree():
    with jax.enable_x64(True):
        return _tree()


@pytest.fixture(scope="module")
def small():
    """A tree that compiles faster, where the point is not the maths of its leaves."""
    with jax.enable_x64(True):
        return _small_tree()


@pytest.fixture(scope="module")
def states():
    """Ten random states, joints within their limits, (10, N) each."""
    rng = np.random.default_rng(1)
    return rng.uniform(-0.9, 0.9, size=(10, N)), rng.normal(size=(10, N))


@pytest.fixture(scope="module")
def run():
    """The tree evaluator, compiled once per tree structure."""
    return jax.jit(evaluate)


def _unrolled(node, x, t):
    """Every leaf with its coordinate at ``x``, seconds ``t`` from now.

    Values only, siblings unrolled by plain indexing: shares nothing with `evaluate` but
    the task maps' own functions.
    """
    if isinstance(node, Siblings):
        arrays = [leaf for leaf in jax.tree.leaves(node.child) if jnp.ndim(leaf)]
        for k in range(arrays[0].shape[0]):
            one = jax.tree.map(lambda a, k=k: a[k] if jnp.ndim(a) else a, node.child)
            yield from _unrolled(one, x, t)
    elif isinstance(node, Node):
        y = node.psi.at_time(x, t)
        for child in node.children:
            yield from _unrolled(child, y, t)
    else:
        yield node, x


def _flat(tree, q):
    """The leaves, their slices, and psi(q, t): all leaf coordinates in one vector."""
    found = list(_unrolled(tree, q, 0.0))
    ends = np.cumsum([x.shape[0] for _, x in found])
    slices = [slice(e - x.shape[0], e) for e, (_, x) in zip(ends, found, strict=True)]

    def psi(q, t):
        return jnp.concatenate([x for _, x in _unrolled(tree, q, t)])

    return [leaf for leaf, _ in found], slices, psi


def test_tree_is_the_flattened_weighted_least_squares_problem(tree, states):
    """min sum |J_i qdd + c_i - a_i|^2_{M_i} + |qdd - qdd_0|^2_W by numpy's lstsq."""
    rng = np.random.default_rng(2)
    G = rng.normal(size=(N, N))
    W = 0.1 * (G @ G.T + np.eye(N))

    @jax.jit
    def leaf_terms(tree, q, qd):
        found, slices, psi = _flat(tree, q)

        def moved(s):
            return psi(q + s * qd, s)

        y, yd = jax.jvp(moved, (0.0,), (1.0,))
        ydd = jax.jvp(lambda s: jax.jvp(moved, (s,), (1.0,))[1], (0.0,), (1.0,))[1]
        J = jax.jacrev(psi)(q, 0.0)
        rmps = [leaf(y[s], yd[s]) for leaf, s in zip(found, slices, strict=True)]
        return [
            (J[s], ydd[s], rmp.f, rmp.M) for rmp, s in zip(rmps, slices, strict=True)
        ]

    @jax.jit
    def solve(tree, q, qd, qdd_0):
        return resolve(evaluate(tree, q, qd), jnp.asarray(W), qdd_0)

    for q, qd in zip(*states, strict=True):
        qdd_0 = rng.normal(size=N)
        rows, rhs = [np.linalg.cholesky(W).T], [np.linalg.cholesky(W).T @ qdd_0]
        terms = jax.device_get(leaf_terms(tree, q, qd))
        assert len(terms) == 6 + 2 * 2 * 2
        for J, c, f, M in terms:
            values, vectors = np.linalg.eigh(M)
            root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
            a = np.linalg.pinv(M, rcond=1e-12, hermitian=True) @ f
            rows.append(root @ J)
            rhs.append(root @ (a - c))
        expected = np.linalg.lstsq(np.concatenate(rows), np.concatenate(rhs))[0]
        # 1e-10 relative: metrics from 0.1 to 1e3 square to a condition of about 1e5.
        np.testing.assert_allclose(
            solve(tree, q, qd, qdd_0),
            expected,
            atol=1e-10 * np.abs(expected).max(),
        )


def test_tree_is_the_rmp2_style_reverse_mode_evaluation(tree, states, run):
    """Root force and metric as reverse-mode gradients of scalar auxiliary functions.

    After Li et al., "RMP2" (2021): no message passing, only vector-Jacobian products
    of the whole maps; velocity and curvature by the double-vjp trick.
    """

    def forward(psi, x, v):
        """J(x) v from two reverse passes."""
        y, vjp = jax.vjp(psi, x)
        return jax.vjp(lambda u: vjp(u)[0], jnp.zeros_like(y))[1](v)[0]

    @jax.jit
    def rmp2(tree, q, qd):
        found, slices, whole = _flat(tree, q)
        state, rate = jnp.append(q, 0.0), jnp.append(qd, 1.0)

        def psi(s):
            return whole(s[:-1], s[-1])

        y, yd = psi(state), forward(psi, state, rate)
        ydd = forward(lambda s: forward(psi, s, rate), state, rate)
        rmps = [leaf(y[s], yd[s]) for leaf, s in zip(found, slices, strict=True)]

        def work(q):
            parts = [
                jnp.dot(rmp.f - rmp.M @ ydd[s], whole(q, 0.0)[s])
                for rmp, s in zip(rmps, slices, strict=True)
            ]
            return sum(parts)

        def kinetic(v):  # a quadratic form: its gradients are the metric's rows
            yv = forward(psi, state, jnp.append(v, 0.0))
            parts = [
                0.5 * yv[s] @ rmp.M @ yv[s] for rmp, s in zip(rmps, slices, strict=True)
            ]
            return sum(parts)

        return jax.grad(work)(q), jax.vmap(jax.grad(kinetic))(jnp.eye(N))

    for q, qd in zip(states[0][:4], states[1][:4], strict=True):
        f, M = rmp2(tree, q, qd)
        ours = run(tree, q, qd)
        # 1e-10 of the largest entry: rounding of sums of up to 14 terms.
        np.testing.assert_allclose(ours.f, f, atol=1e-10 * np.abs(f).max())
        np.testing.assert_allclose(ours.M, M, atol=1e-10 * np.abs(M).max())


def _same(run, a, b, states):
    for q, qd in zip(states[0][:3], states[1][:3], strict=True):
        left, right = run(a, q, qd), run(b, q, qd)
        scale = float(jnp.abs(left.M).max() + jnp.abs(left.f).max())
        # 1e-13 of the largest entry: only the order of additions differs.
        np.testing.assert_allclose(left.f, right.f, atol=1e-13 * scale)
        np.testing.assert_allclose(left.M, right.M, atol=1e-13 * scale)


def test_permuting_children_changes_nothing(small, states, run):
    _same(run, small, small.replace(children=small.children[::-1]), states)


def test_giving_each_child_its_own_node_changes_nothing(small, states, run):
    regrouped = Node(
        identity_map(),
        tuple(Node(identity_map(), (child,)) for child in small.children),
    )
    _same(run, small, regrouped, states)


def test_splitting_an_edge_in_two_changes_nothing(states, run):
    rng = np.random.default_rng(3)
    position = TaskMap(_tip)
    distance = TaskMap(
        _distance,
        {"center": jnp.asarray(rng.normal(size=3)), "radius": jnp.asarray(0.1)},
        {"center": jnp.asarray(rng.normal(size=3)), "radius": jnp.asarray(0.0)},
    )
    leaf = GeodesicBarrier(eps=0.1)
    split = Node(position, (Node(distance, (leaf,)),))
    whole = distance.replace(fn=lambda params, q: _distance(params, _tip(q)))
    _same(run, split, Node(whole, (leaf,)), states)


def test_duplicating_a_leaf_with_half_the_metric_changes_nothing(states, run):
    target = leaves.PositionAttractor(jnp.asarray([0.4, 0.2, 0.9]), 100.0, weight=1.0)
    half = target.replace(weight=0.5)
    position = TaskMap(_tip)
    _same(run, Node(position, (target,)), Node(position, (half, half)), states)


def test_siblings_are_the_sum_of_their_members(states, run):
    members = [
        Node(TaskMap(_point, jnp.asarray(offset)), (Drag(2.0),))
        for offset in np.random.default_rng(4).normal(size=(3, 3))
    ]
    stacked = Node(TaskMap(_frame), (Siblings.stack(members),))
    _same(run, stacked, Node(TaskMap(_frame), tuple(members)), states)


def test_evaluation_under_vmap_equals_a_loop(small, states, run):
    batch = jax.jit(jax.vmap(evaluate, in_axes=(None, 0, 0)))(small, *states)
    for i in range(3):
        one = run(small, states[0][i], states[1][i])
        # 1e-12 of the largest entry: other summation orders.
        scale = float(jnp.abs(one.M).max() + jnp.abs(one.f).max())
        np.testing.assert_allclose(batch.f[i], one.f, atol=1e-12 * scale)
        np.testing.assert_allclose(batch.M[i], one.M, atol=1e-12 * scale)


def test_a_new_value_of_any_parameter_does_not_retrace(small, states):
    traces = []

    @jax.jit
    def f(small, q, qd):
        traces.append(1)
        return evaluate(small, q, qd)

    small = jax.tree.map(jnp.asarray, small)
    f(small, states[0][0], states[1][0])
    f(jax.tree.map(lambda x: 1.1 * x, small), states[0][1], states[1][1])
    assert len(traces) == 1


def test_gradients_by_all_parameters_and_the_state_are_finite(small, states):
    @jax.jit
    def gradients(small, q, qd):
        def total(small, q, qd):
            rmp = evaluate(small, q, qd)
            return jnp.sum(resolve(rmp, 0.1 * jnp.eye(N)))

        return jax.grad(total, argnums=(0, 1, 2))(small, q, qd)

    small = jax.tree.map(jnp.asarray, small)
    for q, qd in [(states[0][0], states[1][0]), (np.zeros(N), np.zeros(N))]:
        for leaf in jax.tree.leaves(gradients(small, q, qd)):
            assert np.all(np.isfinite(leaf))


def test_a_node_without_children_contributes_nothing(states):
    rmp = evaluate(Node(TaskMap(_frame), ()), *map(jnp.asarray, np.zeros((2, N))))
    assert not np.any(rmp.f)
    assert not np.any(rmp.M)


def test_siblings_without_a_stacked_array_are_refused():
    with pytest.raises(ValueError, match="leading axis"):
        evaluate(Siblings(Drag(1.0)), jnp.zeros(2), jnp.zeros(2))
    with pytest.raises(ValueError, match="at least one"):
        Siblings.stack([])


def test_orientation_leaf_pulls_back_to_the_angular_velocity_policy(states, run):
    """The nine-dimensional embedding equals J_w, Jdot_w qd and the 3-D attractor."""
    R_des = exp_so3(jnp.asarray([0.3, 0.5, -0.2]))
    kp = jnp.asarray([50.0, 80.0, 20.0])
    leaf = leaves.OrientationAttractor(R_des, kp, weight=0.7)
    node = Node(TaskMap(lambda q: _orientation(_frame(q))), (leaf,))

    def rotation(q):
        return _pose(q)[0]

    def omega(q, qd):
        R, Rd = jax.jvp(rotation, (q,), (qd,))
        S = Rd @ R.T
        return jnp.stack([S[2, 1], S[0, 2], S[1, 0]])

    @jax.jit
    def expected(q, qd):
        w, J = omega(q, qd), jax.jacfwd(omega, 1)(q, qd)
        bias = jax.jvp(lambda q: omega(q, qd), (q,), (qd,))[1]
        rmp = leaves.orientation_attractor(rotation(q), w, R_des, kp, weight=0.7)
        return J.T @ (rmp.f - rmp.M @ bias), J.T @ rmp.M @ J

    for q, qd in zip(states[0][:3], states[1][:3], strict=True):
        ours, (f, M) = run(node, q, qd), expected(q, qd)
        # 1e-11: rounding; forces are of order 1e2.
        np.testing.assert_allclose(ours.f, f, atol=1e-11)
        np.testing.assert_allclose(ours.M, M, atol=1e-11)

"""The tree against two independent formulations of the same problem, in float64.

The test bed is a five-joint arm with every kind of node: shared and nested siblings, a
moving obstacle, vector, matrix and scalar coordinates.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rmp_mjx.math import exp_so3, safe_norm
from rmp_mjx.rmp import leaves
from rmp_mjx.rmp.algebra import resolve
from rmp_mjx.rmp.taskmap import TaskMap, compose, identity_map
from rmp_mjx.rmp.tree import Node, Siblings, evaluate

pytestmark = pytest.mark.usefixtures("x64")

AXES = np.array([[0, 0, 1], [0, 1, 0], [1, 0, 0], [0, 1, 0], [0.6, 0, 0.8]], float)
N = len(AXES)


def _pose(q):
    """End orientation and position of a chain of hinges 0.3 m apart."""
    R, p = jnp.eye(3), jnp.zeros(3)
    for i in range(N):
        R = R @ exp_so3(q[i] * AXES[i])
        p = p + R @ jnp.asarray([0.0, 0.05, 0.3])
    return R, p


def _position(q):
    return _pose(q)[1]


def _orientation(q):
    return _pose(q)[0]


def _axis(q):
    return _pose(q)[0][:, 2]


def _point(offset, q):
    R, p = _pose(q)
    return p + R @ offset


def _distance(params, x):
    return safe_norm(x - params["center"]) - params["radius"]


def _spheres(rng, count):
    return {
        "center": jnp.asarray(rng.normal(size=(count, 3))),
        "radius": jnp.full(count, 0.05),
    }


def _tree():
    rng = np.random.default_rng(0)
    barrier = leaves.Barrier(mu=0.1, r=3.0, eps=0.3)
    obstacle = Siblings(
        Node(
            TaskMap(_distance, _spheres(rng, 3), _spheres(rng, 3)),
            (barrier, leaves.GDSCollision(mu=0.1, eps=0.1, alpha=0.3)),
        )
    )
    points = Siblings(
        Node(
            TaskMap(_point, jnp.asarray(rng.normal(size=(2, 3)))),
            # Nested siblings: per point, its own copy of the obstacles.
            (jax.tree.map(lambda x: jnp.stack([x, x]) if jnp.ndim(x) else x, obstacle),),
        )
    )
    limit = leaves.JointLimitBarrier(
        jnp.asarray([-1.0, -jnp.inf, -2.0, -1.0, -3.0]),
        jnp.asarray([1.5, jnp.inf, jnp.inf, 1.0, 3.0]),
    )
    R_des = exp_so3(jnp.asarray([0.3, 0.5, -0.2]))
    kp = jnp.asarray([50.0, 80.0, 20.0])
    return Node(
        identity_map(),
        (
            leaves.Posture(jnp.zeros(N), weight=0.3),
            limit,
            leaves.VelocityCap(0.8),
            Node(
                TaskMap(_position),
                (leaves.PositionAttractor(jnp.asarray([0.4, 0.2, 0.9]), kp),),
            ),
            Node(TaskMap(_orientation), (leaves.OrientationAttractor(R_des, kp),)),
            Node(TaskMap(_axis), (leaves.AxisTarget(jnp.asarray([1.0, 0.0, 1.0])),)),
            points,
        ),
    )


@pytest.fixture(scope="module")
def tree():
    with jax.enable_x64(True):
        return _tree()


@pytest.fixture(scope="module")
def states():
    """Ten random states, joints within their limits, (10, N) each."""
    rng = np.random.default_rng(1)
    return rng.uniform(-0.9, 0.9, size=(10, N)), rng.normal(size=(10, N))


@pytest.fixture(scope="module")
def run():
    """The tree evaluator, compiled once per tree structure."""
    return jax.jit(evaluate)


def _paths(node, maps=()):
    """Every leaf with its chain of task maps, siblings unrolled by plain indexing."""
    if isinstance(node, Siblings):
        arrays = [x for x in jax.tree.leaves(node.child) if jnp.ndim(x)]
        for k in range(arrays[0].shape[0]):
            one = jax.tree.map(lambda x, k=k: x[k] if jnp.ndim(x) else x, node.child)
            yield from _paths(one, maps)
    elif isinstance(node, Node):
        for child in node.children:
            yield from _paths(child, (*maps, node.psi))
    else:
        yield maps, node


def _whole_map(maps):
    """The composition root -> leaf as a plain function of (q, t)."""

    def psi(q, t):
        for m in maps:
            q = m.at_time(q, t)
        return q

    return psi


def test_tree_is_the_flattened_weighted_least_squares_problem(tree, states):
    """min sum |J_i qdd + c_i - a_i|^2_{M_i} + |qdd - qdd_0|^2_W by numpy's lstsq."""
    rng = np.random.default_rng(2)
    G = rng.normal(size=(N, N))
    W = 0.1 * (G @ G.T + np.eye(N))
    paths = list(_paths(tree))
    assert len(paths) == 6 + 2 * 3 * 2

    @jax.jit
    def leaf_terms(tree, q, qd):
        terms = []
        for maps, leaf in _paths(tree):
            psi = _whole_map(maps)

            def moved(s, psi=psi):
                return psi(q + s * qd, s)

            y = psi(q, 0.0)
            yd = jax.jacfwd(moved)(0.0)
            ydd = jax.jacfwd(jax.jacfwd(moved))(0.0)
            rmp = leaf(y, yd)
            terms.append((jax.jacrev(psi)(q, 0.0), ydd, rmp.f, rmp.M))
        return terms

    @jax.jit
    def solve(tree, q, qd, qdd_0):
        return resolve(evaluate(tree, q, qd), jnp.asarray(W), qdd_0)

    for q, qd in zip(*states, strict=True):
        qdd_0 = rng.normal(size=N)
        rows, rhs = [np.linalg.cholesky(W).T], [np.linalg.cholesky(W).T @ qdd_0]
        for J, c, f, M in jax.device_get(leaf_terms(tree, q, qd)):
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
        state, rate = jnp.append(q, 0.0), jnp.append(qd, 1.0)
        fixed = []
        for maps, leaf in _paths(tree):
            whole = _whole_map(maps)

            def psi(s, whole=whole):
                return whole(s[:-1], s[-1])

            yd = forward(psi, state, rate)
            ydd = forward(
                lambda s, psi=psi: forward(psi, s, rate), state, rate
            )
            rmp = leaf(psi(state), yd)
            fixed.append((psi, rmp.f - rmp.M @ ydd, rmp.M))

        def work(s):
            return sum(jnp.dot(force, psi(s)) for psi, force, _ in fixed)

        def kinetic(v):
            total = 0.0
            for psi, _, M in fixed:
                yv = forward(psi, state, jnp.append(v, 0.0))
                total = total + 0.5 * yv @ M @ yv
            return total

        f = jax.grad(work)(state)[:-1]
        return f, jax.jacrev(jax.grad(kinetic))(jnp.zeros_like(q))

    for q, qd in zip(states[0][:4], states[1][:4], strict=True):
        f, M = rmp2(tree, q, qd)
        ours = run(tree, q, qd)
        # 1e-10 of the largest entry: rounding of sums of up to 18 terms.
        np.testing.assert_allclose(ours.f, f, atol=1e-10 * np.abs(f).max())
        np.testing.assert_allclose(ours.M, M, atol=1e-10 * np.abs(M).max())


def _same(run, a, b, states):
    for q, qd in zip(states[0][:3], states[1][:3], strict=True):
        left, right = run(a, q, qd), run(b, q, qd)
        scale = float(jnp.abs(left.M).max() + jnp.abs(left.f).max())
        # 1e-13 of the largest entry: only the order of additions differs.
        np.testing.assert_allclose(left.f, right.f, atol=1e-13 * scale)
        np.testing.assert_allclose(left.M, right.M, atol=1e-13 * scale)


def test_permuting_children_changes_nothing(tree, states, run):
    _same(run, tree, tree.replace(children=tree.children[::-1]), states)


def test_giving_each_child_its_own_node_changes_nothing(tree, states, run):
    regrouped = Node(
        identity_map(),
        tuple(Node(identity_map(), (child,)) for child in tree.children),
    )
    _same(run, tree, regrouped, states)


def test_splitting_an_edge_in_two_changes_nothing(states, run):
    rng = np.random.default_rng(3)
    position = TaskMap(_position)
    distance = TaskMap(
        _distance,
        {"center": jnp.asarray(rng.normal(size=3)), "radius": jnp.asarray(0.1)},
        {"center": jnp.asarray(rng.normal(size=3)), "radius": jnp.asarray(0.0)},
    )
    leaf = leaves.GDSCollision(eps=0.1)
    split = Node(position, (Node(distance, (leaf,)),))
    _same(run, split, Node(compose(distance, position), (leaf,)), states)


def test_duplicating_a_leaf_with_half_the_metric_changes_nothing(states, run):
    target = leaves.PositionAttractor(jnp.asarray([0.4, 0.2, 0.9]), 100.0, weight=1.0)
    half = target.replace(weight=0.5)
    one = Node(TaskMap(_position), (target,))
    _same(run, one, Node(TaskMap(_position), (half, half)), states)


def test_siblings_are_the_sum_of_their_members(states, run):
    members = [
        Node(TaskMap(_point, jnp.asarray(offset)), (leaves.Damping(2.0),))
        for offset in np.random.default_rng(4).normal(size=(3, 3))
    ]
    stacked = Node(identity_map(), (Siblings.stack(members),))
    _same(run, stacked, Node(identity_map(), tuple(members)), states)


def test_evaluation_under_vmap_equals_a_loop(tree, states, run):
    batch = jax.jit(jax.vmap(evaluate, in_axes=(None, 0, 0)))(tree, *states)
    for i in range(3):
        one = run(tree, states[0][i], states[1][i])
        # 1e-12 of the largest entry: other summation orders.
        scale = float(jnp.abs(one.M).max() + jnp.abs(one.f).max())
        np.testing.assert_allclose(batch.f[i], one.f, atol=1e-12 * scale)
        np.testing.assert_allclose(batch.M[i], one.M, atol=1e-12 * scale)


def test_a_new_value_of_any_parameter_does_not_retrace(tree, states):
    traces = []

    @jax.jit
    def f(tree, q, qd):
        traces.append(1)
        return evaluate(tree, q, qd)

    tree = jax.tree.map(jnp.asarray, tree)
    f(tree, states[0][0], states[1][0])
    f(jax.tree.map(lambda x: 1.1 * x, tree), states[0][1], states[1][1])
    assert len(traces) == 1


def test_gradients_by_all_parameters_and_the_state_are_finite(tree, states):
    @jax.jit
    def gradients(tree, q, qd):
        def total(tree, q, qd):
            rmp = evaluate(tree, q, qd)
            return jnp.sum(resolve(rmp, 0.1 * jnp.eye(N)))

        return jax.grad(total, argnums=(0, 1, 2))(tree, q, qd)

    tree = jax.tree.map(jnp.asarray, tree)
    for q, qd in [(states[0][0], states[1][0]), (np.zeros(N), np.zeros(N))]:
        for leaf in jax.tree.leaves(gradients(tree, q, qd)):
            assert np.all(np.isfinite(leaf))


def test_a_node_without_children_contributes_nothing(states):
    rmp = evaluate(Node(TaskMap(_position), ()), *map(jnp.asarray, np.zeros((2, N))))
    assert not np.any(rmp.f)
    assert not np.any(rmp.M)


def test_siblings_without_a_stacked_array_are_refused():
    with pytest.raises(ValueError, match="leading axis"):
        evaluate(Siblings(leaves.Damping(1.0)), jnp.zeros(2), jnp.zeros(2))
    with pytest.raises(ValueError, match="at least one"):
        Siblings.stack([])


def test_orientation_leaf_pulls_back_to_the_angular_velocity_policy(states, run):
    """The nine-dimensional embedding equals J_w, Jdot_w qd and the 3-D attractor."""
    R_des = exp_so3(jnp.asarray([0.3, 0.5, -0.2]))
    kp = jnp.asarray([50.0, 80.0, 20.0])
    node = Node(
        TaskMap(_orientation), (leaves.OrientationAttractor(R_des, kp, weight=0.7),)
    )

    def omega(q, qd):
        R, Rd = jax.jvp(_orientation, (q,), (qd,))
        S = Rd @ R.T
        return jnp.stack([S[2, 1], S[0, 2], S[1, 0]])

    for q, qd in zip(states[0][:3], states[1][:3], strict=True):
        q, qd = jnp.asarray(q), jnp.asarray(qd)
        w, J = omega(q, qd), jax.jacfwd(omega, 1)(q, qd)
        bias = jax.jvp(lambda q, qd=qd: omega(q, qd), (q,), (qd,))[1]
        rmp = leaves.orientation_attractor(_orientation(q), w, R_des, kp, weight=0.7)
        ours = run(node, q, qd)
        # 1e-11: rounding; forces are of order 1e2.
        np.testing.assert_allclose(ours.f, J.T @ (rmp.f - rmp.M @ bias), atol=1e-11)
        np.testing.assert_allclose(ours.M, J.T @ rmp.M @ J, atol=1e-11)

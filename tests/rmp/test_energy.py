"""Energy of damped geodesic systems, and the safety of the resolved motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rmp_mjx.math import safe_norm
from rmp_mjx.rmp import leaves
from rmp_mjx.rmp.algebra import resolve
from rmp_mjx.rmp.taskmap import TaskMap, identity_map
from rmp_mjx.rmp.tree import Node, evaluate
from tests.rmp.outside import Drag, GeodesicBarrier

pytestmark = pytest.mark.usefixtures("x64")

CENTER = np.array([0.75, 0.6])
RADIUS, MU, EPS, ALPHA, R_MAX = 0.1, 0.01, 0.2, 0.5, 0.4
TARGET, KP = np.array([1.0, 0.1]), 4.0


def _tip(q):
    """Tip of a planar arm with links of 0.6 m: a curved task map."""
    angles = jnp.cumsum(q)
    return 0.6 * jnp.stack([jnp.sum(jnp.cos(angles)), jnp.sum(jnp.sin(angles))])


def _distance(x):
    return safe_norm(x - CENTER) - RADIUS


def _system(damping):
    """Attractor, obstacle and unit inertia: every leaf is a GDS."""
    barrier = GeodesicBarrier(
        mu=MU, eps=EPS, eta=damping, alpha=ALPHA, r=R_MAX, cap=float("inf")
    )
    attractor = leaves.PositionAttractor(jnp.asarray(TARGET), KP, kd=damping)
    tip = Node(TaskMap(_tip), (attractor, Node(TaskMap(_distance), (barrier,))))
    return Node(identity_map(), (Drag(damping, 1.0), tip))


def _energy(q, qd):
    """Sum over the leaves of xd^T G xd / 2 + Phi, written out by hand."""
    x, xd = jax.jvp(_tip, (q,), (qd,))
    d, dd = jax.jvp(_distance, (x,), (xd,))
    w = MU * jnp.maximum(1 - d / R_MAX, 0.0) ** 2 / d**4
    kinetic = 0.5 * (qd @ qd + xd @ xd + (EPS + jnp.minimum(dd, 0.0) ** 2) * w * dd**2)
    return kinetic + 0.5 * KP * jnp.sum((x - TARGET) ** 2) + 0.5 * ALPHA * w


@pytest.fixture(scope="module")
def simulate():
    """Classical Runge-Kutta of the resolved motion, 4 s in 4,000 steps."""

    @jax.jit
    def run(tree, q, qd, dt=1e-3):
        def rate(state):
            q, qd = state
            return qd, resolve(evaluate(tree, q, qd))

        def moved(state, k, h):
            return jax.tree.map(lambda s, r: s + h * r, state, k)

        def step(state, _):
            k1 = rate(state)
            k2 = rate(moved(state, k1, dt / 2))
            k3 = rate(moved(state, k2, dt / 2))
            k4 = rate(moved(state, k3, dt))
            new = jax.tree.map(
                lambda s, a, b, c, d: s + dt / 6 * (a + 2 * b + 2 * c + d),
                state, k1, k2, k3, k4,
            )  # fmt: skip
            return new, (_energy(*new), _distance(_tip(new[0])))

        return jax.lax.scan(step, (q, qd), length=4000)[1]

    return run


STARTS = [([1.2, 0.3], [-1.0, 0.0]), ([1.0, 0.8], [-1.5, -0.5])]


@pytest.mark.parametrize(("q", "qd"), STARTS)
def test_energy_of_the_damped_system_never_increases(simulate, q, qd):
    q, qd = jnp.asarray(q), jnp.asarray(qd)
    energy, distance = simulate(_system(3.0), q, qd)
    energy = np.asarray(energy)
    # 1e-9: Runge-Kutta error per step at 1 ms, energies of order one.
    assert np.diff(energy).max() < 1e-9
    # The run means something only if it meets the obstacle and loses energy.
    assert distance.min() < 0.3
    assert energy[-1] < 0.5 * energy[0]


@pytest.mark.parametrize(("q", "qd"), STARTS)
def test_energy_of_the_undamped_system_is_conserved(simulate, q, qd):
    q, qd = jnp.asarray(q), jnp.asarray(qd)
    energy, distance = simulate(_system(0.0), q, qd)
    energy = np.asarray(energy)
    # 2e-6 relative over 4,000 steps (4e-7 seen): the velocity gate's kink costs a
    # little at every turning point. Without xi, or without the curvature, the energy
    # changes by 30 % and more.
    assert np.abs(energy - energy[0]).max() < 2e-6 * energy[0]
    assert 0.0 < distance.min() < 0.3

"""The leaves' formulas and default numbers, term by term, in float64."""

import re

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rmp_mjx.rmp import leaves

pytestmark = pytest.mark.usefixtures("x64")


def test_the_papers_leaf_is_its_formula():
    """Squared speed of approach over the fourth power of the distance to the margin,
    from which it is clamped; at most the cap. 1e-12: float64."""
    leaf = leaves.PaperCollision(eta=3.0, margin=0.05, x_min=0.02, cap=40.0)
    x, xd = (v.ravel() for v in np.meshgrid(np.linspace(-0.1, 2, 43), [-1, -0.1, 0, 1]))
    f, m = leaf.scalar(jnp.asarray(x), jnp.asarray(xd))
    approach, gap = np.maximum(-xd, 0.0), np.maximum(x - 0.05, 0.02)
    expected = np.minimum(approach**2 / gap**4, 40.0)
    np.testing.assert_allclose(m, expected, rtol=1e-12)
    np.testing.assert_allclose(f, -3.0 * expected * xd, rtol=1e-12)
    assert (expected == 40.0).any() and ((expected > 0) & (expected < 1)).any()


STANDING_OFF = {
    "paper": leaves.PaperCollision(margin=0.02),
    "near": leaves.collision_near(),
}


@pytest.mark.parametrize("name", STANDING_OFF)
def test_standing_off_is_the_same_leaf_farther_out(name):
    """To 1e-9, relative: differences of distances."""
    leaf = STANDING_OFF[name]
    x, xd = (
        v.ravel() for v in np.meshgrid(np.linspace(-0.1, 0.4, 41), [-1.0, 0.0, 1e-3])
    )
    near = leaf.scalar(jnp.asarray(x), jnp.asarray(xd))
    far = leaf.standing_off(0.03).scalar(jnp.asarray(x + 0.03), jnp.asarray(xd))
    for a, b in zip(near, far, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9)


def test_a_barrier_of_a_slow_arm_counts_the_gap_that_its_stop_leaves():
    """Approached at 0.4 m/s with 0.5 s to stop the gap is 0.1 m less, but neither the
    rate nor the depth in the margin is another; a leaving body needs no stop."""
    leaf = leaves.Barrier(mu=0.01, r=1.0, margin=0.05, cap=1e9)
    x, xd = jnp.linspace(0.2, 0.9, 8), jnp.full(8, -0.4)
    f, m = leaf.braking(0.5).scalar(x, xd)
    near = leaf.scalar(x - 0.1, xd)
    np.testing.assert_allclose(m, near[1], rtol=1e-12)
    np.testing.assert_allclose(f, near[0], rtol=1e-12)
    np.testing.assert_array_equal(leaf.braking(0.5).scalar(x, -xd), leaf.scalar(x, -xd))


DEFAULTS = ("collision_near", "collision_transit", "joint_limit_barrier")


@pytest.mark.parametrize("name", DEFAULTS)
def test_default_barriers_are_those_of_the_documentation(name, root):
    """The table of docs/controller.md; margins there are in mm or rad. And three
    numbers that all have."""
    text = (root / "docs" / "controller.md").read_text()
    (row,) = re.findall(rf"^\|.*\(`{name}`\) \|(.*)\|$", text, re.M)
    cells = [cell.strip().replace(",", "") for cell in row.split("|")]
    shown = [float(cell.split()[0]) for cell in cells]
    shown[4] *= 1e-3 if cells[4].endswith("mm") else 1.0
    leaf = getattr(leaves, name)()
    found = (leaf.mu, leaf.eps, leaf.eta, leaf.r, leaf.margin, leaf.cap, leaf.k_out)
    assert found == pytest.approx(shown, rel=1e-12)
    assert (leaf.x_min, leaf.v_out, leaf.stop_time) == (5e-3, 3e-3, 0.0)
    assert leaves.Barrier() == leaves.collision_transit()


def test_the_papers_leaf_has_the_numbers_that_its_page_gives():
    leaf = leaves.PaperCollision()
    assert (leaf.eta, leaf.margin, leaf.x_min, leaf.cap) == (2.0, 0.0, 5e-3, 1e5)


@pytest.mark.parametrize("rest", [None, 0.2])
def test_rmpflows_joint_limit_is_its_documented_formula(rest):
    """With the default numbers, slopes by central differences: 1e-6. Beyond a limit the
    clamp of b holds; a joint with one limit gets nothing."""
    low, high = np.array([-1.0, -2.0, -np.inf]), np.array([1.5, 0.5, 1.0])
    q_0 = 0.5 * (low + high) if rest is None else np.full(3, rest)
    given = None if rest is None else jnp.asarray(q_0)
    leaf = leaves.RMPflowJointLimit(low, high, given)

    def inverse_square(q, qd):
        s = np.clip(((q - low)[:2] / (high - low)[:2]), 0.0, 1.0)
        d = 4.0 * s * (1.0 - s)
        up = 1.0 - np.exp(-(np.maximum(qd[:2], 0.0) ** 2) / (2 * 0.1**2))
        down = 1.0 - np.exp(-(np.minimum(qd[:2], 0.0) ** 2) / (2 * 0.1**2))
        b = s * (up * d + 1.0 - up) + (1.0 - s) * (down * d + 1.0 - down)
        return 1.0 / np.maximum(b, 1e-2) ** 2

    rng = np.random.default_rng(0)
    for k in range(40):
        q = rng.uniform(-0.9, 0.4, 3) if k else np.array([1.6, -2.1, 0.0])
        qd = rng.normal(scale=0.15, size=3) if k else np.array([1.0, -1.0, 0.0])
        f, m = leaf.scalar(jnp.asarray(q), jnp.asarray(qd))
        weight = 0.01 * inverse_square(q, qd)
        slope = (inverse_square(q + 1e-6, qd) - inverse_square(q - 1e-6, qd)) / 2e-6
        pull = 0.05 * (q_0 - q)[:2] - 0.1 * qd[:2]
        expected = weight * pull - 0.5 * 0.01 * slope * qd[:2] ** 2
        np.testing.assert_allclose(m, [*weight, 0.0], rtol=1e-12)
        np.testing.assert_allclose(f, [*expected, 0.0], rtol=1e-6, atol=1e-9)
        if not k:
            np.testing.assert_allclose(m[:2], 0.01 / 1e-2**2)


@pytest.mark.parametrize("kd", [None, 3.0])
def test_the_orientation_leaf_is_its_policy_on_the_angular_velocity(kd):
    """Pulled back by dR = [w] R: the metric is the weight, the force the documented
    torque, with the error half the sum of the axes' cross products. 1e-12."""
    rng = np.random.default_rng(0)
    R, target = Rotation.random(2, rng=rng).as_matrix()
    kp, forward, omega = rng.uniform(1, 90, 3), rng.normal(size=3), rng.normal(size=3)
    leaf = leaves.OrientationAttractor(target, kp, kd, 0.3, forward)
    turned = np.stack([np.cross(e, R.T).T.reshape(9) for e in np.eye(3)], axis=1)
    rmp = leaf(jnp.asarray(R.reshape(9)), jnp.asarray(turned @ omega))
    error = 0.5 * np.cross(R.T, target.T).sum(axis=0)
    damping = 2.0 * np.sqrt(kp) if kd is None else kd
    torque = 0.3 * (kp * error - damping * omega + forward)
    np.testing.assert_allclose(turned.T @ rmp.M @ turned, 0.3 * np.eye(3), atol=1e-12)
    np.testing.assert_allclose(turned.T @ rmp.f, torque, atol=1e-12)
    plain = leaves.OrientationAttractor(target, kp)
    assert (plain.weight, plain.feedforward, plain.kd) == (1.0, 0.0, None)
    assert leaves.PositionAttractor(forward, 1.0).weight == 1.0


def test_the_default_posture_is_that_of_vices_and_the_soft_one_overdamped():
    """Gains 10 and 2 sqrt(10), a fiftieth of the identity; 2.5 and 10."""
    q, qd, rest = np.array([0.1, -0.2]), np.array([0.3, 0.1]), np.array([1.0, 2.0])
    at = jnp.asarray(q), jnp.asarray(qd)
    for leaf, stiffness, damping in (
        (leaves.Posture(rest), 10.0, 2.0 * np.sqrt(10.0)),
        (leaves.soft_posture(rest), 2.5, 10.0),
    ):
        a = stiffness * (rest - q) - damping * qd
        np.testing.assert_allclose(leaf.acceleration(*at), a, rtol=1e-12)
        rmp = leaf(*at)
        np.testing.assert_allclose(rmp.M, 0.02 * np.eye(2), rtol=1e-12)
        np.testing.assert_allclose(rmp.f, 0.02 * a, rtol=1e-12)

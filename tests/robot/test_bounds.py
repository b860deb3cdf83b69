"""Bounds of the arm: no motion exceeds them, and they are not idle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rmp_mjx import Robot
from rmp_mjx.robot.bounds import Bounds, centre_levers, squares_of
from rmp_mjx.robot.configurations import random_configurations
from rmp_mjx.robot.dynamics import dynamics, holding_torque
from rmp_mjx.robot.kinematics import arm_state
from rmp_mjx.robot.point_state import point_state
from tests.oracles import Measured, in_float64
from tests.robot.test_model import GRIPPER


@pytest.fixture(scope="module", params=["jaco", "gripper"])
def arm(request, robot):
    """The Jaco 2, and an arm of another build."""
    gripper = Robot.from_mjcf(GRIPPER, site="tip", spacing=0.1)
    return robot if request.param == "jaco" else gripper


def length(v):
    return jnp.sqrt(v @ v)


@pytest.fixture(scope="module")
def motion(arm):
    """`motion(q, qd)`: what the bounds bound, by name, and the bounds; float64."""
    bounds = Bounds.of(arm)
    segment, n = np.array(arm.points.segment), arm.n

    def both(q, qd):
        state = arm_state(arm, q, qd)
        points, size = point_state(arm, state), jnp.abs(qd)
        squares = jnp.outer(size, size).reshape(-1)
        spin = length(state.V.ang)[segment] * arm.points.radius

        def moved(q):
            state = arm_state(arm, q, qd)
            Mq, _ = dynamics(arm, state)
            return jnp.matmul(Mq, qd, precision="highest")

        def held(q):
            return holding_torque(arm, arm_state(arm, q, jnp.zeros(n)))

        _, rate = jax.jvp(moved, (q,), (qd,))
        _, load = jax.jvp(held, (q,), (qd,))
        coriolis = dynamics(arm, state)[1] - holding_torque(arm, state)
        if arm.damping is not None:
            coriolis = coriolis - arm.damping * qd
        R = centre_levers(arm, state)
        most, most_rate, most_load = bounds.torques(arm, R, qd)
        later = centre_levers(arm, arm_state(arm, q + 0.2 * qd, qd))
        return {
            "speed": (
                jnp.sqrt(points.v @ points.v) + spin,
                (bounds.lever @ size)[segment],
            ),
            "bend": (jnp.sqrt(points.a @ points.a), (squares @ bounds.bend)[segment]),
            "coriolis": (jnp.abs(coriolis), most),
            "inertia": (jnp.abs(rate), most_rate),
            "load": (jnp.abs(load), most_load),
            "levers": (later, bounds.levers(R, qd, 0.2)),
        }

    return in_float64(both)


@settings(max_examples=200, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 127))
def test_no_motion_exceeds_the_bounds(arm, motion, seed, joints):
    """Any configuration, any joints at any speeds. 1e-9: rounding of float64."""
    rng = np.random.default_rng(seed)
    some = (joints >> np.arange(arm.n)) & 1
    q, qd = rng.uniform(-np.pi, np.pi, arm.n), some * rng.normal(size=arm.n)
    for name, (value, bound) in motion(q, qd).items():
        assert np.all(value <= bound + 1e-9), name


def test_the_bounds_are_not_idle(arm, motion):
    """A turn of one joint takes up a third of each, and nine tenths of a lever."""
    rng = np.random.default_rng(0)
    best = {}
    for _ in range(300):
        q, qd = rng.uniform(-np.pi, np.pi, arm.n), np.eye(arm.n)[rng.integers(arm.n)]
        for name, (value, bound) in motion(q, qd).items():
            used = np.where(bound > 1e-6, value / np.maximum(bound, 1e-6), 0.0).max()
            best[name] = max(best.get(name, 0.0), used)
    assert best["speed"] > 0.9
    assert min(best[k] for k in ("bend", "load", "levers")) > 1 / 3


def test_the_holding_torque_is_the_bias_at_rest(arm):
    with jax.enable_x64(True):
        q = jnp.asarray(arm.q_home + 0.3)
        state = arm_state(arm, q, jnp.zeros(arm.n))
        held, bias = holding_torque(arm, state), dynamics(arm, state)[1]
    np.testing.assert_allclose(held, bias, atol=1e-12)


CHAIN = """<mujoco><worldbody><body name="base">
<geom name="base" type="capsule" fromto="-.4 0 0 .25 0 0" size=".05"/>
<body name="one"><joint name="a" axis="0 0 1"/>
 <geom name="one" type="capsule" fromto="0 0 0 .4 0 0" size=".05"/>
 <body name="two" pos=".4 0 0">
  <joint name="b" type="slide" axis="1 0 0" range="-.1 .4" ref=".2"/>
  <geom name="two" type="capsule" fromto="0 0 0 .2 0 0" size=".04"/>
  <body name="three" pos=".2 0 0"><joint name="c" axis="0 0 1" stiffness="3"/>
   <geom name="three" type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="2"/>
   <geom name="ball" size=".02" pos=".15 0 0"/><site name="tip" pos=".3 0 0"/>
</body></body></body></body></worldbody><actuator><motor joint="a" ctrlrange="-9 9"/>
<motor joint="b" ctrlrange="-9 9"/><motor joint="c" ctrlrange="-9 9"/></actuator>
</mujoco>"""
"""Links in a line: turns at both ends, and a slide of 0.3 m at most between them."""


@pytest.fixture(scope="module")
def chain():
    return Robot.from_mjcf(CHAIN, site="tip", spacing=0.05)


def test_levers_of_a_stretched_chain_are_its_lengths(chain):
    """Surfaces and centres, the slide drawn out; a slide moves a point as it moves
    itself. 1e-6: the arm's text has six digits."""
    bounds = Bounds.of(chain)
    surface = [[0.45, 0, 0], [0.4 + 0.3 + 0.2 + 0.04, 1, 0], [0.9 + 0.33, 1, 0.33]]
    centre = [[0.2, 0, 0], [0.4 + 0.3 + 0.1, 1, 0], [0.9 + 0.15, 1, 0.15]]
    np.testing.assert_allclose(bounds.lever, surface, atol=1e-6)
    np.testing.assert_allclose(bounds.centre, centre, atol=1e-6)
    inertia = chain.mj_model.body_inertia[2:].max(axis=1)
    np.testing.assert_allclose(bounds.spin, inertia, rtol=1e-5)


def test_a_pair_of_links_is_moved_by_the_joints_between_them(chain):
    assert chain.capsules.geom == ("base", "one", "two", "three", "ball")
    capsules = chain.capsules.replace(pairs=((3, 0), (3, 1), (2, 1)))
    bounds = Bounds.of(chain.replace(capsules=capsules))
    expected = [
        bounds.lever[2],
        bounds.lever[2] * [0, 1, 1],
        bounds.lever[1] * [0, 1, 0],
    ]
    np.testing.assert_array_equal(bounds.pair_lever, expected)
    for lever, bend in (
        (bounds.lever, bounds.bend),
        (bounds.pair_lever, bounds.pair_bend),
    ):
        products = np.zeros((3, 3, 3))
        for i, j, k in np.ndindex(3, 3, 3):  # the outer joint's lever, if both move it
            both = lever[k, i] > 0 and lever[k, j] > 0
            products[i, j, k] = lever[k, max(i, j)] if both else 0.0
        np.testing.assert_array_equal(bend, products.reshape(9, 3))


def test_a_link_sticks_out_between_two_points_of_its_axis_by_the_scallop(chain):
    """Points are 5 cm apart; a ball has none. 1e-6: six digits."""
    radius = np.asarray(chain.points.radius)
    dip = radius - np.sqrt(np.maximum(radius**2 - 0.025**2, 0.0))
    expected = np.where(radius == radius.min(), 0.0, dip)
    np.testing.assert_allclose(Bounds.of(chain).scallop, expected, atol=1e-6)
    assert (expected == 0.0).sum() == 1


def test_centres_are_as_far_from_the_axes_as_mujoco_says(bent):
    """In 10 configurations; 1e-9 m. A slide counts 1."""
    measured = Measured(bent)
    for q in random_configurations(bent, 10):
        with jax.enable_x64(True):
            found = centre_levers(bent, arm_state(bent, jnp.asarray(q), jnp.zeros(4)))
        data, expected = measured.at(q), np.zeros((4, 4))
        for k, j in zip(*np.tril_indices(4), strict=True):
            arm = data.xipos[bent.mj_model.jnt_bodyid[k]] - data.xanchor[j]
            away = np.linalg.norm(np.cross(data.xaxis[j], arm))
            expected[k, j] = away if bent.hinge[j] else 1.0
        np.testing.assert_allclose(found, expected, atol=1e-9)


def test_bounds_on_a_line_are_sums_over_links_and_pairs_of_joints(chain, x64):
    """Triangle inequalities, term by term; 1e-12. A link's rotation counts half again
    for the Coriolis torque and three and a half times for the inertia's change."""
    bounds, rng = Bounds.of(chain), np.random.default_rng(0)
    R, u = np.tril(rng.uniform(0.1, 1, (3, 3))), rng.normal(size=3)
    s, mass, way = np.abs(u), np.asarray(chain.mass), 0.1
    g = np.linalg.norm(chain.gravity)
    coriolis, change, load = np.zeros((3, 3))
    for j, k in np.ndindex(3, 3):
        if k < j:
            continue
        turn = bounds.spin[k] * s[: k + 1].sum() ** 2
        speed = (R[k] * s).sum()
        for a in range(k + 1):
            bend = sum(R[k, max(a, b)] * s[a] * s[b] for b in range(k + 1))
            coriolis[j] += mass[k] * R[k, j] * bend
            change[j] += mass[k] * (R[k, j] * bend + speed * s[a] * R[k, max(a, j)])
            load[j] += g * mass[k] * s[a] * R[k, max(a, j)]
        coriolis[j] += 1.5 * turn
        change[j] += 3.5 * turn
    load += [0.0, 0.0, 3.0 * s[2]]
    found = bounds.torques(chain, jnp.asarray(R), jnp.asarray(u))
    np.testing.assert_allclose(found, [coriolis, change, load], rtol=1e-12)
    expected = np.zeros((3, 3))
    for k, j in np.ndindex(3, 3):
        later = sum(bounds.centre[k, i] * s[i] for i in range(j + 1, 3))
        expected[k, j] = min(bounds.centre[k, j], R[k, j] + way * later)
    found = bounds.levers(jnp.asarray(R), jnp.asarray(u), way)
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    size, squares = squares_of(jnp.asarray(u))
    np.testing.assert_array_equal(size, s)
    np.testing.assert_array_equal(squares, np.outer(s, s).ravel())


def test_a_slide_without_limits_has_no_bounds(chain):
    for limits in (
        {"q_lower": chain.q_lower - np.inf},
        {"q_upper": chain.q_upper + np.inf},
    ):
        with pytest.raises(ValueError, match="limits on every sliding joint"):
            Bounds.of(chain.replace(**limits))


def test_levers_are_sums_of_what_mujoco_measures_at_the_reference_pose(bent):
    """From the axis to the next joint, from joint to joint with what slides add, and
    from the last one to a surface. 1e-9 m."""
    measured, capsules, n = Measured(bent), bent.capsules, bent.n
    data, model = measured.at(bent.q_ref), bent.mj_model
    anchor, axis = data.xanchor.copy(), data.xaxis.copy()

    def off(j, x):
        return np.linalg.norm(np.cross(x - anchor[j], axis[j]), axis=-1)

    def expected(k, ends, radius, upper):
        slide = np.array([0.0, max(0.2, upper - 0.1), 0.0, 0.0])
        row = np.zeros(n)
        row[k] = off(k, ends).max() + radius
        rest = np.linalg.norm(ends - anchor[k], axis=1).max() + radius
        for j in reversed(range(k)):
            rest += slide[j + 1]
            row[j] = off(j, anchor[j + 1]) + rest
            rest += np.linalg.norm(anchor[j + 1] - anchor[j])
        row[1] = 1.0 if k >= 1 else 0.0
        return row

    for upper in (0.2, 0.7):
        arm = bent.replace(q_upper=np.where(bent.hinge, bent.q_upper, upper))
        lever = np.zeros((n, n))
        for c, k in enumerate(capsules.segment):
            g = model.geom(capsules.geom[c]).id
            half = data.geom_xmat[g].reshape(3, 3)[:, 2] * model.geom_size[g, 1]
            ends = data.geom_xpos[g] + np.stack([half, -half])
            if k >= 0:
                row = expected(k, ends, capsules.radius[c], upper)
                lever[k] = np.maximum(lever[k], row)
        bounds = Bounds.of(arm)
        np.testing.assert_allclose(bounds.lever, lever, atol=1e-9)
        centres = [
            expected(k, data.xipos[[model.jnt_bodyid[k]]], 0.0, upper) for k in range(n)
        ]
        np.testing.assert_allclose(bounds.centre, centres, atol=1e-9)

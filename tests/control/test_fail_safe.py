"""Inputs that nobody can use: a flag, a bounded torque, no other state disturbed."""

import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.studies import faults
from benchmarks.studies.chains import random_chain
from rmp_mjx import RMPVICES, VICES, Obstacles, Robot, StopGuard, per_link
from rmp_mjx.control import rmp_vices
from rmp_mjx.control.fail_safe import BRAKING_TIME, Inputs, judged
from rmp_mjx.rmp import RMP
from rmp_mjx.rmp.leaves.joint_limit import JointLimitBarrier
from rmp_mjx.robot.dynamics import dynamics
from rmp_mjx.robot.kinematics import arm_state
from tests.control.conftest import changed
from tests.robot.test_model import GRIPPER

BATCH = 512


@pytest.fixture(scope="module")
def robot():
    return random_chain(1, joints=3)


@pytest.fixture(scope="module")
def sampler(robot):
    return faults.Sampler(robot)


@pytest.fixture(scope="module")
def run(robot):
    """A batch through the compiled controller of a name."""
    made = {}

    def run(name, given):
        if name not in made:
            ctrl = faults.controllers(robot)[name]
            made[name] = faults.compiled(ctrl)
        return made[name](given)

    return run


@pytest.mark.parametrize("name", ["rmp_vices", "vices", "vices_cbf", "vices_guarded"])
def test_hostile_states_get_torques_within_the_limits_and_a_right_flag(
    sampler, run, name
):
    """And no torque of another state changes by a bit, whatever is in unused slots.

    The others are run by `python -m benchmarks.faults`, with many more states.
    """
    rng = np.random.default_rng(1)
    for family, fault in faults.FAULTS.items():
        found = faults.attack(lambda x: run(name, x), sampler, fault, rng, BATCH)
        everywhere = family in ("plausible", "at_the_bounds", "unused")
        assert (found.pop("unusable") == 0) == everywhere
        assert found.pop("unsolved") == 0
        assert not any(found.values()), (family, found)


def spoilt(sampler, name, value=np.nan, seed=0):
    """A batch with the first number of a field spoilt, and its fields."""
    fields = sampler.draw(np.random.default_rng(seed), BATCH)
    fields[name].reshape(BATCH, -1)[:, 0] = value
    return sampler.tree(fields), fields


@pytest.fixture(scope="module")
def model(robot):
    """Inertia and bias of a batch of states."""

    @jax.jit
    def model(q, qd):
        return jax.vmap(lambda q, qd: dynamics(robot, arm_state(robot, q, qd)))(q, qd)

    return model


def test_without_a_target_the_joints_slow_down_together(robot, sampler, run, model):
    """qdd = -qd / T, with T at least `BRAKING_TIME`, where the motors hold the arm.

    1e-3 of qd / T: float32, through the inverse of the inertia.
    """
    given, fields = spoilt(sampler, "setpoint.p_des")
    out = jax.device_get(run("vices", given))
    Mq, bias = (np.asarray(x, float) for x in model(fields["q"], fields["qd"]))
    held = np.all(np.abs(bias) < 0.9 * robot.tau_max, axis=1)
    assert held.sum() > 50
    qdd = np.linalg.solve(Mq, (out.tau - bias)[..., None])[..., 0][held]
    qd = fields["qd"][held].astype(float)
    rate = -np.sum(qdd * qd, axis=1) / np.sum(qd * qd, axis=1)
    assert np.all((rate > 0.0) & (rate < 1.001 / BRAKING_TIME))
    error = np.abs(qdd + rate[:, None] * qd).max(1)
    assert np.all(error < 1e-3 * rate * np.abs(qd).max(1) + 1e-3)


def test_without_velocities_the_arm_is_held_against_gravity(robot, sampler, run, model):
    """1e-5 of the torque limits: float32, with other fusions."""
    given, fields = spoilt(sampler, "qd", np.inf)
    out = jax.device_get(run("vices", given))
    _, gravity = model(fields["q"], 0.0 * np.nan_to_num(fields["qd"], posinf=0.0))
    expected = np.clip(gravity, -robot.tau_max, robot.tau_max)
    np.testing.assert_allclose(out.tau, expected, atol=1e-5 * robot.tau_max.max())


def test_without_positions_the_motors_give_nothing(sampler, run):
    given, _ = spoilt(sampler, "q")
    for name in ("vices", "rmp_vices", "vices_cbf"):
        out = jax.device_get(run(name, given))
        assert not out.tau.any() and not out.qdd.any()
        assert not any(x.any() for x in out.diagnostics.values())


def test_a_filter_that_knows_an_obstacle_by_half_solves_nothing(sampler, run):
    for name in ("spheres.center", "planes.normal", "capsules.axis", "boxes.rotation"):
        given, _ = spoilt(sampler, f"obstacles.{name}", np.inf)
        found = jax.device_get(run("vices_cbf", given).diagnostics)
        assert not found["usable"].any() and not found["solved"].any()


class Lost(VICES):
    """A controller that finds no torque."""

    def unguarded(self, *args, **kwargs):
        """All of it NaN."""
        out = super().unguarded(*args, **kwargs)
        return out.replace(tau=jnp.nan * out.tau)


def test_a_torque_that_is_not_finite_makes_the_state_unusable_guarded_too(robot):
    """The guard would brake in its place, and say nothing."""
    q, none = jnp.array([0.1, 0.5, -0.3]), Obstacles.empty()
    for guard in (None, StopGuard.of(robot)):
        ctrl = Lost(robot, guard=guard)
        setpoint = ctrl.setpoint(q, ctrl.decode(jnp.zeros(12)), 0.0)
        out = jax.jit(ctrl)(q, q, setpoint, none)
        assert out.diagnostics["usable"] == 0.0 and not out.qdd.any()
        assert np.all(np.abs(out.tau) <= robot.tau_max) and out.tau.any()
        assert not any(x.any() for x in out.diagnostics.values())


def test_an_infinite_acceleration_gives_no_torque(robot, monkeypatch):
    """Clipped to the limits it would have passed for one."""
    lost = jnp.array([jnp.inf, 0.0, 0.0]), jnp.zeros(6)
    monkeypatch.setattr(rmp_vices, "solve_root", lambda *args: lost)
    eye, still = jnp.eye(3), jnp.zeros(3)
    found = RMPVICES(robot).resolve(RMP(f=still, M=eye), eye, still, still)
    assert np.isnan(found.tau[0])


def test_gradients_are_finite_in_hostile_states():
    """By joints and set-point: zero where the torque does not depend on them.

    With six joints or more: VICES inverts the whole operational inertia.
    """
    arm = random_chain(0, joints=7)
    ctrl, sampler = VICES(arm), faults.Sampler(arm)

    @jax.jit
    @jax.vmap
    def slope(given):
        def torque(q, qd, setpoint):
            return jnp.sum(ctrl(**given | {"q": q, "qd": qd, "setpoint": setpoint}).tau)

        state = given["q"], given["qd"], given["setpoint"]
        return jax.grad(torque, argnums=(0, 1, 2))(*state)

    rng = np.random.default_rng(2)
    for family in ("plausible", "not_finite", "unused", "meaningless"):
        fields = sampler.draw(rng, BATCH)
        faults.FAULTS[family](rng, fields, np.ones(BATCH, bool))
        found = jax.device_get(slope(sampler.tree(fields)))
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(found)), family
        unusable = ~np.isfinite(fields["q"]).all(1)
        assert not any(x[unusable].any() for x in jax.tree.leaves(found))


def test_an_arm_without_pairs_or_obstacles_works_in_every_controller():
    """Nothing can touch: no pairs of links, no slots."""
    arm = Robot.from_mjcf(GRIPPER, site="tip", spacing=0.1)
    arm = arm.replace(capsules=changed(arm.capsules, pairs=()))
    q, none = jnp.array([0.1, 0.5, -0.3]), Obstacles.empty()
    for ctrl in faults.controllers(arm).values():
        setpoint = ctrl.setpoint(q, ctrl.decode(jnp.zeros(12)), 0.0)
        out = jax.eval_shape(ctrl, q, q, setpoint, none)
        assert out.tau.shape == (3,)
        assert out.diagnostics["usable"].dtype == jnp.float32


def test_numbers_at_their_bounds_can_be_used(sampler):
    """To the last bit: 10,000 of a joint and 1e9 s are in, the next numbers are not."""
    fields = sampler.draw(np.random.default_rng(0), 1)
    for name, most in (("q", 1e4), ("qd", -1e4), ("setpoint.time", 1e9)):
        for value in (np.float32(most), np.nextafter(np.float32(most), np.inf * most)):
            spoilt = {**fields, name: np.full_like(fields[name], value)}
            one = jax.tree.map(lambda x: jnp.asarray(x[0]), sampler.tree(spoilt))
            assert bool(judged(Inputs(**one))[1].all) == (value == most), name


NAN = float("nan")
UP = np.array([[0.0, 0.0, 1.0]])
SLOTS: Any = Obstacles.empty(spheres=3, planes=1, capsules=1, boxes=1)
REFUSED = {
    "a centre that is none": (
        lambda _: SLOTS.with_spheres([[NAN, 0.0, 0.0]], 0.1),
        "centers must be finite, got [[nan, 0.0, 0.0]]",
    ),
    "one centre without brackets": (
        lambda _: SLOTS.with_spheres([0.1, 0.2, 0.3], 0.1),
        "centers must be vectors (k, 3), got shape (3,)",
    ),
    "a negative radius": (
        lambda _: SLOTS.with_spheres(UP, -0.1),
        "sphere radii must be positive and finite, got -0.1",
    ),
    "a normal without direction": (
        lambda _: SLOTS.with_planes(UP, [[0.0, 0.0, 0.0]]),
        "plane normals must be of some length, got [[0.0, 0.0, 0.0]]",
    ),
    "a rotation that stretches": (
        lambda _: SLOTS.with_boxes(UP, UP + 1.0, 2 * np.eye(3)[None]),
        "box rotations must be rotation matrices, got [[[2.0, 0.0,",
    ),
    "a negative rounding": (
        lambda _: SLOTS.with_boxes(UP, np.ones((1, 3)), None, -1.0),
        "box radii must be finite and not negative, got -1.0",
    ),
    "a negative regulariser": (
        lambda robot: RMPVICES(robot, regularizer=-1.0),
        "regularizer must be finite and not negative, got -1.0",
    ),
    "too few links": (
        lambda robot: per_link(robot, [1.0, 2.0]),
        "per_link needs a value for each of the 3 links, got shape (2,)",
    ),
    "crossed limits of a robot": (
        lambda robot: robot.replace(q_lower=np.ones(3), q_upper=np.zeros(3)),
        "q_lower must be at most q_upper, got [1.0, 1.0, 1.0] and [0.0, 0.0, 0.0]",
    ),
    "crossed limits of a leaf": (
        lambda _: JointLimitBarrier(np.ones(1), np.zeros(1)),
        "lower must be at most upper, got [1.0] and [0.0]",
    ),
}


@pytest.mark.parametrize(("make", "message"), REFUSED.values(), ids=REFUSED)
def test_what_cannot_be_meant_is_refused_when_it_is_made(robot, make, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        make(robot)


def test_traced_numbers_pass_and_make_the_state_unusable(robot):
    """What a constructor cannot see, the controller does."""
    ctrl = VICES(robot)
    q = jnp.zeros(3)
    setpoint = ctrl.setpoint(q, ctrl.decode(jnp.zeros(12)), 0.0)

    @jax.jit
    def flag(x, eps):
        RMPVICES(robot, regularizer=eps)
        slots = SLOTS.with_spheres([[x, 0.0, 0.0]], 0.1).with_planes(
            UP, [[0.0, 0.0, x]]
        )
        return judged(Inputs(q, q, setpoint, slots, None, None))[1].all

    assert [float(flag(x, -1.0)) for x in (1.0, 0.0, NAN, np.inf)] == [1, 0, 0, 0]

"""Both controllers driven into a table, a limit and a sphere, and what they feel."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from rmp_mjx.pytree import Pytree
from rmp_mjx.robot.dynamics import dynamics
from rmp_mjx.robot.kinematics import arm_state
from tests.envs.arm_tasks import LANES, Torques

STEPS = 60  # 3 s
TABLE, LIMIT, SPHERE, FREE = 0, 1, 2, 7

ACTION = np.zeros((LANES, 12), np.float32)
ACTION[:, 6:] = 1.0  # greatest stiffness
ACTION[TABLE, 2] = -1.0  # straight down
ACTION[LIMIT, 0] = -1.0  # into the base: joint 4 folds up
ACTION[SPHERE, 0] = 1.0  # forward, where a sphere is


@pytest.fixture(scope="module")
def start(quiet, arm):
    grip = arm.site(np.asarray(quiet.data.qpos[0]))[0]
    mocap = np.array(quiet.data.mocap_pos)
    mocap[SPHERE, 0] = grip + np.array([0.16, 0.0, 0.0])
    placed = np.zeros((LANES, 2), bool)
    placed[SPHERE, 0] = True
    data = quiet.data.replace(mocap_pos=jnp.asarray(mocap))
    info = quiet.info | {"spheres": quiet.info["spheres"].replace(placed=placed)}
    return quiet.replace(data=data, info=info)


def drive(task, state, more=0):
    """Metrics of every step, (STEPS, LANES) each, and the last state.

    With `more` the action has so many random entries besides, new ones in every step.
    """
    rows, rng = [], np.random.default_rng(0)
    for _ in range(STEPS):
        entries = np.sign(rng.uniform(-1.0, 1.0, (LANES, more)))
        action = np.concatenate([ACTION, entries.astype(np.float32)], axis=1)
        state = task.step(state, jnp.asarray(action))
        rows.append(state.metrics)
    return jax.tree.map(lambda *x: np.stack(x), *rows), state


@pytest.fixture(scope="module")
def vices(make, start):
    return drive(make("vices"), start)


@pytest.fixture(scope="module")
def rmp_vices(make, start):
    return drive(make("rmp_vices"), start)


def test_vices_runs_into_everything(vices):
    metrics, _ = vices
    assert np.any(metrics["collision"][:, TABLE])
    assert np.any(metrics["joint_limit"][:, LIMIT])
    assert np.any(metrics["collision"][:, SPHERE])
    assert metrics["contact_force_peak"][:, [TABLE, SPHERE]].max(axis=0).min() > 10.0


@pytest.fixture(scope="module")
def weighing(make, start):
    return drive(make("rmp_vices", leaf_weights=True), start, more=3)


@pytest.mark.parametrize("which", ["rmp_vices", "weighing"])
def test_rmp_vices_runs_into_nothing(which, request):
    """Nor does it if the policy weighs its leaves as wildly as it may."""
    metrics, _ = request.getfixturevalue(which)
    for name in ("collision", "self_collision", "joint_limit", "contact_force_peak"):
        assert not np.any(metrics[name]), name


def test_rmp_vices_still_goes_where_it_is_pushed(rmp_vices, arm, start):
    """To 5 cm above the table; a metre forward, past the sphere."""
    grips = [arm.site(np.asarray(q))[0] for q in rmp_vices[1].data.qpos]
    before = arm.site(np.asarray(start.data.qpos[0]))[0]
    assert -0.112 < grips[TABLE][2] < -0.112 + 0.05
    assert grips[SPHERE][0] > before[0] + 0.2


@pytest.mark.parametrize("which", ["vices", "rmp_vices"])
def test_an_arm_that_is_not_pushed_stays(which, request, arm, start):
    """Within 1 mm after 3 s: a resting set-point moves with the arm, no drift."""
    _, state = request.getfixturevalue(which)
    before = arm.site(np.asarray(start.data.qpos[0]))[0]
    after = arm.site(np.asarray(state.data.qpos[FREE]))[0]
    np.testing.assert_allclose(after, before, atol=1e-3)


def test_the_tree_sees_the_spheres_and_the_table_of_the_physics(make, start):
    env = make("rmp_vices").env
    lane = jax.tree.map(lambda x: x[SPHERE], start)
    seen = env.obstacles(lane.data, lane.info["spheres"])
    np.testing.assert_array_equal(seen.spheres.center, lane.data.mocap_pos)
    np.testing.assert_array_equal(seen.spheres.active, [True, False])
    model = env.scene.model
    for i in range(2):
        assert seen.spheres.radius[i] == pytest.approx(
            model.geom(f"sphere_{i}").size[0]
        )
    table = model.geom("table").pos
    np.testing.assert_allclose(seen.planes.point, [table], atol=1e-7)
    np.testing.assert_array_equal(seen.planes.normal, [[0.0, 0.0, 1.0]])
    assert np.all(seen.planes.active)


def test_clearance_of_the_tree_is_mujocos_distance(make, start, arm):
    """Within 0.5 mm: control points cover a capsule up to a scallop."""
    env = make("rmp_vices").env
    lane = jax.tree.map(lambda x: x[SPHERE], start)
    q, qd = lane.data.qpos, lane.data.qvel
    obstacles = env.obstacles(lane.data, lane.info["spheres"])
    setpoint = env.controller.setpoint(q, env.controller.decode(jnp.zeros(12)), 0.0)
    out = jax.jit(env.controller.__call__)(q, qd, setpoint, obstacles)
    model, data = env.scene.model, arm.data
    data.qpos[:], data.mocap_pos[:] = q, lane.data.mocap_pos
    mujoco.mj_kinematics(model, data)
    links = [f"arm/link_{i}" for i in range(1, 7)] + ["arm/hand", "arm/fingers"]
    nearest = min(
        mujoco.mj_geomDistance(
            model, data, model.geom(link).id, model.geom(other).id, 1.0, None
        )
        for link in links
        for other in ("sphere_0", "table")
        if (link, other) != ("arm/link_1", "table")
    )
    assert float(out.diagnostics["clearance"]) == pytest.approx(nearest, abs=5e-4)


@pytest.mark.slow
def test_both_engines_step_the_task_alike(make, close, quiet):
    """Free motion, then one lane falls onto the table.

    Before contact the observations agree to 1e-3; the impact happens in the same
    policy step, its mean force over the step agrees within 10 %, its peak within 20 %
    (float32 shifts a stiff impact by parts of a physics step).
    """
    switches = {"terminate_on_event": False, "terminate_on_success": False}
    options = {"observation": "fixed", "layout": "close", "event_penalty": 7.0}
    mjx = make("torques", physics="mjx", observer="exact", **switches, **options)
    action = jnp.zeros((LANES, 12)).at[0, 1].set(-25.0)
    ours, theirs = with_memory(mjx.env, quiet), quiet
    flags = []
    for _ in range(10):
        ours, theirs = mjx.step(ours, action), close.step(theirs, action)
        flags = [np.asarray(s.metrics["collision"]) for s in (ours, theirs)]
        np.testing.assert_array_equal(flags[0], flags[1])
        if np.any(flags[1]):
            break
        np.testing.assert_allclose(ours.obs, theirs.obs, atol=1e-3)
    np.testing.assert_array_equal(flags[1], np.eye(LANES)[0])
    for name, rel in (("contact_force", 0.1), ("contact_force_peak", 0.2)):
        force = [float(s.metrics[name][0]) for s in (ours, theirs)]
        assert force[1] > 1.0
        assert force[0] == pytest.approx(force[1], rel=rel)
    felt = np.abs(ours.info["control"].contact.tau_ext).max(axis=1)
    assert felt[0] > 1.0
    assert felt[1:].max() < 1e-3


@pytest.fixture(scope="module")
def leaning(far):
    """`leaning(**options)`: a controller that adds 0.2 of the torque it is told of."""

    def build(**options):
        controller = far.env.controller.replace(lean=0.2, robot=far.env.robot)
        options |= {"physics": "mujoco", "obstacles": 2, "terminate_on_event": False}
        env = envs.load("trajectory", controller=controller, **options)
        return SimpleNamespace(env=env, step=jax.jit(jax.vmap(env.step)))

    return build


def with_memory(env, state):
    memory = jax.vmap(env.remember)(state.data.qpos)
    return state.replace(info=state.info | {"control": memory})


def test_the_controller_is_told_the_contact_torque_of_the_step_before(
    leaning, quiet, arm
):
    """One lane falls on the table; MuJoCo C in double precision tells as much.

    It starts from our state at every policy step: within 1 % of the lane's own impact.
    """
    task = leaning(observer="exact")
    state = with_memory(task.env, quiet)
    action = np.zeros((LANES, 12), np.float32)
    action[0, 1] = -25.0
    hold = np.asarray(task.env.controller.hold, float)
    data, peak = arm.data, 0.0
    felt = told = np.zeros(7)
    for _ in range(12):
        before, state = state, task.step(state, jnp.asarray(action))
        mujoco.mj_resetData(arm.model, data)
        for name in ("qpos", "qvel", "mocap_pos"):
            getattr(data, name)[:] = getattr(before.data, name)[0]
        data.qacc_warmstart[:] = before.data.warmstart[0]
        for _ in range(task.env.n_substeps):
            told = felt
            data.ctrl[:] = hold + 0.2 * told
            data.ctrl[1] -= 25.0
            mujoco.mj_step(arm.model, data)
            felt = data.qfrc_constraint[:7].copy()
        peak = max(peak, np.abs(told).max())
        contact = state.info["control"].contact
        np.testing.assert_allclose(
            contact.tau_ext[0], told, rtol=0.0, atol=1e-3 + 0.01 * peak
        )
        low, high = arm.model.actuator_ctrlrange.T
        given = np.clip(data.ctrl, low, high)
        np.testing.assert_allclose(contact.tau[0], given, atol=1e-3 + 0.002 * peak)
        np.testing.assert_allclose(contact.tau_ext[1:], 0.0, atol=1e-3)
    assert peak > 10.0


def test_an_observer_measures_with_noise_and_delay(leaning, far):
    """Held at rest: what is left of the noise says its size, 3 % of 7,000 draws."""
    options = {"observer_noise": 0.01, "observer_delay": 0.015}
    task = leaning(observer="momentum", observer_gain=50.0, **options)
    assert task.env.observer.delay == 3
    state = with_memory(task.env, far.starts)
    still = jnp.zeros((1000, 12))
    seen = []
    for _ in range(2):
        state = task.step(state, still)
        contact = state.info["control"].contact
        assert contact.late.shape == (1000, 3, 7)
        seen.append(np.asarray(contact.qd - state.data.qvel))
    for error in seen:
        assert error.std() == pytest.approx(0.01, rel=0.03)
    assert abs(np.corrcoef(seen[0].ravel(), seen[1].ravel())[0, 1]) < 0.05


class Plain(Pytree):
    """A user's controller that knows nothing of contact torque."""

    inner: Torques

    def decode(self, action):
        return action

    def setpoint(self, q, action, time):
        return self.inner.setpoint(q, action, time)

    def __call__(self, q, qd, setpoint, obstacles):
        return self.inner(q, qd, setpoint, obstacles)


def test_a_controller_that_takes_no_contact_torque_runs_without_an_observer(far):
    plain = Plain(far.env.controller)
    env = envs.load("push", controller=plain, physics="mujoco", observer="none")
    state = env.reset(jax.random.key(0))
    assert jax.tree.leaves(state.info["control"]) == []
    assert np.all(np.isfinite(jax.jit(env.step)(state, jnp.zeros(12)).obs))
    with pytest.raises(ValueError, match=r"tau_ext=, which 'Plain' does not take"):
        envs.load("push", controller=plain)


class Frozen(Torques):
    """Gives the last torque again."""

    def __call__(self, q, qd, setpoint, obstacles, tau_ext=None, tau_last=None):
        out = super().__call__(q, qd, setpoint, obstacles, tau_ext)
        return out.replace(tau=tau_last)


def test_an_arm_with_limited_torque_rates_is_told_its_last_torque(far):
    """Before an episode that is what holds the arm at rest."""
    robot = far.env.robot.replace(tau_rate_max=np.full(7, 500.0))
    frozen = Frozen(far.env.controller.hold)
    env = envs.load("trajectory", controller=frozen, robot=robot, physics="mujoco")
    state = env.reset(jax.random.key(0))
    q = state.data.qpos
    holding = dynamics(robot, arm_state(robot, q, jnp.zeros(7)))[1]
    np.testing.assert_allclose(state.info["control"].tau, holding, atol=1e-5)
    step = jax.jit(env.step)
    for _ in range(3):
        state = step(state, jnp.zeros(12))
    np.testing.assert_array_equal(state.info["control"].tau, holding)
    np.testing.assert_allclose(state.data.qpos, q, atol=1e-4)

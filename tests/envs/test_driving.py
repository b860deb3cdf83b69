"""Both controllers driven into the table, a joint limit and a sphere."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from tests.envs.arm_tasks import LANES

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


def drive(task, state):
    """Metrics of every step, (STEPS, LANES) each, and the last state."""
    rows = []
    for _ in range(STEPS):
        state = task.step(state, jnp.asarray(ACTION))
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


def test_rmp_vices_runs_into_nothing(rmp_vices):
    metrics, _ = rmp_vices
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


def test_both_engines_step_the_task_alike(make, close, quiet):
    """Free motion, then one lane falls onto the table.

    Before contact the observations agree to 1e-3; the impact happens in the same
    policy step, its mean force over the step agrees within 10 %, its peak within 20 %
    (float32 shifts a stiff impact by parts of a physics step).
    """
    switches = {"terminate_on_event": False, "terminate_on_success": False}
    options = {"observation": "fixed", "layout": "close", "event_penalty": 7.0}
    mjx = make("torques", physics="mjx", **switches, **options)
    action = jnp.zeros((LANES, 12)).at[0, 1].set(-25.0)
    ours, theirs = quiet, quiet
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

"""What must not change the torque: the world frame, unused slots, batching."""

import jax
import mujoco
import numpy as np
import pytest

from rmp_mjx import Robot
from tests.control.conftest import changed


@pytest.fixture(scope="module")
def inputs(states, obstacles):
    q, qd, action = states(5)
    action[:, :6] *= 0.5  # stays within the range however it is turned
    action[:, 6:] = action[:, 6:7]  # the same stiffness along every axis
    return q, qd, action, obstacles(5)


def _moved_robot(robot):
    """The arm mounted elsewhere, by its MJCF; and the base's new pose."""
    mounted = robot.mjcf.replace(
        '<body name="base"', '<body name="base" pos=".3 -.2 .5" quat=".48 .36 -.48 .64"'
    )
    moved = Robot.from_mjcf(
        mounted, site="grip", q_home=robot.q_home, compensate_passive=False
    )
    data = mujoco.MjData(moved.mj_model)
    mujoco.mj_kinematics(moved.mj_model, data)
    p, R = data.body("base").xpos, data.body("base").xmat.reshape(3, 3)
    moved = moved.replace(gravity=R @ robot.gravity, mjcf=robot.mjcf)
    assert jax.tree.structure(moved) == jax.tree.structure(robot)  # compiles once
    return moved, p, R


def _move_obstacles(o, p, R):
    points, vectors = {"center", "point"}, {"velocity", "angular_velocity"}

    def move(kind):
        new = {}
        for name in kind.__dataclass_fields__:
            x = getattr(kind, name)
            if name in points:
                new[name] = x @ R.T + p
            elif name in vectors | {"normal", "axis"}:
                new[name] = x @ R.T
            elif name == "rotation":
                new[name] = R @ x
        return changed(kind, **new)

    kinds = ("spheres", "planes", "capsules", "boxes")
    return changed(o, **{k: move(getattr(o, k)) for k in kinds})


def test_mounting_the_arm_elsewhere_changes_no_torque(
    run64, robot, ctrl, vices, inputs
):
    """Base, gravity, obstacles and set-point moved together; 1e-8 of the limits.

    Rounding: the root's condition, up to about 1e6, on numbers of order one.
    """
    q, qd, action, near = inputs
    moved, p, R = _moved_robot(robot)
    turned = action.copy()
    turned[:, :3], turned[:, 3:6] = action[:, :3] @ R.T, action[:, 3:6] @ R.T
    for controller in (ctrl, vices):
        there = controller.replace(robot=moved)
        before = run64(controller, *inputs)
        after = run64(there, q, qd, turned, _move_obstacles(near, p, R))
        error = np.abs(after.tau - before.tau) / robot.tau_max
        assert error.max() < 1e-8


def test_unused_slots_contribute_exactly_nothing(run64, ctrl, inputs):
    """Whatever they contain, NaN-free."""
    q, qd, action, near = inputs
    before = run64(ctrl, *inputs)
    center = near.spheres.center.copy()
    center[:, 2] = [0.2, 0.0, 0.3]  # the third sphere's slot is not in use
    spheres = changed(near.spheres, center=center)
    after = run64(ctrl, q, qd, action, changed(near, spheres=spheres))
    np.testing.assert_array_equal(after.tau, before.tau)
    np.testing.assert_array_equal(after.M, before.M)


def test_switched_off_obstacles_are_no_obstacles(run64, ctrl, inputs):
    """All slots off equals a collision leaf without weight; clearance is infinite."""
    q, qd, action, near = inputs
    off = changed(
        near,
        **{
            kind: changed(
                getattr(near, kind), active=np.zeros_like(getattr(near, kind).active)
            )
            for kind in ("spheres", "planes", "capsules", "boxes")
        },
    )
    out = run64(ctrl, q, qd, action, off)
    weightless = ctrl.with_collision(ctrl.leaves.collision.replace(mu=0.0)).replace(
        obstacle_relaxation=ctrl.obstacle_relaxation.replace(min_weight=1.0)
    )
    np.testing.assert_array_equal(out.tau, run64(weightless, *inputs).tau)
    assert np.all(np.isinf(out.diagnostics["clearance"]))


def test_a_state_does_not_depend_on_its_neighbours_in_the_batch(run64, ctrl, inputs):
    """Reversed and repeated batches give the same numbers for the same state."""
    out = run64(ctrl, *inputs)
    reverse = run64(ctrl, *jax.tree.map(lambda x: x[::-1], inputs))
    np.testing.assert_allclose(reverse.tau[::-1], out.tau, rtol=1e-9, atol=1e-9)
    alone = run64(ctrl, *jax.tree.map(lambda x: np.repeat(x[7:8], 500, 0), inputs))
    np.testing.assert_allclose(alone.tau[0], out.tau[7], rtol=1e-9, atol=1e-9)


def test_clearance_is_the_distance_to_the_nearest_control_point(
    run64, ctrl, robot, inputs
):
    """Recomputed with MuJoCo's kinematics for the spheres of the first ten states."""
    q, qd, action, near = inputs
    only = changed(
        near,
        **{
            kind: changed(
                getattr(near, kind), active=np.zeros_like(getattr(near, kind).active)
            )
            for kind in ("planes", "capsules", "boxes")
        },
    )
    clearance = run64(ctrl, q, qd, action, only).diagnostics["clearance"]
    model = robot.mj_model
    data = mujoco.MjData(model)
    for k in range(10):
        data.qpos[:] = q[k]
        mujoco.mj_kinematics(model, data)
        gaps = [
            np.linalg.norm(
                data.body(body).xpos + data.body(body).xmat.reshape(3, 3) @ x - center
            )
            - rho
            - radius
            for (body, x, rho), hand in zip(
                robot.control_points, robot.points.hand, strict=True
            )
            for center, radius, touch in zip(
                *(near.spheres.center[k, :2], near.spheres.radius[k, :2]),
                near.spheres.hand_may_touch[k, :2],
                strict=True,
            )
            if not (hand and touch)
        ]
        np.testing.assert_allclose(clearance[k], min(gaps), atol=1e-12)

"""The controller in a plain MuJoCo loop: no task, no training, no batches.

    python docs/examples/mujoco_loop.py

The Jaco 2 reaches past a sphere: a set-point every 50 ms, a torque every 5 ms.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import rmp_mjx as rmp
from rmp_mjx.robot.kinematics import point_positions

SPHERE, RADIUS = np.array([0.42, -0.17, 0.10]), 0.05  # m, between start and target
MOVE = np.array([0.0, -0.35, 0.05])  # from the start of the hand to its target [m]


def main(seconds: float = 6.0) -> tuple[float, float]:
    """Distance of the hand to its target at the end, and least clearance [m]."""
    robot = rmp.Robot.load("jaco2")
    ctrl = rmp.RMPVICES(robot)
    obstacles = rmp.Obstacles.empty(spheres=1).with_spheres(
        jnp.array([SPHERE]), jnp.array([RADIUS])
    )
    setpoint_of, torque = jax.jit(ctrl.setpoint), jax.jit(ctrl)

    @jax.jit
    def clearance(q):
        gaps = jnp.linalg.norm(point_positions(robot, q) - SPHERE, axis=1)
        return jnp.min(gaps - jnp.asarray(robot.points.radius)) - RADIUS

    model = robot.mj_model
    data = mujoco.MjData(model)
    data.qpos[:] = robot.q_home
    mujoco.mj_forward(model, data)
    hand = data.site(robot.site_name)
    target, setpoint, least = hand.xpos + MOVE, None, np.inf
    for k in range(round(seconds / model.opt.timestep)):
        q, qd = np.float32(data.qpos), np.float32(data.qvel)
        if k % 10 == 0:  # as a policy would: at most 5 cm ahead of the hand
            action = rmp.Action(
                dpos=np.float32(np.clip(target - hand.xpos, -0.05, 0.05)),
                drot=np.zeros(3, np.float32),
                kp_pos=np.full(3, 200.0, np.float32),
                kp_ori=np.full(3, 200.0, np.float32),
            )
            setpoint = setpoint_of(q, action, np.float32(data.time))
            least = min(least, float(clearance(q)))
        data.ctrl[:] = torque(q, qd, setpoint, obstacles).tau
        mujoco.mj_step(model, data)
    return float(np.linalg.norm(target - hand.xpos)), least


if __name__ == "__main__":
    distance, least = main()
    print(f"{1e3 * distance:.0f} mm from the target; clearance {1e3 * least:.0f} mm")

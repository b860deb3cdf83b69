"""An arm of your own in a task: four joints, from a text.

    python docs/examples/own_arm.py

Any MJCF or URDF will do (`docs/bring_your_own_arm.md`). The task is the via points'; a
script that goes straight to them takes the policy's place.
"""

import jax
import jax.numpy as jnp
import numpy as np

import rmp_mjx as rmp
import rmp_mjx_envs as envs

ARM = """
<mujoco model="four">
  <default>
    <joint armature="0.1" damping="1" range="-150 150"/>
    <geom type="capsule" mass="1"/>
    <motor ctrlrange="-100 100"/>
  </default>
  <worldbody>
    <body name="base" pos="0 0 0.05">
      <joint name="turn" axis="0 0 1"/>
      <geom size="0.05" fromto="0 0 0 0 0 0.25"/>
      <body name="upper" pos="0 0 0.25">
        <joint name="lift" axis="0 1 0"/>
        <geom size="0.04" fromto="0 0 0 0 0 0.35"/>
        <body name="fore" pos="0 0 0.35">
          <joint name="bend" axis="0 1 0"/>
          <geom size="0.03" fromto="0 0 0 0 0 0.30"/>
          <body name="hand" pos="0 0 0.30">
            <joint name="tilt" axis="0 1 0"/>
            <geom size="0.03" fromto="0 0 0 0 0 0.08"/>
            <site name="tip" pos="0 0 0.11"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="turn"/> <motor joint="lift"/>
    <motor joint="bend"/> <motor joint="tilt"/>
  </actuator>
</mujoco>
"""


def main(seconds: float = 15.0) -> tuple[int, int]:
    """Via points that were reached, and policy steps with an event."""
    robot = rmp.Robot.from_mjcf(ARM, site="tip", q_home=[0.0, 0.4, 1.4, 0.7])
    task = envs.load("trajectory", robot=robot, terminate_on_event=False)

    def step(state, _):
        points, reached = state.task["points"], state.task["reached"]
        away = points[jnp.minimum(reached, len(points) - 1)] - task.site(state.data).p
        action = jnp.concatenate([jnp.clip(away / 0.05, -1.0, 1.0), jnp.zeros(9)])
        state = task.step(state, action)
        event = state.metrics["collision"] + state.metrics["self_collision"]
        return state, (state.task["reached"], event > 0)

    roll = jax.jit(
        lambda key: jax.lax.scan(
            step, task.reset(key), None, length=round(seconds / task.dt)
        )[1]
    )
    reached, events = roll(jax.random.key(0))
    return int(np.max(reached)), int(np.sum(events))


if __name__ == "__main__":
    print("via points reached: {}, events: {}".format(*main()))

# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # A tour of the controller
#
# Joint positions and velocities in, torques out. No simulator, no training.

# %%
import jax
import jax.numpy as jnp
import numpy as np

import rmp_mjx as rmp
from rmp_mjx.robot.kinematics import arm_state

robot = rmp.Robot.load("planar3")  # three links in a plane; "jaco2" is the paper's arm
ctrl = rmp.RMPVICES(robot)
print(robot)

# %% [markdown]
# ## An action
#
# A policy says every 50 ms where the hand should go next, and how stiffly. `decode`
# gives its action in [-1, 1] physical units; `setpoint` fixes the target in the world.

# %%
u = np.zeros(12, np.float32)  # all in the middle
u[2] = 1.0  # 5 cm up
action = ctrl.decode(u)
q = jnp.asarray(robot.q_home, jnp.float32)
setpoint = ctrl.setpoint(q, action, 0.0)
print("displacement [m]", action.dpos, "stiffness [1/s^2]", action.kp_pos)
print("target [m]", setpoint.p_des)

# %% [markdown]
# ## A torque
#
# The tree asks for an acceleration, the inverse dynamics make it a torque.

# %%
free = rmp.Obstacles.empty(spheres=1)
step = jax.jit(ctrl)
out = step(q, jnp.zeros(robot.n), setpoint, free)
print("acceleration [rad/s^2]", out.qdd)
print("torque [N m]", out.tau, "limit", robot.tau_max)

# %% [markdown]
# ## An obstacle
#
# A sphere just over the hand: the same target, another acceleration. Nothing is
# compiled anew, because obstacles have fixed slots.

# %%
above = setpoint.p_des + jnp.array([0.0, 0.0, 0.08])
sphere = free.with_spheres(above[None], jnp.array([0.05]))  # centre, radius [m]
avoiding = step(q, jnp.zeros(robot.n), setpoint, sphere)
print("acceleration [rad/s^2]", avoiding.qdd)
assert not np.allclose(avoiding.qdd, out.qdd, atol=0.1)

# %% [markdown]
# ## What the leaves ask
#
# Every branch of the tree has a force and a metric. A branch with a large metric is
# heard.


# %%
@jax.jit
def asked(q, qd):
    """What each branch asks of the joints."""
    return ctrl.asked(arm_state(robot, q, qd), setpoint, sphere)


for name, branch in asked(q, jnp.zeros(robot.n)).items():
    print(f"{name:20s} |f| {jnp.linalg.norm(branch.f):8.2f}")

# %% [markdown]
# ## Many arms
#
# The controller is a pytree: `jax.vmap`, `jax.grad` and `lax.scan` take it as it is.

# %%
qs = q + 0.05 * jax.random.normal(jax.random.key(0), (256, robot.n))
many = jax.jit(jax.vmap(ctrl, (0, None, None, None)))
taus = many(qs, jnp.zeros(robot.n), setpoint, sphere).tau
print(taus.shape, "all within the limits:", bool((abs(taus) <= robot.tau_max).all()))
assert np.isfinite(taus).all()

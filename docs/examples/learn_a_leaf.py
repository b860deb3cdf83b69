"""Learn a leaf's parameters by gradient, through a roll-out.

    python docs/examples/learn_a_leaf.py

A planar arm reaches. Stiffness and damping of the leaf are learned, so that the hand
arrives early and without force: the gradient goes through 300 steps of the tree.
"""

import jax
import jax.numpy as jnp
import optax

from rmp_mjx.rmp import Node, TaskMap, evaluate, resolve
from rmp_mjx.rmp.leaves import PositionAttractor

TARGET = jnp.array([0.6, 1.2])  # m
START = jnp.array([0.2, 0.6])  # rad
DT = 0.01  # s


def hand(q):
    """Hand of an arm with two links of 1 m, (2,) [m]."""
    a, b = q[0], q[0] + q[1]
    return jnp.array([jnp.cos(a) + jnp.cos(b), jnp.sin(a) + jnp.sin(b)])


def cost(parameters, steps):
    """Mean squared distance from the target, and a price of the acceleration."""
    kp, kd = jnp.exp(parameters["kp"]), jnp.exp(parameters["kd"])
    leaf = PositionAttractor(p_des=TARGET, kp=kp, kd=kd)
    tree = Node(TaskMap(hand), (leaf,))

    def step(state, _):
        q, qd = state
        qdd = resolve(evaluate(tree, q, qd), W=1e-3 * jnp.eye(2))
        qd = qd + DT * qdd
        q = q + DT * qd
        return (q, qd), jnp.sum((hand(q) - TARGET) ** 2) + 1e-4 * jnp.sum(qdd**2)

    return jnp.mean(jax.lax.scan(step, (START, jnp.zeros(2)), None, length=steps)[1])


def main(updates: int = 100, steps: int = 300) -> tuple[dict[str, float], list[float]]:
    """The parameters that were learned, and the cost before every update."""
    parameters = {"kp": jnp.log(10.0), "kd": jnp.log(1.0)}  # soft, and it swings
    adam = optax.adam(0.1)
    state, costs = adam.init(parameters), []
    gradient = jax.jit(lambda p: jax.value_and_grad(cost)(p, steps))
    for _ in range(updates):
        value, grad = gradient(parameters)
        change, state = adam.update(grad, state)
        parameters = optax.apply_updates(parameters, change)
        costs.append(float(value))
    return {name: float(jnp.exp(x)) for name, x in parameters.items()}, costs


if __name__ == "__main__":
    learned, costs = main()
    numbers = ", ".join(f"{name} {x:.1f}" for name, x in learned.items())
    print(f"cost {costs[0]:.3f} -> {costs[-1]:.3f}: {numbers}")

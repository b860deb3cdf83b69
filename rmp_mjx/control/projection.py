"""The point nearest to the origin in soft half-spaces, in batches."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rmp_mjx.math import psd_solve

STEPS = tuple(0.5**k for k in range(8))
"""Trial lengths of a Newton step."""
TOLERANCE, ITERATIONS = 3e-3, 20
"""Step length at which the solver stops, in units of x, and its iteration limit."""


def project(
    G: Float[Array, "n m"],
    h: Float[Array, " m"],
    penalty: Float[Array, ""] | float,
) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    r"""The quadratic program of a projection, with a penalty for its constraints.

    $$
    \min_x \tfrac12 \|x\|^2 + \tfrac{\rho}{2} \sum_j \max(0, g_j \cdot x - h_j)^2
    $$

    by Newton's method: the Hessian is $I + \rho \sum g_j g_j^T$ over the
    violated constraints, and the best of `STEPS` along the step makes it descend. The
    cost is strictly convex and quadratic in pieces, of which the method visits a few.

    Args:
        G: Constraints as columns g_j.
        h: Their bounds.
        penalty: The cost rho.

    Returns:
        x, and 1 where the method converged, else 0.

    Source: Pinar and Zenios, "On smoothing exact penalty functions for convex
    constrained optimization" (1994); Hintermueller, Ito and Kunisch, "The primal-dual
    active set strategy as a semismooth Newton method" (2002).
    """
    eye = jnp.eye(len(G), dtype=G.dtype)

    def newton(state):
        x, _, count = state
        over = x @ G - h
        violated = jnp.where(over[None] > 0.0, G, 0.0)
        gradient = x + penalty * (G @ jnp.maximum(over, 0.0))
        step = -psd_solve(eye + penalty * violated @ G.T, gradient)
        rise = step @ G
        costs = [
            jnp.sum((x + t * step) ** 2)
            + penalty * jnp.sum(jnp.maximum(over + t * rise, 0.0) ** 2)
            for t in STEPS
        ]
        step *= jnp.array(STEPS, G.dtype)[jnp.argmin(jnp.array(costs))]
        return x + step, jnp.max(jnp.abs(step)), count + 1

    def goes_on(state):
        _, moved, count = state
        return (moved > TOLERANCE) & (count < ITERATIONS)

    start = (jnp.zeros(len(G), G.dtype), jnp.array(jnp.inf, G.dtype), 0)
    x, moved, _ = jax.lax.while_loop(goes_on, newton, start)
    return x, jnp.asarray(moved <= TOLERANCE, G.dtype)

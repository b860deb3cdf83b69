"""The root of the tree under the limits of the motors: a box-constrained problem."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rmp_mjx.math import inverse_root, psd_solve
from rmp_mjx.pytree import Constant

ROUNDS, HURRIED = 64, 16
"""Most active sets that are tried, and those before the last row that is wrong moves
instead of the worst: slower, but it cannot go round in circles (Murty's rule)."""

GIVE = 1e-3
"""Softness of a soft limit."""

CHUNKS, LEAST = 16, 32
"""States of a batch that need the pivoting are worked off in this many parts of it, of
this size at least."""


class Rows(NamedTuple):
    """Linear functions of the acceleration, each with a range: low <= A qdd <= high."""

    A: Float[Constant, "m n"]
    """The rows."""
    low: Float[Constant, " m"]
    """Lower ends."""
    high: Float[Constant, " m"]
    """Upper ends."""
    give: Float[Constant, " m"]
    """Softness: 0 for a hard limit. A row with some gives way where not all can hold,
    by this share of what its multiplier moves it."""

    @staticmethod
    def hard(A: Constant, low: Constant, high: Constant) -> Rows:
        """Limits that always hold, (m, n), (m,), (m,)."""
        return Rows(A, low, high, jnp.zeros_like(low))

    @staticmethod
    def soft(A: Constant, low: Constant, high: Constant) -> Rows:
        """Limits that give way to hard ones."""
        return Rows(A, low, high, jnp.full_like(low, GIVE))

    @staticmethod
    def join(several: Iterable[Rows]) -> Rows:
        """All of them, one after the other."""
        return jax.tree.map(lambda *x: jnp.concatenate(x), *several)


@jax.custom_jvp
def solve_root(
    H: Float[Array, "n n"], f: Float[Array, " n"], rows: Rows
) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
    r"""The acceleration that the tree wants, as far as the motors can give it.

    $$
    \min_{\ddot q} \tfrac12 (\ddot q - H^{-1} f)^T H (\ddot q - H^{-1} f)
    \quad \text{s.t.} \quad l \le A \ddot q \le u
    $$

    H is the metric of the root, so that what weighs more keeps its way: attractors and
    posture give in before a collision leaf does. Scaling or clipping the free solution
    would take the braking of all joints as soon as one is saturated.

    The dual problem has a multiplier for each row. Block pivoting guesses the set of
    rows at their ends, solves for the multipliers, and moves all rows over that were
    on the wrong side. If that does not lower their number twice in a row, only the
    worst one is moved. It ends at the exact solution, after one to five sets as a rule
    and `ROUNDS` at most. Nothing is computed where the free solution fits. Derivatives
    are those of the solution with the rows that are at their ends held there.

    Args:
        H: Metric of the root, positive definite, (n, n).
        f: Its force, (n,).
        rows: The limits.

    Returns:
        Acceleration (n,) [rad/s^2], and for each row -1 or 1 where it is at its lower
        or upper end, else 0.

    Source: Judice and Pires, "A block principal pivoting algorithm for large-scale
    strictly monotone linear complementarity problems" (1994), for two-sided rows.
    """
    return _limited(H, f, rows)


@jax.custom_batching.custom_vmap
def _limited(
    H: Float[Array, "n n"], f: Float[Array, " n"], rows: Rows
) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
    """`solve_root` for one state."""

    def pivot(_):
        return _pivoted(H, f, rows)

    def keep(free):
        return free, jnp.zeros_like(rows.low)

    free, outside = _free(H, f, rows)
    return jax.lax.cond(outside, pivot, keep, free)


@_limited.def_vmap
def _limited_batch(axis_size, in_batched, H, f, rows):
    """`solve_root` for many states: only those that need it go through the pivoting.

    They are gathered, and worked off in chunks.
    """
    H, f, rows = jax.tree.map(
        lambda x, own: x if own else jnp.broadcast_to(x, (axis_size, *x.shape)),
        (H, f, rows),
        tuple(in_batched),
    )
    free, outside = jax.vmap(_free)(H, f, rows)
    count = jnp.sum(outside)
    place = jnp.where(outside, jnp.cumsum(outside) - 1, axis_size)
    chunk = max(axis_size // CHUNKS, min(axis_size, LEAST))
    order = jnp.full(axis_size + chunk, axis_size)
    order = order.at[place].set(jnp.arange(axis_size), mode="drop")

    def goes_on(state):
        return state[0] < count

    def solve(state):
        begin, qdd, at_end = state
        lanes = jax.lax.dynamic_slice(order, (begin,), (chunk,))
        those = jax.tree.map(lambda x: x.at[lanes].get(mode="clip"), (H, f, rows))
        new, ends = jax.vmap(_pivoted)(*those)
        qdd = qdd.at[lanes].set(new, mode="drop")
        return begin + chunk, qdd, at_end.at[lanes].set(ends, mode="drop")

    start = (jnp.zeros((), count.dtype), free, jnp.zeros_like(rows.low))
    _, qdd, at_end = jax.lax.while_loop(goes_on, solve, start)
    return (qdd, at_end), (True, True)


def _free(
    H: Float[Array, "n n"], f: Float[Array, " n"], rows: Rows
) -> tuple[Float[Array, " n"], Bool[Array, ""]]:
    """The unconstrained solution, and whether it breaks a limit."""
    qdd = psd_solve(H, f)
    t = jnp.matmul(rows.A, qdd, precision="highest")
    return qdd, jnp.any((t > rows.high) | (t < rows.low))


def _pivoted(
    H: Float[Array, "n n"], f: Float[Array, " n"], rows: Rows
) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
    """`solve_root` without a look at whether the free solution fits."""
    dual = _dual(H, f, rows)
    at_end, lam = _pivot(dual)
    return dual.solution(lam), at_end


class Dual(NamedTuple):
    """The problem in the multipliers of the rows, scaled to a unit diagonal."""

    free: Float[Array, " n"]
    """The unconstrained solution."""
    lift: Float[Array, "n m"]
    """What a unit multiplier of each (scaled) row takes from the solution."""
    W: Float[Array, "m m"]
    """What it takes from each (scaled) row."""
    t: Float[Array, " m"]
    """The rows at the unconstrained solution."""
    low: Float[Array, " m"]
    """Lower ends."""
    high: Float[Array, " m"]
    """Upper ends."""
    give: Float[Array, " m"]
    """Softness."""

    def solution(self, lam: Float[Array, " m"]) -> Float[Array, " n"]:
        """The acceleration under these multipliers, (n,)."""
        return self.free - jnp.matmul(self.lift, lam, precision="highest")


def _dual(H: Float[Array, "n n"], f: Float[Array, " n"], rows: Rows) -> Dual:
    dot = functools.partial(jnp.matmul, precision="highest")
    R = inverse_root(H)
    Y, y = dot(R, rows.A.T), dot(R, f)
    s = jax.lax.rsqrt(jnp.maximum(jnp.sum(Y * Y, axis=0), jnp.finfo(Y.dtype).tiny))
    Y = Y * s[None]
    return Dual(
        dot(R.T, y),
        dot(R.T, Y),
        dot(Y.T, Y),
        dot(Y.T, y),
        rows.low * s,
        rows.high * s,
        rows.give,
    )


def _multipliers(dual: Dual, at_end: Float[Array, " m"]) -> Float[Array, " m"]:
    """Multipliers that hold these rows at their ends, (m,); 0 for the others."""
    held = at_end != 0.0
    end = jnp.where(at_end > 0.0, dual.high, dual.low)
    over = jnp.where(held, dual.t - jnp.where(held, end, 0.0), 0.0)
    both = held[:, None] & held[None]
    give = jnp.maximum(dual.give, jnp.finfo(over.dtype).eps)  # rows may depend
    own = jnp.where(held, give, 1.0)
    return _eliminate(jnp.where(both, dual.W, 0.0) + jnp.diag(own), over, own)


def _eliminate(
    A: Float[Array, "m m"], b: Float[Array, " m"], own: Float[Array, " m"]
) -> Float[Array, " m"]:
    """Solve A x = b by Gauss-Jordan elimination, for A - diag(own) PSD.

    No pivot is less than its entry of `own`, but for rounding. As a loop it compiles
    faster than `psd_solve`. Few states come here.
    """
    least = jnp.maximum(own, len(b) * jnp.finfo(b.dtype).eps)

    def clear(k, rows):
        row = rows[k] / jnp.maximum(rows[k, k], least[k])
        rows = rows - rows[:, k][:, None] * row[None]
        return rows.at[k].set(row)

    rows = jnp.concatenate([A, b[:, None]], axis=1)
    return jax.lax.fori_loop(0, len(b), clear, rows)[:, -1]


def _pivot(dual: Dual) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """The rows at their ends in the solution, and the multipliers of all rows."""
    slack = 8.0 * jnp.finfo(dual.t.dtype).eps * (jnp.abs(dual.low) + jnp.abs(dual.high))

    def belongs(at_end, lam):
        """Where each row belongs, given the others, and how wrong it is now."""
        t = dual.t - jnp.matmul(dual.W, lam, precision="highest")
        over = (t > dual.high + slack).astype(t.dtype)
        under = (t < dual.low - slack).astype(t.dtype)
        free = at_end == 0.0
        leaves = lam * at_end < 0.0
        better = jnp.where(free, over - under, jnp.where(leaves, 0.0, at_end))
        beyond = jnp.maximum(t - dual.high, dual.low - t)
        wrong = jnp.where(free, beyond, -lam * at_end)
        return better, jnp.where(better == at_end, -jnp.inf, wrong)

    def goes_on(state):
        at_end, better, _, _, _, _, count = state
        return jnp.any(at_end != better) & (count < ROUNDS)

    def move(state):
        at_end, better, wrong, _, fewest, patience, count = state
        number = jnp.sum(at_end != better)
        fewer = number < fewest
        last = jnp.max(jnp.where(at_end != better, index, -1))
        one = index == jnp.where(count < HURRIED, jnp.argmax(wrong), last)
        at_end = jnp.where(fewer | (patience > 0) | one, better, at_end)
        patience = jnp.where(fewer, 1, jnp.maximum(patience - 1, 0))
        fewest = jnp.minimum(fewest, number)
        lam = _multipliers(dual, at_end)
        return at_end, *belongs(at_end, lam), lam, fewest, patience, count + 1

    none, index = jnp.zeros_like(dual.t), jnp.arange(len(dual.t))
    counts = (jnp.array(len(none) + 1), jnp.array(1), jnp.array(0))
    state = (none, *belongs(none, none), none, *counts)
    at_end, _, _, lam, *_ = jax.lax.while_loop(goes_on, move, state)
    return at_end, lam


@solve_root.defjvp
def _derivative(primals, tangents):
    qdd, at_end = solve_root(*primals)

    def held(H, f, rows):
        dual = _dual(H, f, rows)
        return dual.solution(_multipliers(dual, at_end))

    _, change = jax.jvp(held, primals, tangents)
    return (qdd, at_end), (change, jnp.zeros_like(at_end))

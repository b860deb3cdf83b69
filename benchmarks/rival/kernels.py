"""Compiled building blocks of the rival's controllers.

Spatial vectors are about the world's origin, linear part first.
"""

from __future__ import annotations

import numpy as np
from numba import njit  # pyright: ignore[reportMissingImports]

N = 7

FAST = {"contract", "reassoc", "nsz", "arcp"}
"""Floating-point freedoms that keep infinities (joints without limits) infinite."""


@njit(fastmath=FAST, cache=True)
def cross(a, b, out):
    """Vector product."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@njit(fastmath=FAST, cache=True)
def dot(a, b):
    """Scalar product of 3-vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(fastmath=FAST, cache=True)
def barrier(leaf, x, xd):
    """Metric and acceleration of the one-dimensional barrier; see ours.

    The leaf is (mu, eps, eta, r, margin, x_min, cap, k_out, v_out).
    """
    mu, eps, eta, r, margin = leaf[0], leaf[1], leaf[2], leaf[3], leaf[4]
    gap = max(x - margin, leaf[5])
    if gap >= r:
        return 0.0, 0.0
    v = min(xd, 0.0)
    fade = (1.0 - gap / r) / (gap * gap)
    m = min(mu * fade * fade * (v * v + eps), leaf[6])
    if xd > 0.0:
        m *= np.exp(-xd / leaf[8])
    return m, -eta * v + v * v / gap + leaf[7] * max(margin - x, 0.0)


@njit(fastmath=FAST, cache=True)
def add_row(f, M, row, count, m, a):
    """Pull a scalar leaf with this Jacobian row back to the joints (lower triangle)."""
    for i in range(count):
        w = m * row[i]
        f[i] += w * a
        for j in range(i + 1):
            M[i, j] += w * row[j]


@njit(fastmath=FAST, cache=True)
def solve(A, b):
    """Solve A x = b in place for a symmetric positive A (lower triangle): L D L^T."""
    n = len(b)
    for j in range(n):
        for k in range(j):
            A[j, j] -= A[j, k] * A[j, k] * A[k, k]
        for i in range(j + 1, n):
            for k in range(j):
                A[i, j] -= A[i, k] * A[j, k] * A[k, k]
            A[i, j] /= A[j, j]
    for i in range(n):
        for k in range(i):
            b[i] -= A[i, k] * b[k]
    for i in range(n):
        b[i] /= A[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= A[k, i] * b[k]


@njit(fastmath=FAST, cache=True)
def unpack(packed, Mq):
    """Both triangles of the inertia from MuJoCo's rows (a chain's have no gaps)."""
    at = 0
    for i in range(N):
        for j in range(i + 1):
            Mq[i, j] = Mq[j, i] = packed[at]
            at += 1


@njit(fastmath=FAST, cache=True)
def twists(anchor, axis, qd, S, V, A):
    """Joint columns, link twists and their rates at qdd = 0, (n, 6) each."""
    for j in range(N):
        z, s = axis[j], S[j]
        cross(anchor[j], z, s[:3])
        s[3:] = z
        for k in range(6):
            V[j, k] = s[k] * qd[j] + (V[j - 1, k] if j else 0.0)
        v, w = V[j, :3], V[j, 3:]
        for k in range(3):
            a, b = (k + 1) % 3, (k + 2) % 3
            lin = w[a] * s[b] - w[b] * s[a] + v[a] * z[b] - v[b] * z[a]
            ang = w[a] * z[b] - w[b] * z[a]
            A[j, k] = lin * qd[j] + (A[j - 1, k] if j else 0.0)
            A[j, 3 + k] = ang * qd[j] + (A[j - 1, 3 + k] if j else 0.0)


@njit(fastmath=FAST, cache=True)
def move(V, A, j, x, v, a):
    """Velocity and acceleration (qdd = 0) of the point x on link j; -1: at rest."""
    if j < 0:
        v[:] = 0.0
        a[:] = 0.0
        return
    for k in range(3):
        p, q = (k + 1) % 3, (k + 2) % 3
        v[k] = V[j, k] + V[j, 3 + p] * x[q] - V[j, 3 + q] * x[p]
        a[k] = A[j, k] + A[j, 3 + p] * x[q] - A[j, 3 + q] * x[p]
    for k in range(3):
        p, q = (k + 1) % 3, (k + 2) % 3
        a[k] += V[j, 3 + p] * v[q] - V[j, 3 + q] * v[p]


@njit(fastmath=FAST, cache=True)
def row_of(S, n, x, first, last, row):
    """Jacobian row n . J of the point x, joints first to last; the others zero."""
    xn = np.empty(3)
    cross(x, n, xn)
    for j in range(last + 1):
        row[j] = 0.0
        if j >= first:
            row[j] = dot(n, S[j, :3]) + dot(xn, S[j, 3:])


@njit(fastmath=FAST, cache=True)
def clamp(x):
    """To [0, 1]."""
    return min(max(x, 0.0), 1.0)

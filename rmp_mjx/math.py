"""Small dense mathematics: rotations, a PSD solve, safe norms and smooth gates.

Everything here is pure, works on single items (use `jax.vmap` for batches) and has
finite values and finite gradients on its whole documented domain.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float


def psd_solve(
    A: Float[Array, "n n"], b: Float[Array, " n"] | Float[Array, "n k"]
) -> Float[Array, " n"] | Float[Array, "n k"]:
    r"""Solve ``A x = b`` for a small symmetric positive (semi-)definite ``A``.

    A hand-unrolled $L D L^T$ factorisation after Jacobi scaling
    $A_{ij} / \sqrt{A_{ii} A_{jj}}$. It calls no LAPACK, so a batch of solves
    vectorises under `jax.vmap`. The scaling makes the accuracy independent of the
    units of the rows. Pivots are clamped at ``n`` machine epsilons (of the scaled
    matrix, whose diagonal is one). Where the clamped pivots of a singular matrix
    multiply up, beyond the square root of the largest number, the answer is zero. So a
    finite ``b`` gets a finite answer, not NaN.
    In float32 the relative error is about 1e-7 times the condition of the scaled
    matrix, so metrics of one tree should be capped to span less than about 1e6.

    Args:
        A: Symmetric PSD matrix, (n, n). Only the lower triangle is read.
        b: Right-hand side, (n,) or (n, k).

    Returns:
        The solution, shaped like ``b``.

    Raises:
        ValueError: If the shapes do not match.
    """
    n = A.shape[-1]
    if A.shape != (n, n) or b.ndim not in (1, 2) or b.shape[0] != n:
        raise ValueError(f"psd_solve needs A (n, n), b (n,): got {A.shape}, {b.shape}")
    scale, ell, inverse_pivot = _ldl(A)
    x = [b[i] * scale[i] for i in range(n)]
    for i in range(n):
        for k in range(i):
            x[i] = x[i] - ell[i][k] * x[k]
    x = [x[i] * inverse_pivot[i] for i in range(n)]
    for i in reversed(range(n)):
        for k in range(i + 1, n):
            x[i] = x[i] - ell[k][i] * x[k]
    x = jnp.stack([x[i] * scale[i] for i in range(n)])
    most = jnp.finfo(A.dtype).max ** 0.5
    solved = jnp.all(jnp.abs(x) <= most, axis=0, keepdims=True)  # False for NaN
    return jnp.where(solved, x, 0.0 * b)


def inverse_root(A: Float[Array, "n n"]) -> Float[Array, "n n"]:
    r"""A root of the inverse of a small PSD matrix: $A^{-1} = R^T R$.

    The inverse of A's lower Cholesky factor, from the factorisation of `psd_solve` with
    the same clamped pivots. So $x^T A^{-1} x = |R x|^2$ is never negative, also where A
    has negative eigenvalues by rounding. Where the clamped pivots of a singular matrix
    multiply up, R is zero. It calls no LAPACK: the batched calls of jaxlib 0.10 wait
    for the thread pool that runs them, and can wait for ever if several CPU devices do
    so at once.

    Args:
        A: Symmetric PSD matrix, (n, n). Only the lower triangle is read.
    """
    n = A.shape[-1]
    scale, ell, inverse_pivot = _ldl(A)
    rows: list[Array] = []
    for i in range(n):
        row = jnp.zeros(n, A.dtype).at[i].set(scale[i])
        for k in range(i):
            row = row - ell[i][k] * rows[k]
        rows.append(row)
    R = jnp.stack([jnp.sqrt(p) * x for p, x in zip(inverse_pivot, rows, strict=True)])
    most = jnp.finfo(A.dtype).max ** 0.25
    return jnp.where(jnp.all(jnp.abs(R) <= most), R, 0.0)


def _ldl(A: Float[Array, "n n"]) -> tuple[list[Array], list[list[Array]], list[Array]]:
    """Jacobi's scale, L below its diagonal, and the inverse pivots 1/D, unrolled."""
    n = A.shape[-1]
    floor = n * jnp.finfo(A.dtype).eps
    diagonal = [A[i, i] for i in range(n)]
    scale = [
        jnp.where(d > 0, jax.lax.rsqrt(jnp.where(d > 0, d, 1.0)), 1.0) for d in diagonal
    ]
    # Column-by-column LDL^T on scalars; c[i][j] holds L_ij D_j, ell[i][j] holds L_ij.
    c = [[A[i, j] * (scale[i] * scale[j]) for j in range(i + 1)] for i in range(n)]
    ell = [[c[i][j] for j in range(i)] for i in range(n)]
    inverse_pivot = []
    for j in range(n):
        for k in range(j):
            c[j][j] = c[j][j] - c[j][k] * ell[j][k]
        inverse_pivot.append(1.0 / jnp.maximum(c[j][j], floor))
        for i in range(j + 1, n):
            for k in range(j):
                c[i][j] = c[i][j] - c[i][k] * ell[j][k]
            ell[i][j] = c[i][j] * inverse_pivot[j]
    return scale, ell, inverse_pivot


LARGEST = 1e4
"""Largest number that counts as an input of a controller, in SI units."""

LOOSE = 0.05
"""Error of an orthonormal vector or matrix that may be rounding, in any precision."""


def bounded(x: Float[ArrayLike, ...], low: float = -LARGEST) -> Bool[Array, ""]:
    """Whether all numbers are finite, at least ``low`` and at most `LARGEST`."""
    return jnp.all((jnp.asarray(x) >= low) & (jnp.asarray(x) <= LARGEST))


def is_unit(x: Float[ArrayLike, "*b n"]) -> Bool[Array, "*b"]:
    """Whether vectors have length one, up to `LOOSE`."""
    x = jnp.asarray(x)
    return jnp.abs(jnp.sum(x * x, axis=-1) - 1.0) <= LOOSE


def is_rotation(R: Float[ArrayLike, "*b 3 3"]) -> Bool[Array, "*b"]:
    """Whether matrices are rotations, up to `LOOSE`: z = x cross y, of unit vectors."""
    x, y, z = (jnp.asarray(R)[..., i] for i in range(3))
    right_handed = jnp.all(jnp.abs(jnp.cross(x, y) - z) <= LOOSE, axis=-1)
    square = jnp.abs(jnp.sum(x * y, axis=-1)) <= LOOSE
    return right_handed & square & is_unit(x) & is_unit(y)


def safe_norm(x: Float[Array, "*b n"], eps: float = 1e-12) -> Float[Array, "*b"]:
    """Euclidean norm over the last axis, with a zero gradient at zero.

    Args:
        x: Vectors, (..., n).
        eps: Norms below this are returned as exactly zero.

    Returns:
        Norms, (...).
    """
    squared = jnp.sum(x * x, axis=-1)
    is_zero = squared <= eps * eps
    return jnp.where(is_zero, 0.0, jnp.sqrt(jnp.where(is_zero, 1.0, squared)))


def critical_damping(kp: Float[ArrayLike, "*s"]) -> Float[Array, "*s"]:
    """Damping gain ``2 sqrt(kp)`` [1/s] for a stiffness ``kp`` [1/s^2].

    The gradient at ``kp = 0`` is zero rather than infinite.
    """
    kp = jnp.asarray(kp)
    positive = kp > 0
    return jnp.where(positive, 2.0 * jnp.sqrt(jnp.where(positive, kp, 1.0)), 0.0)


def skew(w: Float[Array, " 3"]) -> Float[Array, "3 3"]:
    """Cross-product matrix: ``skew(w) @ v == cross(w, v)``."""
    zero = jnp.zeros_like(w[0])
    return jnp.stack(
        [
            jnp.stack([zero, -w[2], w[1]]),
            jnp.stack([w[2], zero, -w[0]]),
            jnp.stack([-w[1], w[0], zero]),
        ]
    )


def unskew(S: Float[Array, "3 3"]) -> Float[Array, " 3"]:
    """Inverse of `skew`; the antisymmetric part is taken of a general matrix."""
    return 0.5 * jnp.stack([S[2, 1] - S[1, 2], S[0, 2] - S[2, 0], S[1, 0] - S[0, 1]])


def quat_to_mat(quat: Float[Array, " 4"]) -> Float[Array, "3 3"]:
    """Rotation matrix of a unit quaternion in (w, x, y, z) order."""
    w, x, y, z = quat
    xx, yy, zz = 2 * x * x, 2 * y * y, 2 * z * z
    xy, xz, yz = 2 * x * y, 2 * x * z, 2 * y * z
    wx, wy, wz = 2 * w * x, 2 * w * y, 2 * w * z
    return jnp.stack(
        [
            jnp.stack([1 - yy - zz, xy - wz, xz + wy]),
            jnp.stack([xy + wz, 1 - xx - zz, yz - wx]),
            jnp.stack([xz - wy, yz + wx, 1 - xx - yy]),
        ]
    )


def mat_to_quat(R: Float[Array, "3 3"]) -> Float[Array, " 4"]:
    """Unit quaternion (w, x, y, z), ``w >= 0``, of a rotation matrix.

    ``4 q q^T`` is linear in R; the row with the largest diagonal entry is normalised,
    which is well conditioned for every rotation angle, pi included.
    """
    r00, r11, r22 = R[0, 0], R[1, 1], R[2, 2]
    wx, wy, wz = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    xy, xz, yz = R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1]
    outer = jnp.stack(
        [
            jnp.stack([1 + r00 + r11 + r22, wx, wy, wz]),
            jnp.stack([wx, 1 + r00 - r11 - r22, xy, xz]),
            jnp.stack([wy, xy, 1 - r00 + r11 - r22, yz]),
            jnp.stack([wz, xz, yz, 1 - r00 - r11 + r22]),
        ]
    )
    best = jnp.argmax(jnp.diagonal(outer))
    chosen = jnp.arange(4) == best
    row = jnp.sum(jnp.where(chosen[:, None], outer, 0.0), axis=0)
    quat = row / (2.0 * jnp.sqrt(jnp.sum(jnp.where(chosen, row, 0.0))))
    return jnp.where(quat[0] < 0, -quat, quat)


def exp_so3(w: Float[Array, " 3"]) -> Float[Array, "3 3"]:
    r"""Rotation matrix of a rotation vector (Rodrigues), smooth at zero.

    Args:
        w: Rotation vector, (3,), [rad].

    Returns:
        $\exp([w]_\times)$, (3, 3).
    """
    theta2 = jnp.sum(w * w)
    small = theta2 < 1e-4
    safe2 = jnp.where(small, 1.0, theta2)
    theta = jnp.sqrt(safe2)
    # Series to theta^4: the next terms are 2e-16 and 3e-17 at the switch.
    sinc = jnp.where(
        small, 1.0 - theta2 / 6.0 + theta2**2 / 120.0, jnp.sin(theta) / theta
    )
    # (1 - cos t) / t^2 written as a square of sines: no cancellation for small t.
    half = jnp.sin(0.5 * theta)
    cosc = jnp.where(
        small, 0.5 - theta2 / 24.0 + theta2**2 / 720.0, 2.0 * half * half / safe2
    )
    K = skew(w)
    K2 = jnp.outer(w, w) - theta2 * jnp.eye(3, dtype=w.dtype)
    return jnp.eye(3, dtype=w.dtype) + sinc * K + cosc * K2


def log_so3(R: Float[Array, "3 3"]) -> Float[Array, " 3"]:
    """Rotation vector of a rotation matrix, [rad]; angle in [0, pi].

    Value and derivatives (first and second) are finite at the identity; at an angle of
    pi the value is one of the two valid ones.
    """
    quat = mat_to_quat(R)
    w, v = quat[0], quat[1:]
    sin2 = jnp.sum(v * v)
    small = sin2 < 1e-6
    sin_half = jnp.sqrt(jnp.where(small, 1.0, sin2))
    ratio2 = sin2 / jnp.where(small, w * w, 1.0)
    series = 2.0 * (1.0 - ratio2 / 3.0 + ratio2**2 / 5.0) / jnp.where(small, w, 1.0)
    factor = jnp.where(small, series, 2.0 * jnp.arctan2(sin_half, w) / sin_half)
    return factor * v


def ramp(
    room: Float[Array, "*s"],
    near: Float[Array, ""] | float,
    far: Float[Array, ""] | float,
) -> Float[Array, "*s"]:
    """The share of the room that is lost: 0 from ``far`` on, 1 up to ``near``, linear.

    Args:
        room: Distances, any shape; may be infinite.
        near: Distance at which all is lost, below ``far``.
        far: Distance at which it begins.
    """
    inside = far - jnp.minimum(room, far)  # finite gradients at infinity
    return jnp.minimum(inside / (far - near), 1.0)


def orientation_error(
    R: Float[Array, "3 3"], R_des: Float[ArrayLike, "3 3"]
) -> Float[Array, " 3"]:
    r"""Orientation error $e_r = \tfrac12 \sum_i r_i \times r_{g,i}$.

    Equal to $\sin\theta$ times the world-frame axis of the rotation that takes
    ``R`` to ``R_des``: a positive gain on it converges. It shrinks again beyond 90
    degrees and vanishes at 180.

    Args:
        R: Current orientation, (3, 3).
        R_des: Desired orientation, (3, 3).

    Returns:
        Error in the world frame, (3,), [rad] for small angles.

    Source: Luh, Walker and Paul (1980); the argument order of VICES' code.
    """
    return 0.5 * jnp.sum(jnp.cross(R, R_des, axis=0), axis=-1)


def speed_gate(speed: Float[Array, "*s"], sigma: Float[Array, ""] | float):
    r"""Smooth gate $1 - \exp(-v^2 / 2 \sigma^2)$: 0 at rest, 1 when fast.

    Args:
        speed: Speeds, any shape, in the unit of ``sigma``.
        sigma: Width of the gate.

    Returns:
        Gate values in [0, 1), shaped like ``speed``.

    Source: RMPflow (Cheng et al., 2018), joint-limit metric.
    """
    return -jnp.expm1(-0.5 * (speed / sigma) ** 2)

"""Accuracy and speed of ways to solve the controller's root in float32.

Run as ``python -m benchmarks.solve_accuracy --json FILE --plot FILE.png``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import rmp_mjx as rmp
from benchmarks.common import Row, measure, show, write_json
from benchmarks.png import save_figure
from benchmarks.studies.root_systems import CLEARANCES, RootSampler, RootSystems
from rmp_mjx import runtime
from rmp_mjx.math import psd_solve
from rmp_mjx.rmp.leaves import collision_near

CAPS = (1e3, 1e4, 1e6)
BATCH = 2048
SYSTEMS = 256

Solver = Callable[[Array, Array, Array, Array], Array]
"""Maps rows A (r, n), b (r,) and normal equations M, f to qdd (n,)."""


def cholesky(A: Array, b: Array, M: Array, f: Array) -> Array:
    """LAPACK's Cholesky of the normal equations."""
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(M), f)


def pinv(A: Array, b: Array, M: Array, f: Array) -> Array:
    """Moore-Penrose inverse by SVD at its default cut-off, as the paper writes it."""
    return _dot(jnp.linalg.pinv(M), f)


def hermitian_pinv(A: Array, b: Array, M: Array, f: Array) -> Array:
    """The same by an eigendecomposition."""
    return _dot(jnp.linalg.pinv(M, hermitian=True), f)


def identity_damped(A: Array, b: Array, M: Array, f: Array) -> Array:
    """LDL^T after adding 1e-3 of the identity, as RMP2 does."""
    return psd_solve(M + 1e-3 * jnp.eye(M.shape[0], dtype=M.dtype), f)


def ldl(A: Array, b: Array, M: Array, f: Array) -> Array:
    """`psd_solve`: Jacobi scaling and an unrolled LDL^T. The controller's choice."""
    return psd_solve(M, f)


def refined(A: Array, b: Array, M: Array, f: Array) -> Array:
    """LDL^T and one refinement from the rows: corrected semi-normal equations."""
    x = psd_solve(M, f)
    return x + psd_solve(M, _dot(A.T, b - _dot(A, x)))


def lapack_qr(A: Array, b: Array, M: Array, f: Array) -> Array:
    """LAPACK's QR of the rows."""
    Q, R = jnp.linalg.qr(A)
    return jax.scipy.linalg.solve_triangular(R, _dot(Q.T, b))


def householder(A: Array, b: Array, M: Array, f: Array) -> Array:
    """Householder reflections over the columns, unrolled; the rows largest first."""
    n = A.shape[1]
    order = jnp.argsort(-jnp.max(jnp.abs(A), axis=1))
    work = jnp.concatenate([A, b[:, None]], axis=1)[order]
    for j in range(n):
        column = work[j:, j]
        norm = jnp.sqrt(jnp.sum(column * column))
        v = column.at[0].add(jnp.where(column[0] < 0, -norm, norm))
        share = 2.0 / jnp.maximum(jnp.sum(v * v), jnp.finfo(A.dtype).tiny)
        work = work.at[j:].add(-share * v[:, None] * _dot(v, work[j:]))
    x = [jnp.zeros((), A.dtype)] * n
    for i in reversed(range(n)):
        known = sum(work[i, k] * x[k] for k in range(i + 1, n))
        x[i] = (work[i, n] - known) / work[i, i]
    return jnp.stack(x)


SOLVERS: dict[str, Solver] = {
    "ldl": ldl,
    "ldl_refined": refined,
    "cholesky": cholesky,
    "identity_damped": identity_damped,
    "pinv": pinv,
    "pinv_hermitian": hermitian_pinv,
    "qr": lapack_qr,
    "householder": householder,
}
"""Solvers by name."""


def _dot(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision="highest")


def batched(solver: Solver) -> Callable[..., Array]:
    """The solver on a batch, the normal equations formed from the rows."""

    def solve(A: Array, b: Array) -> Array:
        def one(A: Array, b: Array) -> Array:
            return solver(A, b, _dot(A.T, A), _dot(A.T, b))

        return jax.vmap(one)(A, b)

    return solve


def relative_errors(x: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Error norm relative to the exact solution; inf where x is not finite."""
    error = np.linalg.norm(x - exact, axis=1) / np.linalg.norm(exact, axis=1)
    return np.where(np.isfinite(error), error, np.inf)


def accuracy(
    cap: float,
    clearance: float,
    systems: RootSystems,
    qdd: np.ndarray,
    solvers: dict[str, Callable[..., Array]],
) -> list[Row]:
    """Errors of every solver, and of the whole controller, in float32."""
    A, b = (np.asarray(x, np.float32) for x in (systems.A, systems.b))
    exact = np.stack(
        [
            np.linalg.lstsq(*pair, rcond=None)[0]
            for pair in zip(A.astype(np.float64), b.astype(np.float64), strict=True)
        ]
    )
    errors = {
        name: relative_errors(np.asarray(solver(A, b)), exact)
        for name, solver in solvers.items()
    }
    errors["controller"] = relative_errors(qdd, systems.qdd)
    rows = []
    double = np.stack(
        [
            np.linalg.lstsq(*pair, rcond=None)[0]
            for pair in zip(systems.A, systems.b, strict=True)
        ]
    )
    # In float64 the rows and the controller must be the same system.
    errors["rows_against_controller"] = relative_errors(double, systems.qdd)
    for name, error in errors.items():
        low, high = np.quantile(error, [0.5, 0.99])
        note = f"99th percentile {high:.2g}, worst {error.max():.2g}"
        key = f"{name}_cap{cap:.0e}_{clearance * 1e3:g}mm".replace("e+0", "e")
        rows.append(Row(key, float(low), "median relative error", note))
    condition = np.linalg.cond(A.astype(np.float64)) ** 2
    note = f"worst {condition.max():.2g}"
    key = f"condition_cap{cap:.0e}_{clearance * 1e3:g}mm".replace("e+0", "e")
    rows.append(Row(key, float(np.median(condition)), "median", note))
    return rows


def speed(systems: RootSystems, seconds: float) -> list[Row]:
    """Time of one solve, at batch 2048 and alone."""
    rows = []
    A, b = (jnp.asarray(x, jnp.float32) for x in (systems.A, systems.b))
    for batch in (BATCH, 1):
        pick = np.arange(batch) % len(A)
        args = A[pick], b[pick]
        M = jnp.einsum("bri,brj->bij", A[pick], A[pick], precision="highest")
        f = jnp.einsum("bri,br->bi", *args, precision="highest")
        for name, solver in SOLVERS.items():
            timing = measure(jax.vmap(solver), *args, M, f, seconds=seconds)
            value = timing.median / batch * 1e6
            rows.append(Row(f"{name}_us_batch{batch}", value, "us", timing.spread))
    return rows


def plot(rows: list[Row], path: Path) -> None:
    """Median error against clearance, one panel per cap; the band ends at p99."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    values = {row.key: row for row in rows}
    figure, axes = plt.subplots(1, len(CAPS), figsize=(11, 4), sharey=True)
    for axis, cap in zip(axes, CAPS, strict=True):
        for name in (*SOLVERS, "controller"):
            keys = [
                f"{name}_cap{cap:.0e}_{c * 1e3:g}mm".replace("e+0", "e")
                for c in CLEARANCES
            ]
            style = "k--" if name == "controller" else "o-"
            y = [
                values[k].value if np.isfinite(values[k].value) else np.nan
                for k in keys
            ]
            axis.loglog(np.array(CLEARANCES) * 1e3, y, style, ms=3, lw=1, label=name)
        axis.set(title=f"metric cap {cap:.0e}", xlabel="clearance [mm]")
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("median relative error of qdd, float32")
    axes[-1].legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.tight_layout()
    save_figure(figure, path, dpi=130)
    plt.close(figure)


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """Read the options."""
    parser = argparse.ArgumentParser(description="Accuracy of the root solve.")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--plot", type=Path, help="draw the errors into this file")
    parser.add_argument(
        "--quick", action="store_true", help="a smoke test: few systems"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the random states")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> None:
    """Measure, print, draw, and write the requested files."""
    args = parse(argv)
    runtime.configure()
    count, seconds = (16, 0.05) if args.quick else (SYSTEMS, 2.0)
    robot = rmp.Robot.load("jaco2")
    rows: list[Row] = []
    leaves = rmp.Leaves.default(robot).replace(self_collision=None)
    sampler = RootSampler(rmp.RMPVICES(robot, leaves))
    drawn = {}
    for cap in CAPS:
        leaf = collision_near().replace(cap=cap)
        for clearance in CLEARANCES:
            systems = sampler.draw(leaf, clearance, count, args.seed)
            drawn[cap, clearance] = leaf, systems
    jax.clear_caches()
    solvers = {name: jax.jit(batched(solver)) for name, solver in SOLVERS.items()}
    for (cap, clearance), (leaf, systems) in drawn.items():
        single = sampler.float32(leaf, systems)
        rows += accuracy(cap, clearance, systems, single, solvers)
    systems = drawn[CAPS[0], 0.02][1]
    rows += speed(systems, seconds)
    show(rows, "Root solve")
    if args.plot:
        plot(rows, args.plot)
    if args.json:
        write_json(args.json, rows, seed=args.seed, systems=count, quick=args.quick)


if __name__ == "__main__":
    main()

"""The projection onto soft half-spaces against an exact solver."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rmp_mjx.control.projection import project

clarabel = pytest.importorskip("clarabel")

from scipy import sparse  # noqa: E402

N, M, BATCH, PENALTY = 7, 48, 64, 1e3


@pytest.fixture(scope="module")
def programs():
    """Half-spaces with unit normals; some of the first cannot all hold."""
    rng = np.random.default_rng(0)
    G = rng.normal(size=(BATCH, N, M))
    h = rng.uniform(0.0, 300.0, (BATCH, M))
    h[:, :4] -= 200.0
    return G / np.linalg.norm(G, axis=1, keepdims=True), h


def exact(G, h):
    """Clarabel's solution, the violations as variables of their own."""
    m = len(h)
    cost = sparse.block_diag([sparse.eye(N), PENALTY * sparse.eye(m)]).tocsc()
    A = sparse.hstack([sparse.csc_matrix(G.T), -sparse.eye(m)]).tocsc()
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    cone = [clarabel.NonnegativeConeT(m)]
    solver = clarabel.DefaultSolver(cost, np.zeros(N + m), A, h, cone, settings)
    return np.array(solver.solve().x[:N])


def test_projections_are_clarabels(programs):
    """Relative to changes of some hundreds: 1e-4, float32 with a condition of 1e3."""
    G, h = programs
    solve = jax.jit(jax.vmap(lambda G, h: project(G, h, PENALTY)))
    x, solved = jax.device_get(solve(jnp.float32(G), jnp.float32(h)))
    assert solved.all()
    wanted = np.array([exact(*program) for program in zip(G, h, strict=True)])
    size = np.linalg.norm(wanted, axis=1)
    assert np.median(size) > 10.0
    assert np.linalg.norm(x - wanted, axis=1).max() < 1e-4 * size.max()


def test_the_origin_is_kept_where_it_is_inside(programs):
    G, h = programs
    x, solved = project(jnp.float32(G[0]), jnp.abs(jnp.float32(h[0])), PENALTY)
    assert solved == 1.0 and (x == 0.0).all()


def test_it_says_where_it_gave_up():
    _, solved = project(jnp.full((2, 3), jnp.nan), jnp.zeros(3), PENALTY)
    assert solved == 0.0

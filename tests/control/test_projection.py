"""The projection onto soft half-spaces against an exact solver."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rmp_mjx.control.projection import project
from tests import oracles

clarabel = pytest.importorskip("clarabel")

N, M, BATCH, PENALTY = 7, 48, 64, 1e3


@pytest.fixture(scope="module")
def programs():
    """Half-spaces with unit normals; some of the first cannot all hold."""
    rng = np.random.default_rng(0)
    G = rng.normal(size=(BATCH, N, M))
    h = rng.uniform(0.0, 300.0, (BATCH, M))
    h[:, :4] -= 200.0
    return G / np.linalg.norm(G, axis=1, keepdims=True), h


def test_projections_are_clarabels(programs):
    """Relative to changes of some hundreds: 1e-4, float32 with a condition of 1e3."""
    G, h = programs
    solve = jax.jit(jax.vmap(lambda G, h: project(G, h, PENALTY)))
    x, solved = jax.device_get(solve(jnp.float32(G), jnp.float32(h)))
    assert solved.all()
    soft = partial(oracles.soft_program, clarabel, np.eye(N), np.zeros(N))
    wanted = np.array([soft(G[k].T, h[k], np.ones(M), PENALTY) for k in range(BATCH)])
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

"""The study's policies, intervals and solvers, without running a simulation."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.common import ROOT, Row, insert
from benchmarks.studies import policies, random_policies, solve_accuracy
from rmp_mjx import ActionRange


def test_the_interval_of_no_event_is_the_exact_poisson_bound():
    # -ln(0.025): the largest mean that gives no event with probability 2.5 %.
    assert random_policies.poisson(0) == (0.0, pytest.approx(-np.log(0.025)))


def test_the_interval_of_many_events_approaches_the_normal_one():
    low, high = random_policies.poisson(10_000)
    # Normal approximation, good to the skew's 1 / sqrt(n) of its width.
    assert low == pytest.approx(10_000 - 196, abs=4)
    assert high == pytest.approx(10_000 + 196, abs=4)


def test_a_stiffness_survives_the_way_through_an_action():
    entry = policies.stiffness(150.0)
    action = jnp.full(12, entry)
    # float32 arithmetic of a logarithm and a power.
    np.testing.assert_allclose(ActionRange().decode(action).kp_pos, 150.0, rtol=1e-5)


def test_the_hard_policy_moves_near_its_limits_and_stays_stiff():
    hard = policies.hard()
    keys = jax.random.split(jax.random.key(0), 64)
    action = jax.jit(jax.vmap(hard.start))(keys)
    assert (jnp.abs(action[:, :6]) >= 0.8).all() and (jnp.abs(action) <= 1.0).all()
    kp = jax.jit(jax.vmap(ActionRange().decode))(action).kp_pos
    assert (kp >= 149.9).all() and (kp <= 300.1).all()


def test_the_smooth_policy_keeps_its_variance():
    smooth = policies.smooth(deviation=0.5)
    memory = jax.jit(jax.vmap(smooth.start))(jax.random.split(jax.random.key(1), 512))
    keys = jax.random.split(jax.random.key(2), 20 * 512).reshape(20, 512)
    act = jax.jit(jax.vmap(smooth.act, (0, 0, None)))
    blind = policies.View(jnp.zeros(3), jnp.zeros(3), jnp.zeros(1))
    for key in keys:
        memory, action = act(memory, key, blind)
        assert (jnp.abs(action) <= 1.0).all()
    # 6144 correlated samples: the standard error of the deviation is under 1 %.
    assert float(memory.std()) == pytest.approx(0.5, rel=0.04)


@pytest.mark.parametrize("length", [0.01, 0.5])
def test_the_straight_policy_heads_for_the_target_within_the_range(length):
    straight = policies.straight()
    to_target = jnp.array([1.0, -2.0, 0.5]) / 2.0 * length
    view = policies.View(to_target, jnp.zeros(3), jnp.zeros(1))
    _, action = straight.act(jnp.zeros(12), jax.random.key(0), view)
    dpos = ActionRange().decode(action).dpos
    assert (jnp.abs(action) <= 1.0).all()
    np.testing.assert_allclose(jnp.cross(dpos, to_target), 0.0, atol=1e-7)
    if length == 0.01:  # within the range it asks for all of the way
        np.testing.assert_allclose(dpos, to_target, rtol=1e-5)


@pytest.mark.parametrize("name", sorted(solve_accuracy.SOLVERS))
def test_every_solver_solves_a_well_conditioned_system(name):
    rng = np.random.default_rng(0)
    A = rng.standard_normal((1, 30, 7)).astype(np.float32)
    b = rng.standard_normal((1, 30)).astype(np.float32)
    exact = np.linalg.lstsq(A[0].astype(float), b[0].astype(float), rcond=None)[0]
    solve = jax.jit(solve_accuracy.batched(solve_accuracy.SOLVERS[name]))
    x = solve(A, b)[0]
    # Condition of the normal equations is about 10; RMP2's damping itself costs 1e-4.
    tolerance = 1e-3 if name == "identity_damped" else 1e-5
    assert np.linalg.norm(x - exact) < tolerance * np.linalg.norm(exact)


def test_the_adversary_presses_towards_the_obstacle_as_hard_as_it_can():
    adversary = policies.adversarial()
    memory = adversary.start(jax.random.key(0))
    toward = jnp.array([0.6, 0.0, -0.8])
    _, action = adversary.act(
        memory, jax.random.key(1), policies.View(jnp.zeros(3), toward, jnp.zeros(1))
    )
    np.testing.assert_allclose(action[:3], toward / 0.8, rtol=1e-6)
    np.testing.assert_allclose(ActionRange().decode(action).kp_pos, 300.0, rtol=1e-5)


def test_the_table_of_the_ablation_is_that_of_the_committed_rows():
    stored = json.loads((ROOT / "benchmarks/results/ablation.json").read_text())
    table = random_policies.table([Row(**row) for row in stored["rows"]])
    assert table.count("\n") == len(random_policies.CONTROLLERS) + 1
    page = (ROOT / "docs/ablation.md").read_text()
    assert insert(page, {"ablation": table}) == page


def test_the_printed_leaf_acts_on_a_body_that_leaves_and_accelerates_it():
    """1e-5: float32 rounding of the fourth power."""
    x, xd = jnp.full(2, 0.1), jnp.asarray([-0.5, 0.5])
    f, m = random_policies.PrintedCollision(eta=2.0).scalar(x, xd)
    np.testing.assert_allclose(m, [0.0, 2500.0], rtol=1e-5)
    np.testing.assert_allclose(f, [0.0, 2500.0], rtol=1e-5)

"""Contact readings where the right answer is known without a simulator."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rmp_mjx.sim import load_physics, read_contacts
from rmp_mjx.sim.base import _take

G = 9.81
ROD, TARGET, BALL = range(3)  # the order of the pairs in conftest.py


@pytest.fixture(scope="module", params=["mujoco", "mjx"])
def settled(request, weights):
    """0.8 s under constant forces: none, pressing, lifting, against the target."""
    engine = load_physics(request.param, weights)
    force = jnp.array([[0.0, 0.0], [5.0, 7.0], [30.0, 40.0], [50.0, 0.0]])
    target = jnp.full((4, 1, 3), jnp.array([0.0, 0.0, 5.0]))
    target = target.at[3].set(jnp.array([0.0, 0.0, 0.32]))
    force = force.at[1].multiply(-1.0)
    q = jnp.zeros((4, 2))
    state = jax.vmap(engine.init)(q, q, target)

    @jax.jit
    def run(state):
        step = lambda s, _: (jax.vmap(engine.step)(s, force), None)  # noqa: E731
        return jax.lax.scan(step, state, None, length=400)[0]

    state = run(state)
    return jax.vmap(lambda s: read_contacts(weights, s))(state), state


def test_resting_force_is_the_weight_in_the_order_of_the_pairs(settled):
    """Within 0.3 %: what is left of the settling motion after 0.8 s, in float32."""
    force = np.asarray(settled[0].force)
    expected = np.zeros((4, 3))
    expected[0, [ROD, BALL]] = 3 * G, 2 * G
    expected[1, [ROD, BALL]] = 3 * G + 7, 2 * G + 5
    expected[3, [ROD, TARGET]] = 3 * G, 50 - 2 * G
    np.testing.assert_allclose(force, expected, rtol=3e-3, atol=1e-3)


def test_touching_pairs_are_those_that_carry_force(settled):
    contacts = settled[0]
    np.testing.assert_array_equal(contacts.touching, np.asarray(contacts.force) > 0)


def test_what_is_lifted_off_touches_nothing(settled):
    contacts, state = settled
    assert np.all(state.qpos[2] > 0.5)
    assert not np.any(contacts.touching[2])


@pytest.mark.parametrize("index", [[], [3, 4, 5], [0, 1, 6, 7, 2]])
def test_what_is_read_by_slices_is_what_is_indexed(index):
    x, index = jnp.arange(8.0), np.array(index, int)
    np.testing.assert_array_equal(_take(x, index), x[index])


def test_pairs_that_are_not_watched_do_not_collide(weights):
    assert weights.npair == 3
    assert not weights.geom_contype.any() and not weights.geom_conaffinity.any()


def test_obstacles_start_where_the_model_puts_them(weights):
    engine = load_physics("mujoco", weights)
    state = engine.init(jnp.zeros(2), jnp.zeros(2))
    np.testing.assert_array_equal(state.mocap_pos, [[0.0, 0.0, 5.0]])

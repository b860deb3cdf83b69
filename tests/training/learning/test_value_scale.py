"""Value targets are scaled without moving the values."""

import jax
import jax.numpy as jnp
import numpy as np

from rmp_mjx.training.learning import value_scale
from rmp_mjx.training.learning.networks import make_networks


def test_the_first_update_takes_the_moments_of_the_targets():
    targets = jnp.array([1.0, 3.0, 100.0, 5.0])
    weight = jnp.array([1.0, 1.0, 0.0, 1.0])
    scale = value_scale.update(value_scale.init(), targets, weight)
    np.testing.assert_allclose(scale.mean, 3.0, rtol=1e-6)  # float32
    np.testing.assert_allclose(scale.std, np.std([1, 3, 5]), rtol=1e-6)


def test_the_moments_follow_returns_that_grow():
    scale = value_scale.init()
    for k in range(200):
        targets = 100.0 * k + jnp.linspace(-1.0, 1.0, 50)
        scale = value_scale.update(scale, targets, jnp.ones(50))
    # an average over the last 1 / 0.05 = 20 updates lags by 19 of them
    np.testing.assert_allclose(scale.mean, 19900 - 1900, rtol=1e-3)


def test_rescaling_keeps_every_value():
    networks = make_networks(3, 2, (8, 8), -0.5)
    params = networks.value_network.init(jax.random.key(0))
    obs = jax.random.normal(jax.random.key(1), (16, 3))
    old = value_scale.ValueScale(jnp.float32(2.0), jnp.float32(9.0), jnp.float32(0.5))
    new = value_scale.ValueScale(jnp.float32(700.0), jnp.float32(4e4), jnp.float32(0.5))
    moved = value_scale.rescale_output(params, old, new)

    def value(params, scale):
        # constant statistics: the preprocessing is not what is tested
        from brax.training.acme import running_statistics

        statistics = running_statistics.init_state(jnp.zeros(3))
        return scale.restore(networks.value_network.apply(statistics, params, obs))

    # 700 is subtracted and added again in float32: 700 * 2^-23 = 8e-5, a few times
    np.testing.assert_allclose(value(moved, new), value(params, old), atol=5e-4)

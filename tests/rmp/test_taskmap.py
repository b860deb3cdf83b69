"""Pushforward against finite differences along true trajectories, in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rmp_mjx.math import exp_so3, safe_norm
from rmp_mjx.rmp.taskmap import TaskMap, identity_map, pushforward

pytestmark = pytest.mark.usefixtures("x64")


def _curve(x):
    return jnp.stack([jnp.sin(x[0]) * x[1], jnp.cos(x[1]) + x[2] ** 2, x[0] * x[2]])


def _distance(params, x):
    return safe_norm(x - params["center"]) - params["radius"]


def _rotation(x):
    return exp_so3(x)


def _moving_sphere():
    return TaskMap(
        _distance,
        {"center": jnp.asarray([0.3, -0.2, 0.5]), "radius": jnp.asarray(0.1)},
        {"center": jnp.asarray([0.4, 1.0, -0.7]), "radius": jnp.asarray(0.05)},
    )


X = np.array([0.3, -0.7, 1.1])
XD = np.array([0.9, 0.4, -1.3])
XDD = np.array([-0.5, 2.0, 0.8])


@pytest.mark.parametrize(
    "make",
    [
        lambda: TaskMap(_curve),
        lambda: TaskMap(_rotation),
        _moving_sphere,
        lambda: _moving_sphere().replace(fn=lambda p, x: _distance(p, _curve(x))),
        lambda: TaskMap(lambda x: _curve(_curve(x))),
    ],
    ids=["curve", "rotation", "moving", "moving_of_curve", "curve_of_curve"],
)
def test_pushforward_gives_the_motion_of_the_child_along_a_trajectory(make):
    """Velocity and acceleration of psi(x(t), p(t)) for an accelerating x(t)."""
    psi = make()
    pushed = jax.jit(pushforward)(psi, jnp.asarray(X), jnp.asarray(XD))

    def child(t):
        return np.asarray(psi.at_time(jnp.asarray(X + t * XD + t * t / 2 * XDD), t))

    h = 1e-4
    velocity = (child(h) - child(-h)) / (2 * h)
    acceleration = (child(h) - 2 * child(0.0) + child(-h)) / h**2
    np.testing.assert_allclose(pushed.x, child(0.0), atol=1e-14)
    # 1e-6 and 2e-6: h^2 truncation with derivatives up to 1e2; rounding is
    # 1e-16 / h^2 = 1e-8.
    np.testing.assert_allclose(pushed.xd, velocity, atol=1e-6)
    np.testing.assert_allclose(pushed.J @ XDD + pushed.Jdot_qd, acceleration, atol=2e-6)


def test_identity_map_changes_nothing():
    pushed = pushforward(identity_map(), jnp.asarray(X), jnp.asarray(XD))
    np.testing.assert_array_equal(pushed.x, X)
    np.testing.assert_array_equal(pushed.xd, XD)
    np.testing.assert_array_equal(pushed.J, np.eye(3))
    np.testing.assert_array_equal(pushed.Jdot_qd, np.zeros(3))


def test_a_still_map_with_parameters_has_no_velocity_of_its_own():
    psi = _moving_sphere().replace(params_dot=None)
    pushed = pushforward(psi, jnp.asarray(X), jnp.zeros(3))
    np.testing.assert_array_equal(pushed.xd, 0.0)
    np.testing.assert_array_equal(pushed.Jdot_qd, 0.0)


def test_values_of_any_shape_are_flattened_row_by_row():
    assert pushforward(_moving_sphere(), jnp.asarray(X), jnp.asarray(XD)).J.shape == (
        1,
        3,
    )
    np.testing.assert_array_equal(
        TaskMap(_rotation)(jnp.asarray(X)), exp_so3(jnp.asarray(X)).reshape(-1)
    )


def test_equal_maps_do_not_retrace():
    traces = []

    @jax.jit
    def f(psi, x):
        traces.append(1)
        return psi(x)

    for _ in range(3):
        f(_moving_sphere(), jnp.asarray(X))
    assert len(traces) == 1


def test_pushforward_is_differentiable_in_the_parameters():
    def curvature(params):
        psi = _moving_sphere().replace(params=params)
        return jnp.sum(pushforward(psi, jnp.asarray(X), jnp.asarray(XD)).Jdot_qd)

    grads = jax.grad(curvature)(_moving_sphere().params)
    assert all(np.all(np.isfinite(g)) for g in jax.tree.leaves(grads))
    assert np.any(np.asarray(grads["center"]) != 0.0)

"""From a policy's action to physical units and a set-point."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rmp_mjx import Action, ActionRange, WeightedActionRange
from rmp_mjx.control.action import compose_setpoint
from rmp_mjx.math import exp_so3

RANGE = ActionRange()


def _decode(*entries):
    return RANGE.decode(jnp.broadcast_to(jnp.asarray(entries, jnp.float32), (12,)))


@pytest.mark.parametrize(
    ("u", "dpos", "drot", "kp"),
    [
        (-1.0, -0.05, -0.2, 10.0),
        (0.0, 0.0, 0.0, np.sqrt(10.0 * 300.0)),  # the middle of a logarithmic scale
        (1.0, 0.05, 0.2, 300.0),
    ],
)
def test_ends_and_middle_of_the_range(u, dpos, drot, kp):
    """1e-6 relative: float32."""
    action = _decode(u)
    np.testing.assert_allclose(action.dpos, [dpos] * 3, rtol=1e-6)
    np.testing.assert_allclose(action.drot, [drot] * 3, rtol=1e-6)
    np.testing.assert_allclose(action.kp_pos, [kp] * 3, rtol=1e-6)
    np.testing.assert_allclose(action.kp_ori, [kp] * 3, rtol=1e-6)


def test_entries_come_in_the_documented_order():
    action = RANGE.decode(jnp.linspace(-1.0, 1.0, 12))
    joined = jnp.concatenate(jax.tree.leaves(action))
    expected = [action.dpos, action.drot, action.kp_pos, action.kp_ori]
    np.testing.assert_array_equal(joined, jnp.concatenate(expected))
    assert np.all(np.diff(action.kp_pos) > 0) and action.kp_ori[0] > action.kp_pos[2]


@pytest.mark.parametrize("size", [1.5, 1e30])
def test_values_outside_are_clipped(size):
    for sign in (-1.0, 1.0):
        for a, b in zip(
            jax.tree.leaves(_decode(sign * size)),
            jax.tree.leaves(_decode(sign)),
            strict=True,
        ):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_non_finite_entry_counts_as_zero(bad):
    u = jnp.full(12, 0.5).at[jnp.array([1, 4, 7, 11])].set(bad)
    action, zero = RANGE.decode(u), _decode(0.0)
    assert action.dpos[1] == 0.0 and action.drot[1] == 0.0
    assert action.kp_pos[1] == zero.kp_pos[1] and action.kp_ori[2] == zero.kp_ori[2]
    np.testing.assert_array_equal(action.dpos[0], _decode(0.5).dpos[0])


def test_ranges_are_parameters():
    wide = ActionRange(dpos=0.1, drot=0.5, kp_min=1.0, kp_max=100.0)
    action = wide.decode(jnp.ones(12))
    np.testing.assert_allclose(action.dpos, 0.1, rtol=1e-6)
    np.testing.assert_allclose(action.kp_ori, 100.0, rtol=1e-6)
    kp = jax.vmap(
        lambda most: wide.replace(kp_max=most).decode(jnp.ones(12)).kp_pos[0]
    )(jnp.array([50.0, 200.0]))
    np.testing.assert_allclose(kp, [50.0, 200.0], rtol=1e-6)


def test_setpoint_displaces_the_pose_in_the_world_frame():
    p, R = jnp.array([0.1, 0.2, 0.3]), exp_so3(jnp.array([0.5, -1.0, 0.3]))
    kp = jnp.array([10.0, 20.0, 30.0])
    setpoint = compose_setpoint(
        p, R, Action(jnp.array([0.01, 0, 0]), jnp.array([0, 0, 0.2]), kp, 2 * kp), 0.7
    )
    np.testing.assert_allclose(setpoint.p_des, [0.11, 0.2, 0.3], rtol=1e-6)
    c, s = np.cos(0.2), np.sin(0.2)
    about_world_z = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    np.testing.assert_allclose(setpoint.R_des, about_world_z @ R, atol=1e-6)
    np.testing.assert_array_equal(setpoint.kp_pos, kp)
    np.testing.assert_array_equal(setpoint.kp_ori, 2 * kp)
    assert setpoint.time == np.float32(0.7)


WEIGHTED = WeightedActionRange()
entry = st.floats(width=32)  # infinite and not-a-number, too


@settings(deadline=None)
@given(entries=st.lists(entry, min_size=3, max_size=3))
def test_no_policy_weighs_the_leaves_beyond_their_bounds(entries):
    """1e-6 relative: powers in float32."""
    action = jnp.concatenate([jnp.full(12, 0.3), jnp.asarray(entries, jnp.float32)])
    weights = WEIGHTED.decode(action).weights
    assert weights is not None
    assert 0.1 * (1 - 1e-6) <= float(weights.attractor) <= 1.0
    assert 0.1 * (1 - 1e-6) <= float(weights.posture) <= 10.0 * (1 + 1e-6)
    assert 0.0 <= float(weights.standoff) <= 0.03 * (1 + 1e-6)


@pytest.mark.parametrize(
    ("u", "attractor", "posture", "standoff"),
    [
        (-1.0, 0.1, 0.1, 0.0),
        (-0.5, 10**-0.5, 10**-0.5, 0.0),
        (0.0, 1.0, 1.0, 0.0),
        (0.5, 1.0, 10**0.5, 0.015),
        (1.0, 1.0, 10.0, 0.03),
        (np.nan, 1.0, 1.0, 0.0),
    ],
)
def test_the_last_entries_weigh_the_leaves(u, attractor, posture, standoff):
    action = WEIGHTED.decode(jnp.full(15, 0.3).at[12:].set(u))
    found = jnp.stack(jax.tree.leaves(action.weights))
    np.testing.assert_allclose(found, [attractor, posture, standoff], rtol=1e-6)
    plain = RANGE.decode(jnp.full(12, 0.3))
    assert plain.weights is None
    assert action.replace(weights=None) == plain


def test_an_action_of_the_other_size_is_refused():
    assert (RANGE.size, WEIGHTED.size) == (12, 15)
    for kind in (RANGE, WEIGHTED):
        with pytest.raises(ValueError, match=rf"shape \({kind.size},\)"):
            kind.decode(jnp.zeros(27 - kind.size))

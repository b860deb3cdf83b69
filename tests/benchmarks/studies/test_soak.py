"""What a soak pays its attackers for, and what it reports of memory."""

import types

import jax.numpy as jnp
import numpy as np

from benchmarks.studies import soak


def _paid(pay, clearance=1.0, room=1.0, **events):
    robot = types.SimpleNamespace(n=2, q_lower=-jnp.ones(2), q_upper=jnp.ones(2))
    metrics = {"collision": 0.0, "joint_limit": 0.0, "clearance": clearance} | events
    data = types.SimpleNamespace(qpos=jnp.array([0.0, 1.0 - room, 9.0]))
    env, state = types.SimpleNamespace(robot=robot), types.SimpleNamespace
    return float(pay(env, state(metrics=metrics, data=data)))


def test_who_is_paid_to_hit_gets_more_the_nearer_and_most_for_a_contact():
    far, near = (_paid(soak.hits, clearance=d) for d in (0.1, 0.01))
    assert far < near < 1.0 < 20.0 < _paid(soak.hits, clearance=-0.01, collision=1.0)


def test_who_is_paid_for_limits_gets_more_the_nearer_and_most_at_one():
    far, near = (_paid(soak.limits, room=d) for d in (0.2, 0.02))
    assert far < near < 1.0 < 20.0 < _paid(soak.limits, room=0.0, joint_limit=1.0)


def test_memory_that_grows_is_reported_by_the_minute():
    times = [float(t) for t in range(10)]
    used = np.array([[100.0 + 3.0 * t, 5, 7] for t in times])
    rows = {row.key: row.value for row in soak.rows_of({}, times, used)}
    assert np.isclose(rows["memory_growth"], 3.0, rtol=1e-6)  # a line is fitted exactly
    assert rows["descriptors"] == rows["threads"] == 0

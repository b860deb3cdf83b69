"""The scripted experts and how their episodes are counted."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from benchmarks.studies import experts, observer

QUIET = ("success", "collision", "self_collision", "joint_limit", "work_force")


def episodes(**steps):
    """Metrics of four episodes of six steps; `name=((step, episode), ...)` is 1."""
    metrics = {name: np.zeros((6, 4)) for name in (*QUIET, "work_force_peak")}
    for name, where in steps.items():
        for step, episode in where:
            metrics[name][step, episode] = 1.0
    rows = experts.summarise("case", 0.05, metrics)
    return {row.key.removeprefix("case/"): row for row in rows}


def test_success_counts_before_the_first_event_only():
    rows = episodes(
        success=((2, 0), (3, 0), (4, 1), (1, 2)),
        collision=((3, 1), (2, 2)),
    )
    assert rows["success"].value == 50.0
    assert rows["time"].value == pytest.approx(0.05 * 2.5)  # steps 3 and 2, counted
    assert rows["events"].value == 1
    assert rows["events"].note == "collision 1, self_collision 0, joint_limit 0"


def test_no_success_has_no_time_and_no_touch_no_force():
    rows = episodes(joint_limit=((0, 3),))
    assert rows["success"].value == 0.0 and "time" not in rows
    assert rows["events"].value == 1
    assert "work_force" not in rows


def test_force_is_the_mean_while_touching_and_until_the_end():
    rows = episodes(success=((3, 0),), work_force=((1, 0), (5, 0)))
    assert rows["work_force"].value == 1.0
    assert "peak 0 N" in rows["work_force"].note


def test_a_command_aims_at_its_target_within_the_action_range():
    env = envs.load("trajectory", controller="vices", physics="mujoco")
    state = env.reset(jax.random.key(0))
    site = env.site(state.data)
    near = experts.command(env, state, site.R, site.p + jnp.array([0.01, 0.0, -0.02]))
    far = experts.command(env, state, site.R, site.p + jnp.array([0.3, -0.6, 0.0]))
    np.testing.assert_allclose(near[:3], [0.2, 0.0, -0.4], atol=1e-5)
    np.testing.assert_allclose(far[:3], [0.5, -1.0, 0.0], atol=1e-5)
    for action in (near, far):
        np.testing.assert_allclose(action[3:6], 0.0, atol=1e-6)
        np.testing.assert_array_equal(action[6:], 1.0)


def test_an_expert_opens_the_door_without_an_event():
    env = envs.load("door", controller="rmp_vices", physics="mujoco")
    metrics = experts.play(env, experts.pull, episodes=4, steps=80, seed=0)
    rows = {r.key: r.value for r in experts.summarise("door", env.dt, metrics)}
    assert rows["door/success"] == 100.0 and rows["door/events"] == 0
    assert rows["door/time"] < 4.0


def test_every_task_has_an_expert():
    assert {case.task for case in experts.CASES} == set(envs.names())


def test_an_observers_delay_and_errors_are_found():
    """Random torques for 1 s, then 1 s of rest; felt 10 % too weak, 3 steps late."""
    acted = np.random.default_rng(0).normal(size=(400, 2, 7))
    acted[200:] = 0.0
    trace = observer.Trace(measured=None, acted=acted, dt=0.005)
    felt = np.roll(0.9 * acted, 3, axis=0)
    felt[300:] = 0.01
    figures = observer.judge(trace, felt)
    assert figures["delay"] == pytest.approx(15.0)
    assert figures["shifted"] == pytest.approx(0.1, abs=0.01)
    assert figures["torque"] == pytest.approx(np.sqrt(7), rel=0.05)
    assert figures["median"] == pytest.approx(1.9**0.5 * np.sqrt(7), rel=0.1)
    assert figures["false"] == pytest.approx(0.01 * np.sqrt(7))

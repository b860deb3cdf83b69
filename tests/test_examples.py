"""The examples and notebooks run, in small sizes, and do what they say."""

import importlib.util
import runpy
import sys
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from envs import cli, outside, registry
from tests.envs import arm_tasks
from tests.training.conftest import SMALL

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "examples"
NOTEBOOKS = FOLDER.parent / "notebooks"
PROGRAMS = {path.stem for path in FOLDER.glob("*.py")} - {"ros2_node"}
"""All but the node, which tests/deploy/test_ros2.py runs."""


def example(name):
    """The module of an example."""
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", sorted(PROGRAMS))
def test_an_example_is_short_and_the_page_lists_it(name):
    assert len((FOLDER / f"{name}.py").read_text().splitlines()) < 80
    assert f"`{name}.py`" in (FOLDER.parent / "examples.md").read_text()


def test_the_plain_loop_reaches_past_the_sphere():
    distance, clearance = example("mujoco_loop").main()
    assert distance < 0.01  # m; it settles within a millimetre
    assert 0.0 < clearance < 0.05  # the sphere was in the way, and was not touched


def test_the_own_arm_visits_via_points():
    reached, events = example("own_arm").main(seconds=8.0)
    assert reached >= 2 and events == 0  # all four take about twice the time


def test_the_own_leaf_holds_the_hand_above_its_floor():
    module = example("own_leaf")
    without, with_leaf = module.main(seconds=2.0)
    assert without < module.FLOOR - 0.05
    assert with_leaf > module.FLOOR - 0.01  # the floor is 1 cm soft


def test_a_leafs_parameters_are_learned():
    parameters, costs = example("learn_a_leaf").main(updates=30, steps=150)
    assert costs[-1] < 0.7 * costs[0]
    assert parameters["kp"] > 10.0 and parameters["kd"] > 1.0


def test_the_own_task_is_found_by_its_name_and_runs(monkeypatch):
    """What follows, training and evaluation, is as in tests/envs/test_outside.py."""
    monkeypatch.chdir(FOLDER)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(outside, "_found", {})
    flags = ["--env", "own_task:Circle", "--radius", "0.08", "--controller", "osc"]
    env = registry.make(cli.parse_train(flags)[0].config.task)
    sys.modules.pop("own_task")
    state = jax.jit(env.reset)(jax.random.key(0))
    new = jax.jit(env.step)(state, jnp.zeros(env.action_size))
    assert new.obs.shape == (env.observation_size,)
    assert 0.0 < float(new.reward) < 1.0
    assert float(new.obs[-2] ** 2 + new.obs[-1] ** 2) == pytest.approx(1.0, abs=1e-5)


def test_gymnasiums_environment_plays_an_episode_for_stable_baselines3():
    pytest.importorskip("gymnasium")
    pytest.importorskip("stable_baselines3")
    assert example("gymnasium_sb3").main(steps=64) > 0.0


@pytest.mark.parametrize("path", sorted(NOTEBOOKS.glob("*.py")), ids=lambda p: p.stem)
def test_a_notebook_runs_as_a_script_and_the_page_lists_it(path, tmp_path, monkeypatch):
    """Training and evaluation are those of a toy task, which is another environment."""
    arm_tasks.register(monkeypatch)
    sizes = {n: SMALL[n] for n in ("num_envs", "unroll_length", "num_minibatches")}
    words = [f"--{name}={value}" for name, value in sizes.items()]
    monkeypatch.setenv("RMP_MJX_TASK", "counter")
    monkeypatch.setenv("RMP_MJX_SIZES", " ".join([*words, "--num_timesteps=256"]))
    monkeypatch.setenv("RMP_MJX_EPISODES", "4")
    monkeypatch.setattr(tempfile, "mkdtemp", lambda: str(tmp_path))
    runpy.run_path(str(path))
    assert path.read_text().count("# %% [markdown]") > 3
    assert f"`{path.name}`" in (NOTEBOOKS.parent / "examples.md").read_text()

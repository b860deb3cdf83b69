"""The repository stays light: what is tracked, how much, and in which form."""

import subprocess
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.flags import load_config
from rmp_mjx.training.policy import load_policy
from rmp_mjx.training.runs import policies

ROOT = Path(__file__).resolve().parents[1]
MOST_BYTES, MOST_FILES = 6_480_000, 600
SHARDS = {"checkpoints", "ocdbt.process_0"}
"""Folders of an Orbax checkpoint."""


@pytest.fixture(scope="module")
def tracked():
    """Every tracked file."""
    if not (ROOT / ".git").exists():
        pytest.skip("no checkout of git")
    command = ["git", "ls-files", "-z"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, check=True, text=True)
    return [path for name in done.stdout.split("\0") if (path := ROOT / name).is_file()]


def test_the_tracked_tree_is_small(tracked):
    sizes = {path: path.stat().st_size for path in tracked}
    largest = sorted(sizes, key=lambda path: -sizes[path])[:5]
    names = ", ".join(f"{p.relative_to(ROOT)} {sizes[p]:,}" for p in largest)
    assert sum(sizes.values()) <= MOST_BYTES, f"the largest: {names}"


def test_the_tracked_files_are_few(tracked):
    assert len(tracked) <= MOST_FILES


def test_no_checkpoint_is_tracked(tracked):
    assert not [p for p in tracked if SHARDS & set(p.relative_to(ROOT).parts)]


def test_no_figure_is_tracked_in_two_formats(tracked):
    pictures = [p.with_suffix("") for p in tracked if p.suffix in (".png", ".svg")]
    assert pictures
    assert len(set(pictures)) == len(pictures)


def test_no_page_is_tracked_beside_its_source(tracked):
    pages = {path for path in tracked if path.suffix == ".html"}
    assert not {path for path in pages if path.with_suffix(".md") in tracked}


FOLDER = Path(__file__).resolve().parents[1] / "pretrained"


@pytest.mark.parametrize("controller", ["vices", "rmp_vices"])
@pytest.mark.parametrize("task", ["trajectory", "door", "push"])
def test_a_pretrained_policy_loads_by_its_name_and_acts(task, controller):
    path = policies.find(str(FOLDER / f"{task}-{controller}"))
    config = load_config(path)
    assert (config.task.env, config.task.controller) == (task, controller)
    env = envs.load(task, controller=controller)
    iterations, agent = policies.load_agent(env, config, path, True, pytest.fail)
    assert iterations * config.ppo.steps_per_iteration >= 1_500_000
    obs = jax.random.normal(jax.random.key(0), (50, env.observation_size))
    action = agent(obs, jax.random.key(1))
    assert action.shape == (50, env.action_size)
    assert jnp.all(jnp.abs(action) <= 1.0)
    assert np.std(action, axis=0).min() > 0.0  # every entry depends on what it sees


@pytest.mark.parametrize("task", ["trajectory", "door", "push"])
def test_a_pretrained_policy_that_sees_spheres_says_so(task):
    path = policies.find(str(FOLDER / f"{task}-rmp_vices-spheres"))
    options = load_config(path).task
    assert (options.env, options.seen_spheres) == (task, 2)
    env = envs.make(options)
    agent = load_policy(path).agent(env.observation_size, env.action_size, True)
    obs = jnp.zeros(env.observation_size)
    assert agent(obs, jax.random.key(0)).shape == (env.action_size,)


@pytest.mark.parametrize("arm", ["panda", "ur5e", "iiwa14"])
@pytest.mark.parametrize("task", ["trajectory", "door", "push"])
def test_a_pretrained_policy_of_another_arm_says_so_and_fits_every_arm(task, arm):
    path = policies.find(str(FOLDER / f"{task}-rmp_vices-{arm}"))
    options = load_config(path).task
    assert (options.env, options.robot) == (task, arm)
    widths = {load_policy(path).arrays["normalizer/mean"].shape}
    jaco = policies.find(str(FOLDER / f"{task}-rmp_vices"))
    assert widths == {load_policy(jaco).arrays["normalizer/mean"].shape}


def test_a_pretrained_policy_says_what_it_was_measured_to_do():
    """The README's table has 96.6 % and 0.1 % of it, with other starts: within the
    intervals of each other."""
    found = load_policy(FOLDER / "door-rmp_vices.safetensors").about["evaluation"]
    assert (found["task"]["obstacles"], found["task"]["layout"]) == (2, "close")
    assert (found["episodes"], found["deterministic"]) == (1000, True)
    assert (found["success_rate"], found["collision_rate"]) == (0.969, 0.002)
    low, high = found["collision_rate_ci95"]
    assert low < found["collision_rate"] < high


def test_there_is_nothing_but_policies():
    assert {path.suffix for path in FOLDER.iterdir()} == {policies.SUFFIX}

"""The documents' own task trains, goes on and is evaluated, from a temporary folder."""

import json
import os
import re
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from rmp_mjx.training.policy import load_policy

SMALL = "--controller osc --observer none --episode_length 32 --hidden_sizes 8 "
SMALL += "--num_envs 8 --unroll_length 16 --num_timesteps 256 --eval_episodes 0"
MODULE, POINT = "my_task:Reach", "reach"


@pytest.fixture(scope="module")
def source(root):
    """my_task.py of docs/add_a_task.md."""
    text = (root / "docs" / "add_a_task.md").read_text()
    blocks = re.findall(r"^```python\n(.*?)^```", text, re.S | re.M)
    return next(block for block in blocks if "class Reach(" in block)


def test_the_task_of_the_documents_is_short_and_steps(source):
    assert len(source.splitlines()) < 60
    names: dict[str, Any] = {"__name__": "__main__"}
    exec(compile(source, "my_task.py", "exec"), names)
    env = names["Reach"](names["ReachOptions"](physics="mujoco"))
    state = jax.eval_shape(env.reset, jax.random.key(0))
    after = jax.eval_shape(env.step, state, jnp.zeros(env.action_size))
    assert after.obs.shape == (env.observation_size,) == (21,)


@pytest.mark.slow
@pytest.mark.parametrize("name", [MODULE, POINT])
def test_a_task_in_a_folder_trains_resumes_and_is_evaluated(
    root, source, tmp_path, name
):
    """By module:Class it is named each time; an installed one the files may name."""
    place = tmp_path if name == MODULE else tmp_path / "site"
    info = place / "reach_tasks-1.0.dist-info"
    info.mkdir(parents=True)
    (place / "my_task.py").write_text(source)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: reach\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[rmp_mjx.tasks]\nreach = my_task:Reach\n")
    path = os.pathsep.join([str(root), *([str(place)] if name == POINT else [])])

    def run(script, *options):
        return subprocess.run(
            [sys.executable, str(root / script), *options, "--no_video"],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": path},
            capture_output=True,
            text=True,
            check=False,
        )

    named = ["--env", name]
    begun = run("train.py", *named, "--goal", "middle", *SMALL.split(), "--run_dir=r")
    assert begun.returncode == 0, begun.stderr
    for script, flag in (("train.py", "--resume"), ("eval.py", "--run")):
        again = [flag, "r", *(["--num_timesteps=384"] if flag == "--resume" else [])]
        if name == MODULE:
            refused = run(script, *again)
            assert refused.returncode == 2 and len(refused.stderr.splitlines()) == 1
            assert f"add --env {name}" in refused.stderr
            again += named
        done = run(script, *again)
        assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "r" / "eval.json").read_text())
    assert (found["task"]["env"], found["task"]["goal"]) == (name, "middle")
    assert found["training_iterations"] == 3
    about = load_policy(tmp_path / "r" / "policy.safetensors").about
    assert about["config"]["task"] == found["task"]

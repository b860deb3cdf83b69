# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Train, evaluate and look
#
# What `train.py` and `eval.py` do, in a few cells. On two cores the sizes below take
# about two minutes; `RMP_MJX_STEPS` sets another number of policy steps.

# %%
import os
import tempfile
from pathlib import Path

import polars as pl

from envs import eval as evaluation
from envs import train

steps = int(os.environ.get("RMP_MJX_STEPS", "400000"))
folder = Path(os.environ.get("RMP_MJX_RUN") or tempfile.mkdtemp()) / "run"

# %% [markdown]
# ## Train
#
# The default task: four via points with the Jaco 2 under RMP-VICES.

# %%
flags = [
    "--num_timesteps",
    str(steps),
    "--eval_episodes",
    "0",
    "--run_dir",
    str(folder),
]
if steps < 10_000:  # a test
    flags += ["--num_envs", "8", "--unroll_length", "8", "--controller", "osc"]
assert train.main(flags) == 0

# %% [markdown]
# ## The learning curve
#
# Every iteration left a row.

# %%
rows = pl.read_parquet(folder / "metrics.parquet")
print(rows.select("steps", "episode/return", "episode/success").tail(5))

# %% [markdown]
# ## Evaluate
#
# Episodes of the mean action, among two spheres that training never saw.

# %%
episodes = "100" if steps > 10_000 else "2"
flags = ["--run", str(folder), "--deterministic", "--obstacles", "2", "--no-video"]
flags += ["--episodes", episodes]
if steps < 10_000:
    flags += ["--episode_length", "16"]
assert evaluation.main(flags) == 0

# %% [markdown]
# ## Look
#
# One row for each episode. `python -m rmp_mjx.viewer --run FOLDER` shows the policy in
# the browser.

# %%
found = pl.read_parquet(folder / "episodes.parquet")
print(found.select("return", "success", "collision", "clearance").head())

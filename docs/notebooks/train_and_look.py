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
# What `train.py` and `eval.py` do, in a few cells: about two minutes on two cores.

# %%
import os
import tempfile
from pathlib import Path

import polars as pl

from envs import eval as evaluation
from envs import train

task = os.environ.get("RMP_MJX_TASK", "trajectory")
sizes = os.environ.get("RMP_MJX_SIZES", "--num_timesteps 400000").split()
episodes = os.environ.get("RMP_MJX_EPISODES", "100")
folder = str(Path(tempfile.mkdtemp()) / "run")

# %% [markdown]
# ## Train
#
# The default task: the Jaco 2 under RMP-VICES visits four via points.

# %%
flags = ["--env", task, "--run_dir", folder, "--eval_episodes", "0", *sizes]
assert train.main(flags) == 0

# %% [markdown]
# ## The learning curve
#
# Every iteration left a row.

# %%
rows = pl.read_parquet(f"{folder}/metrics.parquet")
print(rows.select("steps", "episode/return", "episode/success").tail(5))

# %% [markdown]
# ## Evaluate
#
# Episodes of the mean action, among two spheres that training never saw.

# %%
flags = ["--run", folder, "--deterministic", "--obstacles", "2", "--no-video"]
assert evaluation.main([*flags, "--episodes", episodes]) == 0

# %% [markdown]
# ## Look
#
# One row for each episode. `python -m rmp_mjx.viewer --run FOLDER` shows the policy in
# the browser.

# %%
found = pl.read_parquet(f"{folder}/episodes.parquet")
print(found.select("return", "success", "collision", "clearance").head())

"""Training and evaluation of policies on any environment of the Brax convention.

* `config`, `cli`: the options; `run_folder`: what a run leaves behind.
* `ppo`: the algorithm as pure functions; `train`: the loop around it.
* `seeds`, `devices`, `distributed`: many agents, devices and processes in one program;
  `grid`: many runs.
* `evaluate`, `report`: episodes, their statistics, tables, plots and videos.
"""

"""Training and evaluation of policies on any environment of the Brax convention.

* `learning`: PPO as pure functions, for many seeds and devices in one program.
* `runs`: the loop around it, the run folder, checkpoints, logs and trackers.
* `evaluation`: episodes, their statistics, tables, figures and films.
* `config`: the options; `policy`: a policy as one file.
"""

"""A rival: what a competent user would write instead, measured against ours.

NumPy, controllers compiled by numba, MuJoCo's own batch of C simulations and a small
PPO in PyTorch, on the trajectory task: ``python -m benchmarks.rival --json F``. It
shares our scene, task, formulas and settings. Of our code it uses only the process that
measures.
"""

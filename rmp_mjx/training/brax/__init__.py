"""Training by Brax's own PPO, on the same tasks and with the same results.

* `trainer`: the call of Brax's trainer, and the run folder around it.
* `arguments`: our hyper-parameters under Brax's names.
* `environment`: a batch of our environments as one of Brax's.
* `replicated`: the one JAX function that Brax needs and JAX no longer has.
"""

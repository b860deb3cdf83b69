"""Per-episode values: per-step metrics folded over an episode."""

from collections.abc import Mapping

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rmp_mjx.pytree import Pytree


class EpisodeFold(Pytree):
    """What an unfinished episode has accumulated; batched over environments."""

    reward: Float[Array, "*b"]
    """Sum of rewards."""
    length: Int[Array, "*b"]
    """Policy steps taken."""
    metrics: dict[str, Float[Array, "*b"]]
    """Partial fold of each per-step metric."""


def _initial(reduction: str) -> float:
    return {"max": -jnp.inf, "min": jnp.inf}.get(reduction, 0.0)


def start(reductions: Mapping[str, str], shape: tuple[int, ...]) -> EpisodeFold:
    """An empty fold for a batch of environments."""
    return EpisodeFold(
        reward=jnp.zeros(shape, jnp.float32),
        length=jnp.zeros(shape, jnp.int32),
        metrics={
            name: jnp.full(shape, _initial(reduction), jnp.float32)
            for name, reduction in reductions.items()
        },
    )


def update(
    fold: EpisodeFold,
    reward: Float[Array, "*b"],
    metrics: Mapping[str, Float[Array, "*b"]],
    reductions: Mapping[str, str],
) -> EpisodeFold:
    """Add one step. Every metric named in `reductions` must be present."""

    def add(name: str, reduction: str):
        old, new = fold.metrics[name], metrics[name]
        if reduction == "max":
            return jnp.maximum(old, new)
        if reduction == "min":
            return jnp.minimum(old, new)
        return new if reduction == "last" else old + new

    return EpisodeFold(
        reward=fold.reward + reward,
        length=fold.length + 1,
        metrics={name: add(name, kind) for name, kind in reductions.items()},
    )


def finish(
    fold: EpisodeFold, reductions: Mapping[str, str]
) -> dict[str, Float[Array, "*b"]]:
    """Per-episode values: `return`, `length` and every metric."""
    length = fold.length.astype(jnp.float32)
    values = {
        name: fold.metrics[name] / jnp.maximum(length, 1.0)
        if kind == "mean"
        else fold.metrics[name]
        for name, kind in reductions.items()
    }
    return {"return": fold.reward, "length": length, **values}


def restart(
    fold: EpisodeFold, done: Bool[Array, "*b"], reductions: Mapping[str, str]
) -> EpisodeFold:
    """Empty the folds of the environments that are done."""
    return EpisodeFold(
        reward=jnp.where(done, 0.0, fold.reward),
        length=jnp.where(done, 0, fold.length),
        metrics={
            name: jnp.where(done, _initial(kind), fold.metrics[name])
            for name, kind in reductions.items()
        },
    )

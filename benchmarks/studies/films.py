"""The moving pictures of README and docs/findings.md: `python -m benchmarks.films`.

The first episodes of each task under its policy in `pretrained/`, mean action, two
close spheres. Needs headless rendering.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import jax
import numpy as np
from PIL import Image

import envs
from benchmarks.common import ROOT
from envs.render import render
from rmp_mjx import runtime
from rmp_mjx.training.evaluation.evaluate import recorder
from rmp_mjx.training.policy import load_policy

STRIDE = 3
"""Policy steps from one picture to the next."""

LONGEST = 90
"""Policy steps that are shown at most."""

SIZE = (180, 240)
"""Height and width of an episode's picture [pixels]."""


def film(task: str, episodes: int, seed: int) -> tuple[list[np.ndarray], float]:
    """Episodes side by side; one that has ended keeps its last picture.

    Returns:
        Pictures, and the time from one to the next [s].
    """
    env = envs.load(task, obstacles=2, layout="close", physics="mujoco")
    policy = load_policy(ROOT / f"pretrained/{task}-rmp_vices.safetensors")
    agent = policy.agent(env.observation_size, env.action_size, True)
    _, tape = recorder(env, episodes, episodes)(agent, jax.random.key(seed))
    last = min(int(tape.lengths.max()), LONGEST)
    lanes = [
        render(
            env,
            [tape.state(k, min(t, int(n))) for t in range(0, last + 1, STRIDE)],
            SIZE,
        )
        for k, n in enumerate(tape.lengths)
    ]
    pictures = [np.concatenate(tiles, axis=1) for tiles in zip(*lanes, strict=True)]
    return pictures, STRIDE * env.dt


def main() -> None:
    """Draw and write them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", nargs="+", default=list(envs.names()))
    parser.add_argument("--episodes", type=int, default=2)
    parser.add_argument("--seed", type=int, default=3000)
    parser.add_argument("--folder", type=Path, default=ROOT / "docs/img")
    args = parser.parse_args()
    runtime.configure()
    if runtime.choose_gl() is None:
        parser.error("no headless rendering here (neither EGL nor OSMesa)")
    for task in args.tasks:
        pictures, period = film(task, args.episodes, args.seed)
        first, *others = (Image.fromarray(x) for x in pictures)
        first.save(
            args.folder / f"{task}.webp",
            save_all=True,
            append_images=others,
            duration=round(1e3 * period),
            loop=0,
            quality=25,
            method=6,
        )


if __name__ == "__main__":
    main()

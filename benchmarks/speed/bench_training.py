"""Speed of training: policy steps a second, the learner's share, seeds, the first step.

Run as ``python -m benchmarks.bench_training --json FILE``.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

import envs
from benchmarks.common import ROOT, Row, show, write_json
from envs.cli import make_config
from rmp_mjx import runtime
from rmp_mjx.training.config import TrainConfig
from rmp_mjx.training.learning import seeds

CONTROLLERS = ("vices", "rmp_vices")
WARM_UP = 2  # iterations before timing: compiling, then buffers and page faults
SEEDS, SEED_ENVS = 8, 64


class Times(NamedTuple):
    """Seconds of an iteration's halves, one entry an iteration."""

    gather: np.ndarray
    """Roll-out: policy, controller, physics, resets."""
    learn: np.ndarray
    """Learner."""

    @property
    def whole(self) -> float:
        """Median iteration [s]."""
        return float(np.median(self.gather + self.learn))

    @property
    def spread(self) -> str:
        """The number of iterations and their quartiles relative to the median."""
        low, high = np.percentile(self.gather + self.learn, [25, 75]) / self.whole
        count = len(self.gather)
        return f"{count} iterations, quartiles {low:.2f}-{high:.2f} of median"


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Read the options."""
    parser = argparse.ArgumentParser(description="Training speed.")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--quick", action="store_true", help="a smoke test")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--iterations", type=int, default=40, help="timed iterations")
    parser.add_argument("--num_devices", type=int, help="default: all")
    parser.add_argument("--first_step", type=float, help=argparse.SUPPRESS)
    return parser.parse_args(argv)


def iterations(config: TrainConfig) -> Iterator[tuple[float, float]]:
    """Train on trajectory following; the seconds of each iteration's halves."""
    env = envs.make(config.task)
    programs = seeds.programs(env, config.ppo, config.run.num_devices)
    state = programs.place(programs.init(seeds.keys(config.ppo)))
    while True:
        start = time.perf_counter()
        state, data, _ = jax.block_until_ready(programs.gather(state))
        middle = time.perf_counter()
        state, _ = jax.block_until_ready(programs.learn(state, data))
        yield middle - start, time.perf_counter() - middle


def iterate(config: TrainConfig, count: int) -> Times:
    """Time iterations after the first, slower ones."""
    times = itertools.islice(iterations(config), WARM_UP, WARM_UP + count)
    return Times(*np.array(list(times)).T)


def speed(config: TrainConfig, count: int) -> list[Row]:
    """Rows of the default run with each controller."""
    rows, shares = [], []
    for controller in CONTROLLERS:
        config = config.replace(controller=controller)
        times = iterate(config, count)
        rate = config.ppo.steps_per_iteration / times.whole
        note = f"{config.ppo.num_envs} environments, updates included; {times.spread}"
        rows.append(Row(f"ppo_steps_per_s_{controller}", rate, "1/s", note))
        shares.append(np.median(times.learn / (times.gather + times.learn)))
    note = f"share of an iteration outside of the roll-out; {CONTROLLERS[-1]}"
    return [*rows, Row("learner_share", float(shares[-1]), "", note)]


def cost_of_seeds(config: TrainConfig, count: int) -> list[Row]:
    """Time of several seeds in one program, relative to one seed."""
    whole = []
    for num_seeds in (1, SEEDS):
        config = config.replace(num_envs=SEED_ENVS, num_seeds=num_seeds)
        whole.append(iterate(config, count).whole)
    note = f"{SEED_ENVS} environments a seed; {whole[0]:.3f} s an iteration of one seed"
    return [Row(f"seeds{SEEDS}_cost_ratio", whole[1] / whole[0], "", note)]


def first_steps(seed: int, num_devices: int | None) -> list[Row]:
    """From the start of a process to the end of its first iteration."""
    rows = []
    with tempfile.TemporaryDirectory() as cache:
        for name in ("cold", "warm"):
            command = [sys.executable, "-m", "benchmarks.bench_training"]
            command += ["--seed", str(seed), "--first_step", str(time.time())]
            if num_devices:
                command += ["--num_devices", str(num_devices)]
            done = subprocess.run(
                command,
                cwd=ROOT,
                env={**os.environ, "JAX_COMPILATION_CACHE_DIR": cache},
                capture_output=True,
                text=True,
                check=True,
            )
            seconds = json.loads(done.stdout.splitlines()[-1])
            note = f"default run, {name} compile cache, imports included"
            rows.append(Row(f"first_step_{name}_s", seconds, "s", note))
    return rows


def main(argv: Sequence[str] | None = None) -> None:
    """Measure, print, and write the requested files."""
    args = parse(argv)
    runtime.configure(split_cpu=True, compile_cache=args.first_step is not None)
    config = make_config(seed=args.seed, num_devices=args.num_devices)
    if args.first_step is not None:
        next(iterations(config))
        print(json.dumps(time.time() - args.first_step))
        return
    count = 3 if args.quick else args.iterations
    rows: list[Row] = []
    for part in (
        lambda: speed(config, count),
        lambda: cost_of_seeds(config, count),
        lambda: first_steps(args.seed, args.num_devices),
    ):
        rows += part()
        if args.json:  # after each part: nothing is lost if the next one is stopped
            write_json(args.json, rows, seed=args.seed, quick=args.quick)
    show(rows, "Training on trajectory following")


if __name__ == "__main__":
    main()

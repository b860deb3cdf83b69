"""The cost of dividing environments among devices, on forced CPU devices.

Run as ``python -m benchmarks.weak_scaling --json FILE``. Each row is a process with
several devices and an equal number of environments on each. All devices share this
machine's cores, so the rate cannot grow beyond them. It is compared with one device
that has all of the environments.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.common import ROOT, Row, show, write_json
from benchmarks.speed.bench_training import iterate
from envs.cli import make_config
from rmp_mjx import runtime
from rmp_mjx.training.config import PPOConfig

COUNTS = (1, 2, 4, 8)


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Read the options."""
    parser = argparse.ArgumentParser(description="Cost of sharing environments.")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--iterations", type=int, default=10, help="timed iterations")
    parser.add_argument("--envs_per_device", type=int, default=64)
    parser.add_argument("--worker", type=int, nargs=2, help=argparse.SUPPRESS)
    return parser.parse_args(argv)


def seconds(args: argparse.Namespace, num_envs: int, devices: int) -> list[float]:
    """Median times of roll-out and learner in an iteration, in a new process [s]."""
    command = [sys.executable, "-m", "benchmarks.weak_scaling"]
    command += ["--iterations", str(args.iterations)]
    command += ["--worker", str(num_envs), str(devices)]
    flags = f"--xla_force_host_platform_device_count={devices}"
    done = subprocess.run(
        command,
        cwd=ROOT,
        env={**os.environ, "XLA_FLAGS": flags},
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(done.stdout.splitlines()[-1])


def main(argv: Sequence[str] | None = None) -> None:
    """Measure, print, and write the requested files."""
    args = parse(argv)
    runtime.configure()
    if args.worker:
        num_envs, count = args.worker
        config = make_config(num_envs=num_envs, num_devices=count)
        times = iterate(config, args.iterations)
        print(json.dumps([sorted(half)[len(half) // 2] for half in times]))
        return
    rows: list[Row] = []
    for count in COUNTS:
        num_envs = count * args.envs_per_device
        spread = seconds(args, num_envs, count)
        single = spread if count == 1 else seconds(args, num_envs, 1)
        steps = num_envs * PPOConfig.unroll_length
        note = f"{num_envs} environments; roll-out {spread[0]:.3f} s, learner "
        note += f"{spread[1]:.3f} s; one device {single[0]:.3f} s, {single[1]:.3f} s"
        rate = steps / sum(spread)
        rows.append(Row(f"ppo_steps_per_s_{count}_devices", rate, "1/s", note))
        ratio = sum(single) / sum(spread)
        rows.append(Row(f"efficiency_{count}_devices", ratio, "", note))
        if args.json:
            write_json(args.json, rows, envs_per_device=args.envs_per_device)
    show(rows, "One device and several on the same cores")


if __name__ == "__main__":
    main()

"""Search where arms stand: `python -m envs.place_arms panda ur5e > FILE`.

It prints what `envs/assets/arms.toml` has of the arms that ship. An arm that is not in
that file is placed when a task loads it.
"""

import sys
from collections.abc import Sequence

from rmp_mjx.robot import Robot, RobotError

from .arms import need
from .registry import ENVS
from .stands import search


def main(names: Sequence[str]) -> int:
    """Search and print; returns the exit code."""
    needs = [need(task) for task in ENVS.values()]
    for name in names:
        try:
            stand = search(Robot.load(name, finger=0.0), needs)
        except RobotError as error:
            sys.stderr.write(f"error: {error}\n")
            return 2
        mount, q = (
            [float(x) + 0.0 for x in each] for each in (stand.mount, stand.posture)
        )
        sys.stdout.write(
            f"\n[{name}]  # score {stand.score:.2f}\nmount = {mount}\n"
            f"turn = {stand.turn:.6f}\nq = {q}\n"
        )
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

"""A process that trains the counting toy: `python -m tests.training.runs.member JSON`.

The JSON object has the options that differ from `conftest.SMALL`, and under `process`
coordinator, number of this process and number of all (or nulls).
"""

import json
import sys

from rich.console import Console

from rmp_mjx import runtime
from rmp_mjx.training.runs import distributed
from rmp_mjx.training.runs.loop import train
from tests.training import toys
from tests.training.conftest import small


def main() -> int:
    asked = json.loads(sys.argv[1])
    distributed.join(*asked.pop("process"))
    runtime.configure()
    config = small(**asked)
    folder, lock = distributed.open_run(config)
    with lock:
        return train(toys.Counter(), config, folder, Console(quiet=True)).exit_code


if __name__ == "__main__":
    sys.exit(main())

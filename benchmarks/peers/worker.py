"""A contestant's side: a process that measures on demand. Standard library only.

Every contestant runs ``serve`` in its own virtual environment. The driver sends
requests to its standard input and reads answers from a separate pipe, because libraries
print to the standard output. Each message is one JSON object on a line.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Mapping
from importlib import metadata

ANSWERS = "BENCHMARK_ANSWERS"
"""Environment variable with the file descriptor of the pipe."""

Measure = Callable[[float], float]
"""Maps a time budget [s] to the figure."""


def serve(makers: Mapping[str, Callable[[], Measure]], packages: tuple[str, ...]):
    """Answer the driver until it closes the pipe.

    Args:
        makers: Measures by name; each is prepared (compiled, warm) when called.
        packages: Packages whose versions are reported.
    """
    answers = os.fdopen(int(os.environ[ANSWERS]), "w")

    def answer(**content: object) -> None:
        print(json.dumps(content), file=answers, flush=True)

    answer(versions={name: metadata.version(name) for name in packages})
    ready: dict[str, Measure] = {}
    for line in sys.stdin:
        request = json.loads(line)
        name = request["name"]
        if name not in ready:
            ready[name] = makers[name]()
        answer(value=ready[name](request["seconds"]))


def rate(call: Callable[[], object], units: int) -> Measure:
    """Units per second of a call that returns when its result is ready.

    Args:
        call: What to repeat; called three times first.
        units: Units of work in a call.
    """
    for _ in range(3):
        call()

    def measure(seconds: float) -> float:
        calls, start = 0, time.perf_counter()
        while (spent := time.perf_counter() - start) < seconds or not calls:
            call()
            calls += 1
        return calls * units / spent

    return measure


def latency(call: Callable[[], object]) -> Measure:
    """Median time of a call [us]; called a hundred times first."""
    for _ in range(100):
        call()

    def measure(seconds: float) -> float:
        times, start = [], time.perf_counter()
        while time.perf_counter() - start < seconds:
            before = time.perf_counter()
            call()
            times.append(time.perf_counter() - before)
        return 1e6 * sorted(times)[len(times) // 2]

    return measure

"""A contestant for the tests: answers at once, or fails."""

import sys

from benchmarks.peers.worker import serve


def broken():
    raise RuntimeError("no such measure")


if __name__ == "__main__":
    print("libraries print to the standard output")  # noqa: T201
    factor = float(sys.argv[1])
    serve({"echo": lambda: lambda s: factor * s, "broken": broken}, ("numpy",))

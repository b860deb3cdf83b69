"""Benchmarks and studies.

`python -m benchmarks.NAME` finds NAME in the rooms `speed` and `studies` as well.
"""

from pathlib import Path

__path__ += [str(Path(__file__).parent / room) for room in ("speed", "studies")]

"""Ours against its peers, in one run on one machine: ``python -m benchmarks.peers``.

Each contestant is a process that measures on command, in its own virtual environment
(`venv`), so that they can take turns (`worker`). Each has one file, whose docstring
says what is measured and how the comparison is kept fair.
"""

"""Ours against its peers, in one run on one machine: ``python -m benchmarks.peers``.

Each contestant is a process that measures when it is told to, in a virtual environment
of its own (`venv`), so that they can take turns (`worker`). One file per contestant:
its module docstring says what is measured and how it is kept fair.
"""

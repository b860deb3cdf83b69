"""Benchmarks: run each as ``python -m benchmarks.bench_NAME --json FILE``."""

"""Fixtures for the RMP tests: float64 on request."""

import jax
import pytest


@pytest.fixture
def x64():
    """Run the test in float64 (not globally: other tests stay in float32)."""
    with jax.enable_x64(True):
        yield

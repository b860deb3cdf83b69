"""Histograms of contact forces and clearances."""

import numpy as np
import pytest

from rmp_mjx.training.evaluation import histograms


@pytest.mark.parametrize("touched", [True, False])
def test_histograms_are_pictures_with_or_without_contact(tmp_path, touched):
    peaks = {"one": np.array([0.0, 30.0 * touched]), "two": np.zeros(3)}
    histograms.plot_forces(peaks, tmp_path / "f.png", "title")
    gaps = {"one": np.array([0.1, -0.01])}
    histograms.plot_clearances(gaps, tmp_path / "c.png", "title")
    for name in ("f.png", "c.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")

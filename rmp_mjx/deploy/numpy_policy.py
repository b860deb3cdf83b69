"""The policy alone in NumPy, for people without JAX."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from rmp_mjx.deploy.artefact import DeployError, read

WEIGHTS = "policy.npz"
"""The part that holds the arrays."""


class NumpyPolicy:
    """Observations to actions in [-1, 1], in NumPy."""

    def __init__(self, arrays: Mapping[str, np.ndarray]):
        """Take the arrays of a policy.

        Args:
            arrays: `mean` and `std` of the observations, (n,); `limit` of what is
                normalised, (); `W0`, `b0`, `W1`, ... of the layers.
        """
        self.arrays = dict(arrays)
        self.layers = sum(name.startswith("W") for name in arrays)

    @staticmethod
    def load(path: str | Path) -> NumpyPolicy:
        """The policy of an exported file.

        Raises:
            DeployError: The file is damaged, of another version or not ours.
        """
        return NumpyPolicy(weights(Path(path), read(Path(path))[1]))

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Actions for observations, (..., n) to (..., m)."""
        a = self.arrays
        x = (np.asarray(observation, np.float32) - a["mean"]) / a["std"]
        x = np.clip(x, -a["limit"], a["limit"])
        for k in range(self.layers):
            x = x @ a[f"W{k}"] + a[f"b{k}"]
            if k < self.layers - 1:
                x = np.tanh(x)
        return np.clip(x, -1.0, 1.0)


def weights(path: Path, parts: Mapping[str, bytes]) -> dict[str, np.ndarray]:
    """The policy's arrays among the parts of a file."""
    try:
        with np.load(io.BytesIO(parts[WEIGHTS]), allow_pickle=False) as found:
            return {name: found[name] for name in found.files}
    except (KeyError, ValueError, OSError) as error:
        raise DeployError(f"{path} has no policy that can be read: {error}") from error

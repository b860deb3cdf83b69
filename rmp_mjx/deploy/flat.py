"""Trees of arrays as one flat array: one state in, one call, one array out.

A call of a compiled function costs some microseconds for each array that it takes. At
1 kHz that counts, so a loop writes its numbers into one array.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


class Layout:
    """Where the arrays of a tree stand in a flat array."""

    def __init__(self, example: Any):
        """Lay out the arrays of a tree.

        Args:
            example: A tree of arrays or of their shapes.
        """
        leaves, self._structure = jax.tree.flatten(example)
        self._leaves = [(tuple(x.shape), np.dtype(x.dtype)) for x in leaves]
        ends = np.cumsum([0] + [int(np.prod(shape)) for shape, _ in self._leaves])
        self._spans = [slice(a, b) for a, b in itertools.pairwise(ends)]
        self.size = int(ends[-1])

    def write(self, tree: Any, out: np.ndarray) -> None:
        """Copy the arrays of a tree into a flat array, (size,).

        Raises:
            ValueError: The tree has other parts or shapes.
        """
        leaves, structure = jax.tree.flatten(tree)
        if structure != self._structure:
            raise ValueError(f"expected {self._structure}, got {structure}")
        for span, (shape, _), leaf in zip(
            self._spans, self._leaves, leaves, strict=True
        ):
            value = np.asarray(leaf)
            if value.shape != shape:
                raise ValueError(f"expected shape {shape}, got {value.shape}")
            out[span] = value.ravel()

    def tree(self, flat: Any) -> Any:
        """The tree in a flat array: views of a NumPy array, parts of a JAX one."""
        leaves = [
            flat[span].reshape(shape).astype(dtype, copy=False)
            if isinstance(flat, np.ndarray)
            else flat[span].reshape(shape).astype(dtype)
            for span, (shape, dtype) in zip(self._spans, self._leaves, strict=True)
        ]
        return jax.tree.unflatten(self._structure, leaves)


class Flat:
    """A function of one state that is called with one array and returns one."""

    def __init__(self, function: Callable[..., Any], examples: tuple[Any, ...]):
        """Compile it.

        Args:
            function: Takes and returns trees of arrays.
            examples: Its arguments, or their shapes.
        """
        self.inputs = [Layout(example) for example in examples]
        ends = np.cumsum([0] + [layout.size for layout in self.inputs])
        self._spans = [slice(a, b) for a, b in itertools.pairwise(ends)]
        self._output = Layout(jax.eval_shape(function, *examples))

        self._compiled = [0]

        def flat(x):
            self._compiled[0] += 1  # when it is traced
            parts = [
                layout.tree(x[span])
                for layout, span in zip(self.inputs, self._spans, strict=True)
            ]
            leaves = jax.tree.leaves(function(*parts))
            return jnp.concatenate([jnp.ravel(y).astype(jnp.float32) for y in leaves])

        self._buffer = np.zeros(int(ends[-1]), np.float32)
        self._call = jax.jit(flat)
        self._call(self._buffer).block_until_ready()

    @property
    def compilations(self) -> int:
        """How often it was compiled: once, before the first call."""
        return self._compiled[0]

    def twin(self) -> Flat:
        """The same compiled function with arguments of its own, zero at first."""
        other = copy.copy(self)
        other._buffer = np.zeros_like(self._buffer)
        return other

    def put(self, place: int, tree: Any) -> None:
        """Set an argument, which stays until it is set again.

        Raises:
            ValueError: It has other parts or shapes than the example.
        """
        self.inputs[place].write(tree, self._buffer[self._spans[place]])

    def __call__(self) -> Any:
        """The function's result for the arguments that were put, of NumPy arrays."""
        return self._output.tree(np.asarray(self._call(self._buffer)))

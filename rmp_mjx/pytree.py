"""The base of the project's pytrees: immutable, comparable, hashable, printable."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any, Self, dataclass_transform

import jax
import numpy as np
from flax import struct
from jax.core import Tracer


@dataclass_transform(
    field_specifiers=(struct.field,), frozen_default=True, eq_default=False
)
class Pytree:
    """A frozen dataclass whose fields are pytree nodes.

    Fields are array leaves or further pytrees; `flax.struct.field(pytree_node=False)`
    marks a static one. Subclasses need no decorator. Two objects are equal if they have
    the same structure and the same leaves, so that `jax.jit`, `jax.vmap` and `jax.grad`
    take a callable pytree like any function, and compile it once for equal objects.

    JAX puts whatever it likes into the leaves of a tree (batches, tracers, None). So a
    tree is put together again without `__init__`, which checks what a user passes.
    """

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        this: Any = dataclasses.dataclass(frozen=True, eq=False, repr=False)(cls)
        names: dict[bool, list[str]] = {True: [], False: []}
        for field in dataclasses.fields(this):
            names[field.metadata.get("pytree_node", True)].append(field.name)
        data, static = names[True], names[False]
        keys = [jax.tree_util.GetAttrKey(name) for name in data]

        def flatten(tree: Any) -> tuple[tuple, tuple]:
            values = tree.__dict__
            return tuple([values[k] for k in data]), tuple([values[k] for k in static])

        def flatten_with_keys(tree: Any) -> tuple[tuple, tuple]:
            children, rest = flatten(tree)
            return tuple(zip(keys, children, strict=True)), rest

        def unflatten(rest: Iterable, children: Iterable) -> Any:
            tree = object.__new__(cls)
            tree.__dict__.update(zip(data, children, strict=True))
            tree.__dict__.update(zip(static, rest, strict=True))
            return tree

        jax.tree_util.register_pytree_with_keys(
            cls, flatten_with_keys, unflatten, flatten
        )

    def replace(self, **changes: Any) -> Self:
        """A copy with other values in some fields."""
        this: Any = self
        return dataclasses.replace(this, **changes)

    def __eq__(self, other: object) -> bool:
        if self is other:
            return True
        if type(self) is not type(other):
            return NotImplemented
        mine, structure = jax.tree.flatten(self)
        others, other_structure = jax.tree.flatten(other)
        return structure == other_structure and all(map(_same, mine, others))

    def __hash__(self) -> int:
        """Hash of the structure: equal objects have the same one."""
        return hash((type(self), jax.tree.structure(self)))

    def __repr__(self) -> str:
        """Fields by name; an array of more than four entries by dtype and shape."""
        this: Any = self
        fields = [
            f"{f.name}={_show(getattr(self, f.name))}" for f in dataclasses.fields(this)
        ]
        line = f"{type(self).__name__}({', '.join(fields)})"
        if len(line) <= 88:
            return line
        inner = ",\n".join("  " + field.replace("\n", "\n  ") for field in fields)
        return f"{type(self).__name__}(\n{inner},\n)"


def _same(a: Any, b: Any) -> bool:
    """Whether two leaves are the same; traced values are the same only as objects."""
    if a is b:
        return True
    if isinstance(a, Tracer) or isinstance(b, Tracer):
        return False
    a, b = np.asarray(a), np.asarray(b)
    return a.dtype == b.dtype and a.shape == b.shape and bool(np.array_equal(a, b))


def _show(value: Any) -> str:
    """A field's value on a line, or a nested pytree on several."""
    if isinstance(value, str) and len(value) > 60:
        return f"<{len(value)} characters>"
    if isinstance(value, (np.ndarray, jax.Array)):
        if isinstance(value, Tracer) or value.size > 4:
            return f"{value.dtype}{list(value.shape)}"
        return str(np.asarray(value).tolist())
    return repr(value)

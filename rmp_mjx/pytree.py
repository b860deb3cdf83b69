"""The base of the project's pytrees: immutable, comparable, hashable, printable."""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Self, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.core import Tracer

# A JAX array, a tracer, a NumPy array or a NumPy number. Constants stay float64 NumPy
# arrays until they are traced, so that they serve any precision.
if TYPE_CHECKING:
    from typing import Any as Constant
else:
    Constant = Array | np.ndarray | np.generic

_WIDTH = 88


@dataclass_transform(
    field_specifiers=(struct.field,), frozen_default=True, eq_default=False
)
class Pytree:
    """A frozen dataclass whose fields are pytree nodes.

    Fields are arrays, numbers or further pytrees. `struct.field(pytree_node=False)`
    marks a static field, whose value must be hashable. Subclasses need no decorator.

    Two objects are equal if they have the same class, structure and static fields, and
    leaves of the same type, shape and bits. So `jax.jit`, `jax.vmap` and `jax.lax.scan`
    take a callable pytree like any function, and compile it once for equal objects.

    `repr` leaves out the fields that have their default value, and shows an array of
    more than four entries by dtype and shape.

    JAX puts what it likes into the leaves of a tree: batches, axes, placeholders. So it
    rebuilds a tree without `__init__`, and the fields' annotations say what a user
    passes.
    """

    _static: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        this: Any = dataclasses.dataclass(frozen=True, eq=False, repr=False)(cls)
        fields = dataclasses.fields(this)
        data = [f.name for f in fields if f.metadata.get("pytree_node", True)]
        static = [f.name for f in fields if f.name not in data]
        keys = [jax.tree_util.GetAttrKey(name) for name in data]
        children, constants = _values(data), _values(static)
        this._static = tuple(static)

        def flatten(tree: Any) -> tuple[tuple, tuple]:
            return children(tree), constants(tree)

        def flatten_with_keys(tree: Any) -> tuple[tuple, tuple]:
            return tuple(zip(keys, children(tree), strict=True)), constants(tree)

        def unflatten(constants: tuple, children: Iterable[Any]) -> Any:
            tree = object.__new__(cls)
            tree.__dict__.update(zip(data, children, strict=True))
            tree.__dict__.update(zip(static, constants, strict=True))
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
        if not isinstance(other, Pytree) or type(self) is not type(other):
            return NotImplemented
        if hash(self) != hash(other):
            return False
        mine, structure = jax.tree.flatten(self)
        others, other_structure = jax.tree.flatten(other)
        return structure == other_structure and all(map(_same, mine, others))

    def __hash__(self) -> int:
        """Hash of the structure and the static fields: equal objects share it.

        Raises:
            TypeError: A static field is not hashable.
        """
        constants = tuple(vars(self)[name] for name in self._static)
        inner = jax.tree.leaves(vars(self), is_leaf=lambda x: isinstance(x, Pytree))
        inner = tuple(hash(x) for x in inner if isinstance(x, Pytree))
        try:
            return hash((type(self), jax.tree.structure(self), inner, constants))
        except TypeError as error:
            raise TypeError(
                f"a static field of {type(self).__name__} has an unhashable value "
                f"({error}): make it a tuple, or a field that is a pytree node"
            ) from error

    def __repr__(self) -> str:
        this: Any = self
        fields = [
            f"{field.name}={_show(getattr(self, field.name))}"
            for field in dataclasses.fields(this)
            if not _is_default(field, getattr(self, field.name))
        ]
        line = f"{type(self).__name__}({', '.join(fields)})"
        if len(line) <= _WIDTH and "\n" not in line:
            return line
        inner = ",\n".join("  " + field.replace("\n", "\n  ") for field in fields)
        return f"{type(self).__name__}(\n{inner},\n)"


def _values(names: Sequence[str]) -> Callable[[Any], tuple]:
    """A fast function of an object that gives these attributes as a tuple."""
    if len(names) > 1:
        return operator.attrgetter(*names)
    if names:
        name = names[0]
        return lambda tree: (getattr(tree, name),)
    return lambda tree: ()


def _same(a: Any, b: Any) -> bool:
    """Whether two leaves are the same; traced values are the same only as objects."""
    if a is b:
        return True
    if isinstance(a, Tracer) or isinstance(b, Tracer):
        return False
    kind = _kind(a)
    if kind != _kind(b):
        return False
    if kind is None:
        return bool(a == b)
    if jnp.issubdtype(kind[0], jax.dtypes.prng_key):
        a, b = jax.random.key_data(a), jax.random.key_data(b)
    a, b = np.asarray(a), np.asarray(b)
    return a.shape == b.shape and a.tobytes() == b.tobytes()


def _kind(x: Any) -> tuple[Any, bool] | None:
    """Dtype of a leaf, and whether it adapts to that of others; None for no number."""
    if isinstance(x, (jax.Array, np.ndarray, np.generic)):
        return x.dtype, bool(getattr(x, "weak_type", False))
    if isinstance(x, (bool, int, float, complex)):
        return np.dtype(type(x)), True
    return None


def _is_default(field: dataclasses.Field, value: Any) -> bool:
    """Whether a field has the value that it has if none is given."""
    if field.default_factory is not dataclasses.MISSING:
        default = field.default_factory()
    elif field.default is not dataclasses.MISSING:
        default = field.default
    else:
        return False
    if isinstance(default, Pytree):
        return default == value
    return _same(default, value)


class _Text(str):
    """A string that is its own `repr`."""

    __slots__ = ()

    __repr__ = str.__str__


def _show(value: Any) -> str:
    """A field's value on a line, or a nested pytree on several."""

    def text(leaf: Any) -> _Text:
        if isinstance(leaf, str) and len(leaf) > 60:
            return _Text(f"<{len(leaf)} characters>")
        if isinstance(leaf, Tracer):
            return _Text(f"{leaf.dtype}{list(leaf.shape)}")
        if isinstance(leaf, (np.ndarray, np.generic, jax.Array)):
            if not 0 < leaf.size <= 4 or jnp.issubdtype(
                leaf.dtype, jax.dtypes.prng_key
            ):
                return _Text(f"{leaf.dtype}{list(leaf.shape)}")
            return _Text(np.array2string(np.asarray(leaf), separator=", "))
        if callable(leaf) and not isinstance(leaf, Pytree):
            return _Text(getattr(leaf, "__qualname__", repr(leaf)))
        return _Text(repr(leaf))

    return repr(jax.tree.map(text, value, is_leaf=lambda x: isinstance(x, Pytree)))

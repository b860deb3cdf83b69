"""The base of all pytrees: equality, hash, print, copies and JAX's own rebuilding."""

import copy
import dataclasses
import pickle
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from rmp_mjx.pytree import Pytree


class Gain(Pytree):
    """A number, with a static name."""

    value: Any = 1.0
    name: Any = struct.field(pytree_node=False, default="gain")

    def __call__(self, x):
        return self.value * x


class Pair(Pytree):
    """Nested pytrees, an array and anything else."""

    gain: Any
    array: Any
    more: Any = None


class Strict(Pytree):
    """Fills in a default, and checks what a user passes."""

    value: Any = None

    def __post_init__(self):
        if self.value is None:
            object.__setattr__(self, "value", 2.0)
        if not isinstance(self.value, float):
            raise TypeError("a float, please")


def pair(**changes):
    return Pair(Gain(2.0), np.arange(6.0), {"a": (1, None)}).replace(**changes)


def test_a_subclass_is_a_frozen_dataclass():
    assert dataclasses.is_dataclass(Pair)
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(pair(), "gain", Gain())  # noqa: B010
    assert pair().replace(gain=Gain(3.0)).gain.value == 3.0


EQUAL = {
    "the same values": (pair(), pair()),
    "a deep copy": (pair(), copy.deepcopy(pair())),
    "pickled": (Gain(3.0), pickle.loads(pickle.dumps(Gain(3.0)))),
    "NumPy and JAX arrays of one dtype": (
        pair(array=np.ones(3, np.float32)),
        pair(array=jnp.ones(3, jnp.float32)),
    ),
    "not a number": (Gain(float("nan")), Gain(float("nan"))),
    "keys": (Gain(jax.random.key(1)), Gain(jax.random.key(1))),
    "shapes": (Gain(jax.ShapeDtypeStruct((2,), float)),) * 2,
}


@pytest.mark.parametrize(("a", "b"), EQUAL.values(), ids=EQUAL)
def test_equal_objects_have_one_hash(a, b):
    assert a == b and hash(a) == hash(b)
    assert len({a, b}) == 1


DIFFERENT = {
    "a number": pair(gain=Gain(2.5)),
    "an entry": pair(array=np.array([0.0, 1.0, 2.0, 3.0, 4.0, 5.1])),
    "a shape": pair(array=np.arange(6.0).reshape(2, 3)),
    "a dtype": pair(array=np.arange(6.0, dtype=np.float32)),
    "a static field": pair(gain=Gain(2.0, "other")),
    "a structure": pair(more={"a": (1, 2)}),
    "a number that adapts its dtype": pair(gain=Gain(np.float64(2.0))),
    "a class": Gain(2.0),
    "no pytree": 2.0,
}


@pytest.mark.parametrize("other", DIFFERENT.values(), ids=DIFFERENT)
def test_objects_differ_by_anything_that_a_compiled_program_would_see(other):
    assert pair() != other
    assert other != pair()


def test_keys_differ_by_their_seed():
    assert Gain(jax.random.key(1)) != Gain(jax.random.key(2))


def test_a_static_value_that_cannot_be_hashed_is_named():
    bad = Gain(1.0, np.zeros(2))
    with pytest.raises(TypeError, match=r"a static field of Gain .* make it a tuple"):
        hash(bad)
    with pytest.raises(TypeError, match="a static field of Gain"):
        jax.jit(bad)(1.0)


def test_transformations_take_the_object_and_share_one_trace():
    traces = []

    class Counted(Gain):
        def __call__(self, x):
            traces.append(1)
            return super().__call__(x)

    x = jnp.arange(3.0)
    two, again, three = Counted(2.0), Counted(2.0), Counted(3.0)
    np.testing.assert_array_equal(jax.jit(two)(x), 2.0 * x)
    np.testing.assert_array_equal(jax.jit(again)(x), 2.0 * x)
    assert len(traces) == 1
    np.testing.assert_array_equal(jax.jit(three)(x), 3.0 * x)
    assert len(traces) == 2
    np.testing.assert_array_equal(jax.vmap(Gain(2.0))(x), 2.0 * x)
    assert jax.grad(Gain(2.0))(1.0) == 2.0
    assert jax.checkpoint(Gain(2.0))(1.0) == 2.0


def test_traced_values_are_the_same_only_as_objects():
    @jax.jit
    def f(x, y):
        a, b = Gain(x), Gain(y)
        assert a == Gain(x) and hash(a) == hash(b)
        assert a != b and a != Gain(1.0)
        return jax.jit(a)(2.0) + jax.jit(b)(2.0)

    assert f(1.0, 3.0) == 8.0


def test_jax_rebuilds_an_object_from_anything_without_its_checks():
    with pytest.raises(TypeError, match="a float, please"):
        Strict("text")
    assert jax.tree.map(lambda _: "text", Strict(1.0)).value == "text"
    assert jax.tree.map(lambda _: None, Strict(1.0)).value is None
    assert Strict().value == 2.0
    axes = jax.tree.map(lambda _: None, Strict(1.0))
    doubled = jax.vmap(lambda s, x: s.value * x, in_axes=(axes, 0))
    np.testing.assert_array_equal(doubled(Strict(2.0), jnp.ones(2)), [2.0, 2.0])


def test_paths_have_the_names_of_the_fields():
    paths = [
        jax.tree_util.keystr(path)
        for path, _ in jax.tree_util.tree_leaves_with_path(pair())
    ]
    assert paths == [".gain.value", ".array", ".more['a'][0]"]


def test_printing_leaves_out_defaults_and_shortens_what_is_long():
    assert repr(Gain()) == "Gain()"
    assert repr(Gain(np.float32(0.1))) == "Gain(value=0.1)"
    assert repr(Gain(jnp.array([0.1, 2.0]))) == "Gain(value=[0.1, 2. ])"
    assert repr(Gain(2.0, "x" * 99)) == "Gain(value=2.0, name=<99 characters>)"
    assert repr(Gain(jax.random.key(0))) == "Gain(value=key<fry>[])"
    assert repr(Gain(jnp.zeros((0, 3)))) == "Gain(value=float32[0, 3])"
    assert repr(Gain(jnp.sin)) == "Gain(value=sin)"
    assert repr(Pair(1.0, 2.0, np.arange(6.0))).endswith("more=float64[6])")
    assert repr(pair()) == (
        "Pair(gain=Gain(value=2.0), array=float64[6], more={'a': (1, None)})"
    )
    wide = Pair(pair(), np.arange(6.0), pair())
    assert repr(wide).splitlines() == [
        "Pair(",
        f"  gain={pair()!r},",
        "  array=float64[6],",
        f"  more={pair()!r},",
        ")",
    ]
    assert jax.eval_shape(lambda g: Text(repr(g)) and g.value, Gain(5.0)).shape == ()


def Text(shown):
    """What a traced field looks like."""
    assert shown == "Gain(value=float32[])"
    return True

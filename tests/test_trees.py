"""Trees with typed random keys, rows picked by a mask, leaves by name."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rmp_mjx.files import replacing, write_text
from rmp_mjx.trees import cast_like, is_key, like, named_leaves, numbers, select


@pytest.fixture
def tree():
    return {
        "x": jnp.arange(6.0).reshape(3, 2),
        "key": jax.random.split(jax.random.key(0), 3),
    }


def test_keys_are_told_from_numbers_by_array_and_by_shape(tree):
    assert is_key(tree["key"]) and not is_key(tree["x"])
    shapes = jax.eval_shape(lambda: tree)
    assert is_key(shapes["key"]) and not is_key(shapes["x"])


def test_numbers_and_back(tree):
    plain = numbers(tree)
    assert plain["key"].dtype == np.uint32 and plain["key"].shape == (3, 2)
    again = jax.tree.map(like, plain, tree)
    assert again["key"].dtype == tree["key"].dtype
    for one, two in zip(*map(jax.tree.leaves, (numbers(again), plain)), strict=True):
        np.testing.assert_array_equal(one, two)


def test_leaves_are_named_by_their_paths():
    assert list(named_leaves({"b": [1, 2], "a": 3})) == [
        "['a']",
        "['b'][0]",
        "['b'][1]",
    ]


def test_rows_come_from_where_the_mask_says(tree):
    mask = jnp.array([True, False, True])
    other = {"x": -tree["x"] - 1, "key": jax.random.split(jax.random.key(1), 3)}
    found = select(mask, other, tree)
    for name in tree:
        new, old, got = (numbers(t[name]) for t in (other, tree, found))
        np.testing.assert_array_equal(got, np.where(mask[:, None], new, old))


def test_cast_leaves_are_strongly_typed_and_keys_stay(tree):
    weak = {**tree, "x": jax.jit(lambda: 1.0)()}
    assert weak["x"].weak_type
    found = cast_like(weak, {**tree, "x": jnp.int32(0)})
    assert found["x"].dtype == jnp.int32 and not found["x"].weak_type
    assert found["key"] is tree["key"]


def test_text_replaces_text(tmp_path):
    path = tmp_path / "a.json"
    for text in ("old", "new"):
        write_text(path, text)
        assert path.read_text() == text
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_the_old_file_stays_until_the_new_one_is_complete(tmp_path):
    path = tmp_path / "a"
    path.write_text("old")
    with replacing(path) as beside:
        beside.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, error):
    path = tmp_path / "a"
    path.write_text("old")
    with pytest.raises(error), replacing(path) as beside:
        beside.write_text("ne")
        raise error
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a"]

"""Checkpoints: what comes back, and what is refused."""

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rmp_mjx.training.checkpoint import (
    Checkpointer,
    CheckpointError,
    CheckpointMismatch,
)


def state(offset=0.0):
    return {
        "weights": jnp.linspace(0.0, 1.0, 1000) + offset,
        "count": jnp.int32(3),
        "key": jax.random.key(5),
        "nothing": jnp.zeros((4, 0)),
        "infinite": jnp.array([-jnp.inf, jnp.nan]),
    }


@pytest.fixture
def folder(tmp_path):
    store = Checkpointer(tmp_path / "checkpoints")
    store.save(1, state(1.0))
    store.save(2, state(2.0))
    store.close()
    return tmp_path / "checkpoints"


def restore(folder, template=None, notes=None):
    store = Checkpointer(folder, read_only=True)
    notes = [] if notes is None else notes
    try:
        return store.restore(template or state(), notes.append)
    finally:
        store.close()


def test_every_kind_of_leaf_comes_back(folder):
    step, found = restore(folder)
    wanted = state(2.0)
    assert step == 2
    assert jax.tree.structure(found) == jax.tree.structure(wanted)
    np.testing.assert_array_equal(
        jax.random.key_data(found.pop("key")), jax.random.key_data(wanted.pop("key"))
    )
    for one, two in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        assert one.dtype == two.dtype
        np.testing.assert_array_equal(one, two)


def test_a_part_of_the_state_can_be_read_alone(folder):
    template = {**dict.fromkeys(state()), "weights": state()["weights"]}
    _, found = restore(folder, template)
    assert found["key"] is None
    np.testing.assert_array_equal(found["weights"], state(2.0)["weights"])


def test_only_the_newest_are_kept(tmp_path):
    store = Checkpointer(tmp_path, keep=2)
    for step in (1, 2, 3):
        store.save(step, {"x": jnp.ones(3)})
    store.close()
    assert sorted(p.name for p in tmp_path.iterdir() if p.name.isdigit()) == ["2", "3"]


def data_files(folder):
    return sorted(p for p in folder.rglob("*") if p.is_file() and p.stat().st_size)


def test_a_flipped_byte_is_never_loaded(folder, tmp_path):
    reference = state(2.0)["weights"]
    older = state(1.0)["weights"]
    rng = np.random.default_rng(0)
    fell_back = 0
    for trial, path in enumerate(data_files(folder / "2")):
        copy = tmp_path / f"copy{trial}"
        shutil.copytree(folder, copy)
        victim = copy / path.relative_to(folder)
        content = bytearray(victim.read_bytes())
        content[rng.integers(len(content))] ^= 1 << int(rng.integers(8))
        victim.write_bytes(content)
        notes = []
        step, found = restore(copy, notes=notes)
        # a flip may hit a byte that no reader looks at: then the data is intact
        assert step == 2 - len(notes)
        np.testing.assert_array_equal(
            found["weights"], reference if step == 2 else older
        )
        fell_back += step == 1
    assert fell_back > 0


def test_a_truncated_file_falls_back_to_the_previous_checkpoint(folder):
    largest = max(data_files(folder / "2"), key=lambda p: p.stat().st_size)
    largest.write_bytes(largest.read_bytes()[: largest.stat().st_size // 2])
    notes = []
    step, _ = restore(folder, notes=notes)
    assert step == 1
    assert "checkpoint 2 is damaged" in notes[0]


def test_a_damaged_checkpoint_makes_room_for_its_successor(folder):
    largest = max(data_files(folder / "2"), key=lambda p: p.stat().st_size)
    largest.write_bytes(b"")
    store = Checkpointer(folder)
    step, found = store.restore(state(), lambda note: None)
    assert step == 1
    store.save(2, found)
    store.close()
    assert restore(folder)[0] == 2


@pytest.mark.parametrize(
    ("name", "leaf"),
    [
        ("weights", jnp.zeros(999)),
        ("count", jnp.float32(0.0)),
        ("other", jnp.zeros(2)),
    ],
)
def test_another_shape_type_or_name_is_refused(folder, name, leaf):
    with pytest.raises(CheckpointMismatch, match=name):
        restore(folder, {**state(), name: leaf})


def test_a_folder_without_checkpoints_is_an_error(tmp_path):
    with pytest.raises(CheckpointError, match="no checkpoints"):
        Checkpointer(tmp_path / "nowhere", read_only=True)
    (tmp_path / "empty").mkdir()
    with pytest.raises(CheckpointError, match="no usable checkpoint"):
        restore(tmp_path / "empty")

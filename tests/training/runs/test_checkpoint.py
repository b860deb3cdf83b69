"""Checkpoints: what comes back, and what is refused."""

import shutil
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rmp_mjx.training.runs.checkpoint import (
    BEST,
    MERITS,
    NEWEST,
    Checkpointer,
    CheckpointError,
    CheckpointMismatch,
)
from tests.training.conftest import bits


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


def kept(folder):
    return sorted(int(p.name) for p in folder.iterdir() if p.name.isdigit())


def test_the_newest_the_best_and_those_at_multiples_are_kept(tmp_path):
    merits = {2: (0.5, 1.0), 3: (0.5, 2.0), 5: (0.1, 9.0)}  # 1, 4, 6, 7: not known
    store = Checkpointer(tmp_path, keep=2, keep_every=4)
    for step in range(1, 8):
        known = dict(zip(MERITS, merits.get(step, ()), strict=False))
        merit = {str(name): value for name, value in known.items()} or None
        store.save(step, {"x": jnp.full(3, step)}, merit)
    template = {"x": jnp.zeros(3, int)}
    assert kept(tmp_path) == [3, 4, 6, 7]
    for which, step in ((NEWEST, 7), (BEST, 3), ("4", 4)):
        found, tree = store.restore(template, pytest.fail, which)
        assert (found, int(tree["x"][0])) == (step, step)
    with pytest.raises(CheckpointError, match="there are: 3, 4, 6, 7"):
        store.restore(template, pytest.fail, "5")
    store.close()


def test_without_a_merit_the_newest_alone_are_kept(tmp_path):
    store = Checkpointer(tmp_path, keep=2)
    for step in (1, 2, 3):
        store.save(step, {"x": jnp.ones(3)})
    assert kept(tmp_path) == [2, 3]
    with pytest.raises(CheckpointError, match="no checkpoint 'best'"):
        store.restore({"x": jnp.ones(3)}, pytest.fail, BEST)
    store.close()


def test_what_is_no_checkpoint_is_passed_over(folder):
    (folder / "notes.txt").write_text("mine")
    (folder / "thoughts").mkdir()
    (folder / "3").mkdir()
    notes = []
    assert restore(folder, notes=notes)[0] == 2
    assert "checkpoint 3 is damaged" in notes[0]
    store = Checkpointer(folder)
    store.restore(state(), notes.append)
    store.save(3, state())
    store.close()
    assert (folder / "notes.txt").read_text() == "mine"
    assert (folder / "thoughts").is_dir()


@pytest.mark.parametrize("part", ["manifest", "state", "_CHECKPOINT_METADATA"])
def test_a_part_that_was_deleted_is_noticed(folder, part):
    victim = folder / "2" / part
    shutil.rmtree(victim) if victim.is_dir() else victim.unlink()
    notes = []
    step, found = restore(folder, notes=notes)
    assert step == 2 - len(notes)
    np.testing.assert_array_equal(found["weights"], state(float(step))["weights"])
    if part != "_CHECKPOINT_METADATA":  # times alone are in there
        assert part in notes[0]


def data_files(folder):
    return sorted(p for p in folder.rglob("*") if p.is_file() and p.stat().st_size)


def flip(folder, path, rng):
    """Flip one random bit of a file of checkpoint 2; whether 2 is still taken.

    A flip may hit a byte that no reader looks at: then the data must be intact.
    """
    content = path.read_bytes()
    spoilt = bytearray(content)
    spoilt[rng.integers(len(spoilt))] ^= 1 << int(rng.integers(8))
    path.write_bytes(spoilt)
    notes = []
    step, found = restore(folder, notes=notes)
    path.write_bytes(content)
    assert step == 2 - len(notes)
    for name, leaf in state(float(step)).items():
        assert bits(found[name]) == bits(leaf)
    return step == 2


def test_a_flipped_bit_is_never_loaded(folder):
    rng = np.random.default_rng(0)
    taken = [flip(folder, path, rng) for path in data_files(folder / "2")]
    assert not all(taken)


@pytest.mark.slow
def test_three_hundred_flipped_bits_are_never_loaded(folder, capsys):
    rng = np.random.default_rng(1)
    files = data_files(folder / "2")
    sizes = np.array([path.stat().st_size for path in files])
    chosen = rng.choice(len(files), 300, p=sizes / sizes.sum())
    taken = sum(flip(folder, files[k], rng) for k in chosen)
    with capsys.disabled():
        sys.stdout.write(f"300 flips, {taken} of them where no reader looks\n")
    assert taken < 300


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

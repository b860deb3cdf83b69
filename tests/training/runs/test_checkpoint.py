"""Checkpoints: what comes back, and what is refused."""

import json
import shutil
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rmp_mjx.training.runs import checkpoint
from rmp_mjx.training.runs.checkpoint import (
    BEST,
    MERITS,
    NEWEST,
    SUMS,
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
    store.save(2, state(2.0), dict.fromkeys(MERITS, 0.5))
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
    assert step == 1
    np.testing.assert_array_equal(found["weights"], state(1.0)["weights"])
    assert part in notes[0]


@pytest.mark.parametrize("content", ["", "5", '{"success": "x"}', "[" * 200_000])
def test_a_rank_that_is_damaged_counts_as_a_damaged_checkpoint(folder, content):
    (folder / "2" / "metrics" / "metrics").write_text(content)
    with pytest.raises(CheckpointError, match="is damaged"):
        Checkpointer(folder, read_only=True).restore(state(), pytest.fail, BEST)
    store, notes = Checkpointer(folder), []
    assert store.restore(state(), notes.append)[0] == 1
    assert "checkpoint 2 is damaged" in notes[0]
    store.close()


def test_a_checkpoint_that_was_killed_before_its_sums_is_read(folder):
    """The arrays have sums of their own."""
    (folder / "2" / SUMS).unlink()
    assert restore(folder)[0] == 2


def data_files(folder):
    return sorted(p for p in folder.rglob("*") if p.is_file() and p.stat().st_size)


def flip(content, rng):
    """One bit is another."""
    spoilt = bytearray(content)
    spoilt[rng.integers(len(spoilt))] ^= 1 << int(rng.integers(8))
    return bytes(spoilt)


def truncate(content, rng):
    """The end is missing."""
    return content[: rng.integers(len(content))]


def replace(content, rng):
    """All is random."""
    return rng.bytes(len(content))


def delete(content, rng):
    """There is no such file."""


def damage(folder, path, how, rng):
    """Damage a file of checkpoint 2 and read; whether 2 is still taken."""
    content = path.read_bytes()
    spoilt = how(content, rng)
    path.unlink() if spoilt is None else path.write_bytes(spoilt)
    notes = []
    step, found = restore(folder, notes=notes)
    path.write_bytes(content)
    assert step == 2 - len(notes)
    for name, leaf in state(float(step)).items():
        assert bits(found[name]) == bits(leaf)
    return step == 2


def test_damage_is_never_loaded_and_takes_one_line(folder, caplog, capfd):
    """Of the sums alone a reader can do without: the arrays have their own."""
    rng = np.random.default_rng(0)
    files = data_files(folder / "2")
    ways = (flip, truncate, replace, delete)
    for k, path in enumerate(files):
        taken = damage(folder, path, ways[k % 4], rng)
        assert not taken or path.name == SUMS
    assert not caplog.records
    assert capfd.readouterr() == ("", "")


@pytest.mark.slow
@pytest.mark.faults
def test_three_hundred_damaged_checkpoints_are_never_loaded(folder, capsys):
    rng = np.random.default_rng(1)
    files = data_files(folder / "2")
    sizes = np.array([path.stat().st_size for path in files])
    chosen = rng.choice(len(files), 300, p=sizes / sizes.sum())
    counts = {flip: 150, truncate: 80, replace: 40, delete: 30}
    ways = [how for how, count in counts.items() for _ in range(count)]
    taken = 0
    for k, how in zip(chosen, ways, strict=True):
        harmless = damage(folder, files[k], how, rng)
        assert not harmless or files[k].name == SUMS
        taken += harmless
    with capsys.disabled():
        sys.stdout.write(f"300 damaged, {taken} of them in the sums alone\n")


def test_without_sums_damage_of_the_arrays_takes_one_line_too(folder, caplog, capfd):
    (folder / "2" / SUMS).unlink()
    largest = max(data_files(folder / "2"), key=lambda p: p.stat().st_size)
    largest.write_bytes(largest.read_bytes()[: largest.stat().st_size // 2])
    notes = []
    assert restore(folder, notes=notes)[0] == 1
    assert len(notes) == 1 and "\n" not in notes[0]
    assert not caplog.records
    assert capfd.readouterr() == ("", "")


def another(tmp_path, run_id):
    """Checkpoint 3 of another run of the same shape."""
    store = Checkpointer(tmp_path / "another", run_id=run_id)
    store.save(3, state(3.0))
    store.close()
    return tmp_path / "another" / "3"


def test_a_checkpoint_of_another_run_is_refused(folder, tmp_path):
    shutil.copytree(another(tmp_path, "b"), folder / "3")
    with pytest.raises(CheckpointMismatch, match=r"3 in .* is of another run"):
        restore(folder)
    assert (folder / "3").is_dir(), "it is not ours to delete"


@pytest.mark.parametrize("number", ["4", "1000000000"])
@pytest.mark.parametrize("put", [shutil.copytree, shutil.move, Path.symlink_to])
def test_a_checkpoint_with_another_number_is_refused(folder, number, put):
    one, other = folder / "1", folder / number
    put(other, one) if put is Path.symlink_to else put(one, other)
    with pytest.raises(CheckpointMismatch, match=f"{number} in .* is a copy of"):
        restore(folder)


def test_a_checkpoint_of_version_0_2_is_read(folder):
    """It had neither sums of the files, nor the run and the step in its manifest."""
    path = folder / "2" / "manifest" / "metadata"
    arrays = json.loads(path.read_text())["arrays"]
    old = {"arrays": arrays, "sha256": checkpoint._digest(arrays)}
    path.write_text(json.dumps(old))
    (folder / "2" / SUMS).unlink()
    step, found = restore(folder)
    assert step == 2
    np.testing.assert_array_equal(found["weights"], state(2.0)["weights"])


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

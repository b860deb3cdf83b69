"""The folder of a run: who may write into it, and what `--overwrite` may delete."""

import os
import subprocess

import pytest

from rmp_mjx.training.config import ConfigError
from rmp_mjx.training.runs import identity, run_folder
from tests.training import toys
from tests.training.conftest import small


def open_run(folder, **changes):
    """Open a folder, and release its lock."""
    run_folder.open_run(small(run_dir=str(folder), **changes))[1].close()


@pytest.fixture
def left(tmp_path):
    """A folder as a run leaves it, with a file that is not the run's."""
    folder = tmp_path / "run"
    folder.mkdir()
    run_folder.describe(folder, small(), toys.Counter(), identity.new_run())
    (folder / "checkpoints" / "3").mkdir(parents=True)
    (folder / "checkpoints" / "3" / "state").write_text("numbers")
    (folder / "mine.txt").write_text("keep")
    return folder


def contents(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_a_folder_with_results_is_refused_unless_they_may_go(left):
    before = contents(left)
    with pytest.raises(ConfigError, match="--resume"):
        open_run(left)
    assert contents(left) == before
    open_run(left, overwrite=True)
    assert sorted(path.name for path in left.iterdir()) == ["lock", "mine.txt"]
    assert (left / "mine.txt").read_text() == "keep"


@pytest.mark.parametrize("name", ["config.json", "versions.json"])
@pytest.mark.parametrize("content", [None, "{}", "[]", "{", '{"name": "theirs"}'])
def test_what_is_not_certainly_a_run_is_not_deleted(left, name, content):
    (left / name).unlink()
    if content is not None:
        (left / name).write_text(content)
    before = contents(left)
    with pytest.raises(ConfigError, match="is not certainly one"):
        open_run(left, overwrite=True)
    assert contents(left) == before, "nothing is deleted, and no lock is left"


def test_links_are_removed_and_never_followed(left, tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    (disk / "precious").write_text("keep")
    for name in ("seeds", "tensorboard", "wandb"):
        (left / name).symlink_to(disk)
    (left / "eval.json").symlink_to(disk / "precious")
    (left / "nonfinite").symlink_to(tmp_path / "nowhere")
    open_run(left, overwrite=True)
    assert sorted(path.name for path in left.iterdir()) == ["lock", "mine.txt"]
    assert (disk / "precious").read_text() == "keep"


def test_a_folder_that_is_a_link_is_not_overwritten(left, tmp_path):
    (tmp_path / "link").symlink_to(left)
    before = contents(left)
    with pytest.raises(ConfigError, match="it is a link"):
        open_run(tmp_path / "link", overwrite=True)
    assert contents(left) == before


@pytest.mark.parametrize("target", ["precious", "nowhere"])
def test_a_lock_that_is_a_link_is_refused(tmp_path, target):
    folder, victim = tmp_path / "run", tmp_path / "precious"
    folder.mkdir()
    victim.write_text("keep")
    (folder / "lock").symlink_to(tmp_path / target)
    with pytest.raises(ConfigError, match="cannot write"):
        open_run(folder)
    assert victim.read_text() == "keep"
    assert not (tmp_path / "nowhere").exists()


def test_two_runs_cannot_share_a_folder(tmp_path):
    config = small(run_dir=str(tmp_path))
    _, lock = run_folder.open_run(config)
    with pytest.raises(ConfigError, match=f"in use by process {os.getpid()}"):
        run_folder.open_run(config)
    lock.close()
    run_folder.open_run(config)[1].close()


def test_a_folder_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for folder in (tmp_path / "file", tmp_path / "file" / "run", tmp_path / "loop"):
        with pytest.raises(ConfigError, match="cannot write"):
            open_run(folder)


def test_a_folder_with_nothing_but_a_lock_is_discarded(tmp_path, left):
    folder = tmp_path / "new"
    open_run(folder)
    run_folder.discard(folder)
    assert not folder.exists()
    before = contents(left)
    run_folder.discard(left)
    assert contents(left) == before


@pytest.mark.parametrize("content", ["5", "[1]", "{}", '[{"jax": 1}]', "[" * 200_000])
def test_damaged_versions_are_refused_by_name(left, content):
    (left / "versions.json").write_text(content)
    with pytest.raises(ConfigError, match=r"versions\.json .*delete it to go on"):
        run_folder.changed_software(left)


def test_an_installed_package_has_no_revision_of_the_repository_around_it(
    tmp_path, monkeypatch
):
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@b", "-C", str(tmp_path)]
    for command in (["init", "-q"], ["commit", "-q", "--allow-empty", "-m", "x"]):
        subprocess.run([*git, *command], check=True)
    for place, known in ((tmp_path, True), (tmp_path / "site-packages", False)):
        file = place / "rmp_mjx" / "training" / "runs" / "run_folder.py"
        file.parent.mkdir(parents=True)
        monkeypatch.setattr(run_folder, "__file__", str(file))
        assert (run_folder.software()["git"] != "unknown") == known

"""Files of demonstrations: what is written is read, what cannot be used is refused."""

import dataclasses
import json

import numpy as np
import polars as pl
import pytest

from rmp_mjx.training import demonstrations, lerobot
from rmp_mjx.training.config import ConfigError
from rmp_mjx.training.demonstrations import Demonstrations
from tests.training import toys


def made(rows=5, **changes):
    """Demonstrations of the counting toy."""
    rng = np.random.default_rng(0)
    columns = {
        "episode": np.array([0, 0, 1, 1, 1])[:rows],
        "step": np.array([0, 1, 0, 1, 2])[:rows],
        "observation": rng.normal(size=(rows, 3)).astype(np.float32),
        "action": rng.uniform(-1.0, 1.0, (rows, 1)).astype(np.float32),
        "reward": rng.normal(size=rows).astype(np.float32),
        "done": np.array([False, True, False, False, True])[:rows],
        "success": np.zeros(rows, bool),
        "about": demonstrations.describe(toys.Counter(), "a test"),
    }
    return Demonstrations(**columns | changes)


def test_what_is_written_is_read(tmp_path):
    path, written = tmp_path / "demos.parquet", made()
    demonstrations.write(path, written)
    found = demonstrations.read(path)
    for field in dataclasses.fields(Demonstrations):
        assert np.array_equal(getattr(found, field.name), getattr(written, field.name))
    assert (found.episodes, found.about["source"]) == (2, "a test")
    assert {"rmp-mjx", "jax", "mujoco"} <= set(found.about["versions"])
    found.check(toys.Counter())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rows": 0}, "at least one step"),
        ({"action": np.full((5, 1), 1.5)}, r"within \[-1, 1\]"),
        ({"action": np.zeros((5, 2))}, r"action .* shape \(5, 2\), not \(5, 1\)"),
        ({"observation": np.zeros((4, 3))}, "observation .* shape"),
        ({"reward": np.array([0, 0, np.nan, 0, 0])}, "reward .* not finite in row 2"),
        (
            {"observation": np.full((5, 3), np.inf)},
            "observation .* not finite in row 0",
        ),
    ],
)
def test_what_no_policy_can_be_made_of_is_refused(changes, message):
    with pytest.raises(ConfigError, match=message):
        made(**changes)


def test_files_that_hold_no_demonstrations_are_refused(tmp_path):
    path = tmp_path / "other.parquet"
    with pytest.raises(ConfigError, match="no file of demonstrations"):
        demonstrations.read(path)
    path.write_text("no parquet")
    with pytest.raises(
        ConfigError, match=r"other.parquet is no file of demonstrations"
    ):
        demonstrations.read(path)
    pl.DataFrame({"step": [1]}).write_parquet(path)
    with pytest.raises(
        ConfigError, match=r"other.parquet is no file of demonstrations"
    ):
        demonstrations.read(path)
    demonstrations.write(path, made(about=made().about | {"format": 9}))
    with pytest.raises(ConfigError, match="format 9, this version reads 1"):
        demonstrations.read(path)


def test_another_tasks_environment_is_refused():
    with pytest.raises(ConfigError, match="another observation size: 3, not 1"):
        made().check(toys.ConstantReward())
    about = made().about | {"task": {"env": "door"}}
    with pytest.raises(ConfigError, match="another task: door, not None"):
        made(about=about).check(toys.Counter())
    named = made().about | {"observation": [["length", 3]]}
    with pytest.raises(ConfigError, match="another observation: "):
        made(about=named).check(toys.Counter())


def test_an_export_has_lerobots_layout_and_every_number(tmp_path):
    file, folder, shown = tmp_path / "demos.parquet", tmp_path / "set", made()
    demonstrations.write(file, shown)
    assert lerobot.main([str(file), str(folder)]) == 0
    info = json.loads((folder / "meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"]) == ("v2.1", 20)
    assert (info["total_episodes"], info["total_frames"]) == (2, 5)
    assert info["features"]["observation.state"]["shape"] == [3]
    tables = [
        pl.read_parquet(folder / info["data_path"].format(episode_chunk=0, **place))
        for place in ({"episode_index": 0}, {"episode_index": 1})
    ]
    whole = pl.concat(tables)
    assert set(whole.columns) == set(info["features"])
    assert np.array_equal(whole["observation.state"].to_numpy(), shown.observation)
    assert np.array_equal(whole["action"].to_numpy(), shown.action)
    assert whole["index"].to_list() == [0, 1, 2, 3, 4]
    # float32 of 0.05 s
    assert np.allclose(tables[1]["timestamp"], [0.0, 0.05, 0.1], atol=1e-7)
    read = (folder / "meta/episodes.jsonl").read_text().splitlines()
    length = {"tasks": ["demonstrations"], "length": 3}
    assert json.loads(read[1]) == {"episode_index": 1} | length
    read = (folder / "meta/episodes_stats.jsonl").read_text().splitlines()
    found = json.loads(read[0])["stats"]["action"]
    assert found["mean"] == pytest.approx([shown.action[:2].mean()])
    assert found["count"] == [2]
    assert (folder / "meta/tasks.jsonl").read_text().count("\n") == 1


def test_an_export_replaces_nothing(tmp_path, capsys):
    assert lerobot.main([str(tmp_path / "none"), str(tmp_path / "set")]) == 2
    demonstrations.write(tmp_path / "demos.parquet", made())
    assert lerobot.main([str(tmp_path / "demos.parquet"), str(tmp_path)]) == 2
    assert "exists: name a new folder" in capsys.readouterr().err

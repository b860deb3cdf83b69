"""The page that compares runs."""

import base64
import dataclasses
import json
import re
from pathlib import Path

import polars as pl
import pytest

from envs.cli import make_config
from rmp_mjx.report.__main__ import main
from rmp_mjx.report.charts import split_curves
from rmp_mjx.report.page import page, table
from rmp_mjx.report.runs import grouped, read_config, read_run
from rmp_mjx.training.records import save_config
from rmp_mjx.training.runs import run_folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two seeds of one controller, two seeds in one run of another."""
    base = tmp_path_factory.mktemp("runs")
    made = []
    for name, controller, seed, num_seeds in (
        ("a", "vices", 0, 1),
        ("b", "vices", 1, 1),
        ("c", "rmp_vices", 0, 2),
    ):
        config = make_config(controller=controller, seed=seed, num_seeds=num_seeds)
        folder = base / f"{name} <script>"
        folder.mkdir()
        save_config(config, folder / run_folder.CONFIG)
        rows = []
        for number in range(seed, seed + num_seeds):
            for k in (1, 2, 3):
                row = {
                    "iteration": k,
                    "steps": 1000 * k,
                    "time/steps_per_s": 500.0,
                    "episode/finished": 4,
                    "episode/return": None if k == 1 else 1.0 * k + number,
                    "per_1000_steps/collision": 2.0,
                    "nonfinite_envs": k,
                }
                rows.append(row | ({"seed": number} if num_seeds > 1 else {}))
            place = (
                folder if num_seeds == 1 else folder / run_folder.SEEDS / str(number)
            )
            place.mkdir(parents=True, exist_ok=True)
            evaluation = {"episodes": 50, "return_mean": 10.0 + number}
            evaluation |= {"collision_episodes": 5, "collision_rate": 0.1}
            (place / run_folder.EVALUATION).write_text(json.dumps(evaluation))
        pl.DataFrame(rows).write_parquet(folder / run_folder.METRICS)
        made.append(folder)
    return made


def test_runs_that_differ_in_their_seed_alone_form_a_group(runs):
    found = grouped(run for folder in runs for run in read_run(folder))
    assert [(g.name, len(g.runs)) for g in found] == [
        ("controller vices", 2),
        ("controller rmp_vices", 2),
    ]
    assert found[0].counted("collision") == (10, 100)
    assert found[1].counted("joint_limit") == (0, 0)  # nobody looked


def test_the_table_has_means_over_seeds_and_events_of_all_of_training(runs):
    found = grouped(run for folder in runs for run in read_run(folder))
    head, first, _ = table(found)
    line = dict(zip(head, first, strict=True))
    assert line["seeds"] == "2" and line["policy steps"] == "3,000"
    assert line["events in training"] == "12"  # two per thousand steps, two seeds
    assert line["return"].startswith("10.5 [10, 11")
    assert line["collision [%]"].startswith("10 ")
    assert line["non-finite"] == "12"


def test_the_page_needs_no_other_file_and_says_what_differs(runs, tmp_path, capsys):
    out = tmp_path / "new" / "page.html"
    assert main([*map(str, runs), "--out", str(out)]) == 0
    assert "2 groups, 4 runs" in capsys.readouterr().out
    written = out.read_text()
    sources = re.findall(r'src="([^"]*)"', written)
    assert len(sources) == 2
    for source in sources:
        kind, _, code = source.partition(",")
        assert kind == "data:image/svg+xml;base64"
        assert b"<svg" in base64.b64decode(code)
    assert "href=" not in written and "<script" not in written
    assert "a &lt;script&gt;" in written
    differing = written.split("What differs")[1].split("Runs</h2>")[0]
    assert "<td>controller</td><td>vices</td><td>rmp_vices</td>" in differing
    assert "num_envs" not in differing


def test_the_page_has_each_runs_pictures_options_and_software(runs):
    picture = runs[0] / run_folder.CLEARANCES
    picture.write_bytes(b"no real picture")
    found = page(grouped(run for folder in runs for run in read_run(folder)))
    picture.unlink()
    code = base64.b64encode(b"no real picture").decode()
    assert f"data:image/png;base64,{code}" in found
    assert found.count("<summary>Options</summary>") == 4
    assert "num_envs</td>" in found
    assert "<script" not in found


def test_curves_that_never_move_are_named_and_not_drawn(runs):
    found = grouped(run for folder in runs for run in read_run(folder))
    moving, flat = split_curves(found)
    assert moving == ["episode/return"]
    assert flat == ["episode/success", "per_1000_steps/collision"]


def test_a_folder_that_is_no_run_is_refused(runs, tmp_path, capsys):
    assert main([str(tmp_path)]) == 2
    assert "no run folder" in capsys.readouterr().err
    save_config(make_config(), tmp_path / run_folder.CONFIG)
    assert main([str(tmp_path)]) == 2
    assert "no rows yet" in capsys.readouterr().err


def test_a_run_of_the_last_version_is_read(tmp_path):
    old = Path(__file__).parent / "envs" / "config-0.1.json"
    (tmp_path / run_folder.CONFIG).write_text(old.read_text())
    flat, found = json.loads(old.read_text()), read_config(tmp_path)
    assert found.ppo.num_envs == flat["num_envs"]
    assert found.run.num_timesteps == flat["num_timesteps"]
    assert found.task.title == f"{flat['env']}, {flat['controller']}"


def test_what_only_names_a_run_is_escaped(runs):
    groups = grouped(run for folder in runs for run in read_run(folder))
    odd = [dataclasses.replace(groups[0], name="<b>$x_1$</b>"), groups[1]]
    found = page(odd)
    assert "&lt;b&gt;$x_1$&lt;/b&gt;" in found and "<b>$" not in found


def test_the_page_lists_the_worst_episodes_of_a_run(runs):
    place = runs[0] / run_folder.WORST
    place.mkdir()
    index = runs[0] / run_folder.WORST_INDEX
    case = {"file": "00061.npz", "episode": 61, "clearance": -0.00284, "return": -63.7}
    case["moments"] = {"clearance": 0.7, "collision": 0.65}
    try:
        index.write_text(json.dumps({"kept": [case]}))
        shown = page(grouped(read_run(runs[0])))
        for words in ("-2.8", "collision 0.65 s", "00061.npz", "--episode FILE"):
            assert words in shown
        index.write_text(json.dumps({"kept": [{"episode": 61}]}))
        with pytest.raises(ValueError, match="damaged"):
            page(grouped(read_run(runs[0])))
    finally:
        index.unlink()
        place.rmdir()
    assert "Worst episodes" not in page(grouped(read_run(runs[0])))

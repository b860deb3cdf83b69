"""Hostile command lines: each ends in one sentence and leaves nothing behind."""

import dataclasses
import json
import random
import sys

import numpy as np
import polars as pl
import pytest

from benchmarks.paper import __main__ as paper
from envs import cli, export, registry, replay, train
from envs import eval as evaluate
from envs.flags import Processes, TrainOptions
from rmp_mjx.report import __main__ as report
from rmp_mjx.training.config import PPOConfig, RunConfig
from rmp_mjx.training.records import save_config
from rmp_mjx.training.runs.checkpoint import CheckpointError
from rmp_mjx.training.runs.loop import TrainResult
from tests.envs import arm_tasks
from tests.training import toys

COMMANDS = {
    "train": train.main,
    "eval": evaluate.main,
    "report": report.main,
    "replay": replay.main,
    "paper": paper.main,
    "export": export.main,
}
VALUES = (
    *("", " ", "nan", "inf", "-inf", "1e999", "-1", "0", "1", "2.5", "x", "None", "[]"),
    *("1e-320", "99999999999999999999", str(2**31), str(2**32), "9" * 5000, "🦾"),
    *("../../x", "$(touch x)", "a" * 300, "\udcff", "true", "--", "null", "-0.0"),
)
"""Values of any option."""
PLACES = ("file", "folder", "loop", "nowhere/x", "run", "file/x", "grid", "a" * 300)
"""Values of options that name a file or a folder, besides the damaged runs."""
RECORD = cli.make_config(num_timesteps=9).record()


def changed(part, **values):
    """The record of a run with other values in one part."""
    return json.dumps({**RECORD, part: {**RECORD[part], **values}})


CONFIGS = {
    "empty": "",
    "half": json.dumps(RECORD)[:99],
    "list": "[]",
    "number": "5",
    "deep": "[" * 200_000,
    "nothing": "{}",
    "parts": json.dumps({**RECORD, "ppo": [1]}),
    "task": json.dumps({**RECORD, "task": "door"}),
    "no env": json.dumps({**RECORD, "task": {}}),
    "env": changed("task", env=5),
    "list env": changed("task", env=["door"]),
    "unknown": changed("ppo", x=1),
    "text": changed("ppo", num_envs="8"),
    "float": changed("ppo", num_envs=8.5),
    "null": changed("ppo", num_envs=None),
    "seed": changed("ppo", seed="zero"),
    "hidden": changed("ppo", hidden_sizes="64"),
    "infinite": changed("ppo", learning_rate=float("inf")),
    "large": changed("ppo", num_envs=10**400),
    "many": changed("ppo", num_seeds=10**6),
    "run_dir": changed("run", run_dir=""),
    "video": changed("run", video="yes"),
    "flat": json.dumps({"env": "door", "env_options": [1]}),
    "flat env": json.dumps({"env": 5, "env_options": []}),
    "bytes": "\udcff",
}
"""Damaged config.json, by what is wrong."""
GRIDS = (
    "5",
    "{}",
    "[" * 200_000,
    '{"configs": 5, "controllers": 5}',
    json.dumps({"configs": {"x": RECORD}, "controllers": [5]}),
    json.dumps({"configs": {}, "controllers": [], "finished": {}}),
    json.dumps({"configs": {"door": RECORD}, "controllers": ["osc"]}),
    json.dumps({"configs": {"x": RECORD}, "controllers": ["osc"], "finished": [1]}),
)
"""Damaged grid.json."""


def write(path, text):
    path.write_bytes(text.encode(errors="surrogateescape"))


def make_run(folder):
    """A folder as a run leaves it."""
    folder.mkdir()
    save_config(cli.make_config(), folder / "config.json")
    (folder / "versions.json").write_text('[{"jax": "0"}]')
    row = {"iteration": 1, "steps": 4, "nonfinite_envs": 0, "time/steps_per_s": 1.0}
    pl.DataFrame([row]).write_parquet(folder / "metrics.parquet")
    (folder / "eval.json").write_text('{"episodes": 5, "return_mean": 1.0}')


@pytest.fixture
def places(tmp_path, monkeypatch):
    """A working directory with whole and damaged runs; no command gets to work."""
    monkeypatch.chdir(tmp_path)
    arm_tasks.register(monkeypatch)
    toy = toys.Counter()
    stopped = TrainResult(lambda obs, key: obs, 1, 130, False)
    monkeypatch.setattr(registry, "make", lambda *given: toy)
    monkeypatch.setattr(train, "learn", lambda *given: stopped)
    monkeypatch.setattr(paper.training, "run", lambda *given: 1)

    def refuse(*given):
        raise CheckpointError("evaluation would begin")

    monkeypatch.setattr(evaluate, "agent_of", refuse)
    write(tmp_path / "file", "text")
    (tmp_path / "folder").mkdir()
    write(tmp_path / "folder" / "mine", "keep")
    (tmp_path / "loop").symlink_to("loop")
    make_run(tmp_path / "run")
    (tmp_path / "grid").mkdir()
    cells = {"configs": {"trajectory": RECORD}, "controllers": ["osc"], "finished": {}}
    write(tmp_path / "grid" / "grid.json", json.dumps(cells))
    for name, text in CONFIGS.items():
        make_run(tmp_path / f"config {name}")
        write(tmp_path / f"config {name}" / "config.json", text)
    make_run(tmp_path / "config folder")
    (tmp_path / "config folder" / "config.json").unlink()
    (tmp_path / "config folder" / "config.json").mkdir()
    for name in ("versions.json", "metrics.parquet", "eval.json"):
        for k, text in enumerate(("", "5", "[1]", '"x"', "[" * 200_000, "\udcff")):
            make_run(tmp_path / f"{name} {k}")
            write(tmp_path / f"{name} {k}" / name, text)
    for k, text in enumerate(GRIDS):
        (tmp_path / f"grid {k}").mkdir()
        write(tmp_path / f"grid {k}" / "grid.json", text)
    steps = tmp_path / "steps" / "nonfinite"
    steps.mkdir(parents=True)
    for k, about in enumerate(("5", "[1]", "{}", '{"config": {}, "iteration": 1}')):
        np.savez(steps / f"{k}.npz", about=np.array(about), action=np.zeros(2))
    np.savez(steps / "object.npz", about=np.array([{"a": 1}], dtype=object))
    np.save(steps / "plain.npy", np.zeros(3))
    write(steps / "zip.npz", "PK\x03\x04 damaged")
    return tmp_path


def flags():
    """The flags of each command, from its options; those that name a place apart."""
    parts = {
        "train": (arm_tasks.CounterOptions, PPOConfig, RunConfig, Processes),
        "eval": (arm_tasks.CounterOptions, cli.EvalOptions),
        "paper": (paper.Options,),
        "export": (export.ExportOptions,),
    }
    found = {
        command: [field.name for part in kinds for field in dataclasses.fields(part)]
        for command, kinds in parts.items()
    }
    own = {field.name for field in dataclasses.fields(TrainOptions)}
    found["train"] += sorted(own - {"task", "ppo", "run", "processes"})
    return found | {"report": ["out"], "replay": ["limit"]}


NAMING = ("run", "resume", "run_dir", "out", "folder", "page", "pack", "file")
"""Flags that name a place."""
STARTS = {
    "train": ["--env", "counter", "--run_dir", "new"],
    "eval": ["--env", "counter", "--agent", "zero", "--out", "new"],
    "report": ["run"],
    "replay": ["steps"],
    "paper": ["--folder", "new", "--only", "door/osc/0"],
    "export": ["run", "--out=new.safetensors"],
}
"""What each command line begins with."""


def lines(count, places, rng):
    """Command lines: a flag after the other, with values at random."""
    known = flags()
    damaged = sorted(
        path.relative_to(places).as_posix()
        for path in (*places.iterdir(), *places.glob("steps/nonfinite/*"))
    )
    commands = [name for name, number in SHARES.items() for _ in range(number)]
    seen = dict.fromkeys(commands, 0)
    for k in range(count):
        command = commands[k % len(commands)]
        args = list(STARTS[command])
        name = known[command][seen[command] % len(known[command])]
        seen[command] += 1
        if command in ("report", "replay", "export") and rng.random() < 0.8:
            args[0] = rng.choice((*damaged, *VALUES))
        elif name in NAMING or rng.random() < 0.3:
            name = name if name in NAMING else rng.choice(PLACED[command])
            if name in ("resume", "run"):
                del args[2:]
            args += [f"--{name}", rng.choice((*damaged, *PLACES, *VALUES))]
        elif rng.random() < 0.2:
            args += [f"--{name}={rng.choice(VALUES)}"]
        else:
            args += [f"--{name}", rng.choice(VALUES)]
        yield command, args


SHARES = {"train": 10, "eval": 6, "report": 4, "replay": 2, "paper": 2, "export": 1}
"""How many of 25 command lines are of each command."""
PLACED = {
    "train": ("resume", "run_dir"),
    "eval": ("run", "out"),
    "report": ("out",),
    "replay": ("limit",),
    "paper": ("folder", "page", "pack"),
    "export": ("checkpoint",),
}
"""Flags of each command that name a place."""


def contents(places):
    return {
        path.relative_to(places).as_posix(): path.is_file() and path.read_bytes()
        for path in places.rglob("*")
        if path.name != "loop"
    }


def end(command, args):
    """The exit code of a command."""
    try:
        return COMMANDS[command](args)
    except SystemExit as stop:
        return stop.code or 0


def attack(count, places, capsys, seed):
    """Run the command lines; how many ended with each code."""
    codes, before = {}, contents(places)
    # As the interpreter opens it; pytest's own fails on names that no encoding has.
    sys.stderr.reconfigure(errors="backslashreplace")  # pyright: ignore[reportAttributeAccessIssue]
    for command, args in lines(count, places, random.Random(seed)):
        shown = f"{command} {args}"[:300]
        try:
            code = end(command, args)
        except Exception as error:
            pytest.fail(f"{shown}: {type(error).__name__}: {error}"[:600])
        out, err = capsys.readouterr()
        assert code in (0, 1, 2, 130), shown
        assert "Traceback" not in out + err, shown
        after = contents(places)
        if code == 2:
            assert err.strip(), f"{shown}: refused without a word"
            assert after == before, f"{shown}: left {after.keys() ^ before.keys()}"
        codes[code] = codes.get(code, 0) + 1
        before = after
    return codes


def test_a_hostile_command_line_ends_in_one_sentence(places, capsys):
    codes = attack(100, places, capsys, seed=0)
    assert codes[2] > 40


@pytest.mark.slow
@pytest.mark.faults
def test_five_hundred_hostile_command_lines_end_in_one_sentence(places, capsys):
    codes = attack(500, places, capsys, seed=1)
    with capsys.disabled():
        sys.stdout.write(
            f"500 command lines, exit codes {dict(sorted(codes.items()))}\n"
        )
    assert codes[2] > 200


@pytest.mark.parametrize("form", [["--{}", ""], ["--{}", " "], ["--{}="]])
@pytest.mark.parametrize(
    ("command", "name"),
    [
        *(("train", name) for name in ("resume", "run_dir", "env", "envs", "wandb")),
        *(("eval", name) for name in ("run", "out", "checkpoint", "env")),
        *(("paper", name) for name in ("only", "folder", "page", "pack")),
        ("report", "out"),
        ("replay", "limit"),
        ("export", "checkpoint"),
    ],
)
def test_an_empty_value_is_refused_by_name(places, capsys, command, name, form):
    before = contents(places)
    args = [*STARTS[command][:2], *(part.format(name) for part in form)]
    assert end(command, args) == 2
    assert f"--{name} is empty: give a value" in capsys.readouterr().err
    assert contents(places) == before


@pytest.mark.parametrize("command", ["report", "replay", "export"])
def test_an_empty_place_is_refused(places, capsys, command):
    assert end(command, ["", *STARTS[command][1:]]) == 2
    assert "an argument is empty" in capsys.readouterr().err

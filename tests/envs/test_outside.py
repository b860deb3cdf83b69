"""Tasks from outside: what is found, what is refused, and what files cannot do."""

import json
import sys

import pytest

import envs
import rmp_mjx_envs
from envs import cli, export, outside, replay
from envs.flags import load_config, typed
from rmp_mjx.training.config import ConfigError
from rmp_mjx.training.records import save_config
from rmp_mjx.training.runs import run_folder

TASK = """
import dataclasses
from typing import ClassVar, Literal

import numpy as np
from rmp_mjx_envs import ArmEnv, Options

@dataclasses.dataclass(frozen=True)
class ReachOptions(Options):
    '''Options of reaching.'''

    env: ClassVar[str] = "reach"
    near: float = 0.05
    '''Distance that counts as reached [m].'''
    goal: Literal["random", "middle"] = "random"
    '''Where the goal is.'''

class Reach(ArmEnv[ReachOptions]):
    '''Bring the hand to a point.'''

    Options = ReachOptions
    q_start = np.zeros(7)
    sphere_box = (np.zeros(3), np.ones(3))
    task_entries = ()
    begin = score = observe = keep_clear = lambda self, *given: None
"""
"""A task as far as its command line goes."""
BREAK = "raise SystemExit('imported')"
"""A module that nothing may import."""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working directory; modules and tasks are forgotten afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(outside, "_found", {})
    yield tmp_path
    for name, module in [*sys.modules.items()]:
        if str(getattr(module, "__file__", None)).startswith(str(tmp_path)):
            del sys.modules[name]


@pytest.fixture
def own(folder):
    """my_task.py in the working directory."""
    (folder / "my_task.py").write_text(TASK)
    return folder


@pytest.fixture
def package(folder):
    """`package(points, **modules)`: an installed distribution with entry points."""

    def install(points, name="reach-tasks", **modules):
        place = folder / f"site-{name}"
        info = place / f"{name.replace('-', '_')}-1.2.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.2\n"
        )
        (info / "entry_points.txt").write_text(f"[{outside.GROUP}]\n{points}\n")
        for module, text in modules.items():
            (place / f"{module}.py").write_text(text)
        sys.path.append(str(place))

    return install


def test_the_tasks_have_one_set_of_classes_under_both_names():
    assert rmp_mjx_envs.ArmEnv is envs.ArmEnv and rmp_mjx_envs.load is envs.load
    assert rmp_mjx_envs.replay is replay
    with pytest.raises(ImportError, match="not a package"):
        __import__("rmp_mjx_envs.types")
    with pytest.raises(ImportError, match="nowhere"):
        from rmp_mjx_envs import nowhere  # noqa: F401


def test_a_class_of_the_working_directory_is_a_task_under_the_name_given(own):
    kind = envs.task("my_task:Reach")
    assert issubclass(kind, envs.ArmEnv) and kind.__name__ == "Reach"
    assert envs.task("my_task:Reach") is kind
    options = envs.make_options("my_task:Reach", near=0.1)
    assert options.record() | {"env": "my_task:Reach", "near": 0.1} == options.record()
    assert sys.modules["my_task"].Reach.Options.env == "reach"  # as its author wrote it
    assert options == envs.make_options(**options.record())
    with pytest.raises(ValueError, match="unknown goal 'left'; valid names: random"):
        envs.make_options("my_task:Reach", goal="left")


def test_installed_modules_go_before_the_working_directory(folder):
    (folder / "textwrap.py").write_text(BREAK)
    with pytest.raises(ValueError, match="unknown class of textwrap 'Reach'"):
        envs.task("textwrap:Reach")


def test_its_options_are_flags_and_its_run_finds_it_again(own, capsys):
    flags = ["--env", "my_task:Reach", "--goal", "middle", "--near=0.1"]
    config = cli.parse_train([*flags, "--num_envs", "64"])[0].config
    assert config == cli.make_config(
        "my_task:Reach", goal="middle", near=0.1, num_envs=64
    )
    save_config(config, own / "config.json")
    found = cli.parse_train(["--env", "my_task:Reach", "--resume", str(own)])[0]
    assert found.config == config.replace(resume=str(own))
    evaluated, _ = cli.parse_eval(["--env", "my_task:Reach", "--run", str(own)])
    assert evaluated.task.record() == config.task.record()
    trivial, _ = cli.parse_eval(["--env", "my_task:Reach", "--agent", "zero"])
    assert str(trivial.folder) == "runs/zero-my_task.Reach-rmp_vices"
    assert run_folder.default_run_dir(config).name.startswith("my_task.Reach-rmp_vices")
    for parse in (cli.parse_train, cli.parse_eval):
        with pytest.raises(SystemExit, match="0"):
            parse(["--env", "my_task:Reach", "--help"])
        said = capsys.readouterr().out
        assert "--goal {random,middle}" in said and "counts as reached" in said
        with pytest.raises(SystemExit, match="2"):
            parse(["--env", "my_task:Reach", "--goal", "left"])
        assert "'middle'" in capsys.readouterr().err.replace("│", "")


def test_a_grid_of_own_tasks_goes_on(own):
    flags = ["--envs", "my_task:Reach,door", "--controllers", "osc"]
    _, grid = cli.parse_train([*flags, "--run_dir", "grid"])
    assert grid and list(grid.cells()) == ["my_task.Reach-osc", "door-osc"]
    grid.save({})
    _, again = cli.parse_train(["--env", "my_task:Reach", "--resume", "grid"])
    assert again and list(again.cells()) == list(grid.cells())
    assert [c.task for c in again.configs.values()] == [
        c.task for c in grid.configs.values()
    ]


def test_a_packages_entry_point_is_a_task(package):
    package("reach = far.tasks:Reach\nother = gone:Gone", far="", x=TASK)
    with pytest.raises(ValueError, match=r"'reach' of reach-tasks 1\.2: there is no"):
        envs.task("reach")
    package("hover = hovering : Reach", name="hover-tasks", hovering=TASK)
    assert envs.make_options("hover").record()["env"] == "hover"
    assert cli.parse_train(["--env", "hover", "--near", "0.2"])[0].config.task.env
    with pytest.raises(ValueError, match="trajectory, door, push, hover, other, reach"):
        envs.task("hoover")
    assert "hover" not in envs.names()


def test_a_name_that_two_packages_offer_is_refused(package):
    package("reach = one:Reach", name="one", one=BREAK)
    package("reach = two:Reach", name="two", two=BREAK)
    with pytest.raises(ValueError, match=r"offered by one 1\.2 and two 1\.2"):
        envs.task("reach")


def test_a_package_does_not_replace_a_task_of_this_one(package):
    package("door = doors:Door", doors=BREAK)
    assert envs.task("door") is envs.ENVS["door"]


WRONG = {
    "nowhere:Reach": "there is no module nowhere: install its package, or work in",
    "my_task.py:Reach": "there is no module my_task.py",
    "my_task:Raech": "unknown class of my_task 'Raech'; valid names: Reach. Did you",
    "my_task:np": "it is no subclass of ArmEnv",
    "os:system": "it is no subclass of ArmEnv",
    "my_task:ReachOptions": "it is no subclass of ArmEnv",
    "my_task:ArmEnv": "ArmEnv does not define begin, keep_clear",
    "my_task:": "'my_task:' is no module:Class, as my_task:Reach is",
    ":Reach": "no module:Class",
    "../my_task:Reach": "no module:Class",
    "my_task:Reach:Reach": "no module:Class",
    "my_task:Reach.Options": "no module:Class",
}
"""Names that are none, and what is said."""


@pytest.mark.parametrize(("name", "message"), WRONG.items(), ids=list(WRONG))
def test_a_name_that_is_no_task_is_refused_with_what_is_wrong(own, name, message):
    with pytest.raises(ValueError, match=r"^env '") as refused:
        cli.parse_train(["--env", name])
    assert message in str(refused.value)


CHANGES = {
    "1/0": ("import numpy as np", "1/0", "ZeroDivisionError: division by zero (my"),
    "exit": ("import numpy as np", "raise SystemExit(3)", "failed: SystemExit: 3 (my"),
    "needs": (
        "import numpy as np",
        "import nowhere",
        "failed: ModuleNotFoundError: N",
    ),
    "syntax": ("import numpy as np", "import (", "failed: SyntaxError: invalid syntax"),
    "abstract": ("begin = score", "score", "Reach does not define begin"),
    "start": ("q_start = np.zeros(7)", "", "Reach does not define q_start"),
    "none": ("    Options = ReachOptions", "", "Reach.Options must be a subclass"),
    "foreign": ("Options = ReachOptions", "Options = int", "must be a subclass of Opt"),
    "plain": ("@dataclasses.dataclass(frozen=True)", "", "lacks its decorator"),
    "thaw": ("(frozen=True)", "", "cannot inherit non-frozen dataclass from a frozen"),
    "name": (
        '    env: ClassVar[str] = "reach"',
        "",
        "lacks the name of the task, en",
    ),
    "field": ("ClassVar[str]", "str", "lacks the name of the task, env: ClassVar"),
    "default": ('= "random"', '= "left"', "ReachOptions() fails, but every option"),
    "taken": ("near: float", "seed: float", "seed: training or evaluation has an op"),
}
"""A line of the task, another in its place, and what is said."""


@pytest.mark.parametrize(("old", "new", "message"), CHANGES.values(), ids=list(CHANGES))
def test_a_task_that_is_none_is_refused_in_one_line(own, old, new, message):
    assert TASK.count(old) >= 1
    (own / "my_task.py").write_text(TASK.replace(old, new, 1))
    for parse in (cli.parse_train, cli.parse_eval):
        with pytest.raises(ValueError, match=r"Reach") as refused:
            parse(["--env", "my_task:Reach"])
        assert message in str(refused.value)
        assert len(str(refused.value).splitlines()) == 1


def hostile(folder, env="trap:Reach"):
    """A run, a grid and a record of version 0.1 that name a module; it is there."""
    (folder / "trap.py").write_text(BREAK)
    sys.path.append(str(folder))
    record = json.loads(json.dumps(cli.make_config().record()))
    record["task"]["env"] = env
    old = {"env": env, "env_options": []}
    grid = {"configs": {env: record}, "controllers": ["osc"], "finished": {}}
    old_grid = {"config": old, "envs": [env], "controllers": ["osc"]}
    places = {}
    for name, file, text in (
        ("run", "config.json", record),
        ("old", "config.json", old),
        ("grid", "grid.json", grid),
        ("old grid", "grid.json", old_grid),
    ):
        (folder / name).mkdir()
        (folder / name / file).write_text(json.dumps(text))
        places[name] = str(folder / name)
    return places


@pytest.mark.parametrize("more", [[], ["--env", "door"]])
def test_no_file_makes_a_command_import_a_module(folder, more):
    places = hostile(folder)
    for name in ("run", "old"):
        for parse, flag in ((cli.parse_train, "--resume"), (cli.parse_eval, "--run")):
            with pytest.raises(ConfigError, match="add --env trap:Reach"):
                parse([flag, places[name], *more])
        with pytest.raises(ConfigError, match="add --env trap:Reach"):
            load_config(folder / name)
    for name in ("grid", "old grid"):
        with pytest.raises(ConfigError, match="add --env trap:Reach"):
            cli.parse_train(["--resume", places[name], *more])
    assert "trap" not in sys.modules
    with pytest.raises(ValueError, match="SystemExit: imported"):  # the user names it
        cli.parse_train(["--resume", places["run"], "--env", "trap:Reach"])


def test_no_file_makes_replay_or_export_import_a_module(folder, own, capsys):
    places = hostile(folder)
    assert export.main([places["run"], "--out", "new.safetensors"]) == 2
    assert "add --env trap:Reach" in " ".join(capsys.readouterr().err.split())
    assert "trap" not in sys.modules
    for command in (replay.main, export.main):
        args = [places["run"]]
        if command is export.main:
            args += ["--out", "x.safetensors"]
        assert command([*args, "--env", "trap:Reach"]) == 2
        assert "SystemExit: imported" in capsys.readouterr().err


def test_a_run_of_a_package_that_is_gone_says_what_is_missing(folder):
    places = hostile(folder, env="reach")
    with pytest.raises(ConfigError, match=r"'reach'.*needs that package installed"):
        cli.parse_eval(["--run", places["run"]])


def test_the_commands_that_messages_name_can_be_typed(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/x/train.py"])
    assert typed("train", "env", "door") == "python train.py"
    assert typed("train", "env", "my:Reach") == "python train.py --env my:Reach"
    monkeypatch.setattr(sys, "argv", ["/x/bin/rmp-mjx-train"])
    assert typed("train", "envs", "door", "m:R") == "rmp-mjx-train --envs door,m:R"
    assert typed("replay") == "rmp-mjx-replay"

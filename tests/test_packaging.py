import importlib
import re
import tomllib
import zipfile

import pytest
from hatchling.builders.wheel import WheelBuilder
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

MAX_LINES = 400  # the project's hard stop for one file


@pytest.fixture(scope="module")
def wheel(root, tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    (path,) = WheelBuilder(str(root)).build(
        directory=str(folder), versions=["standard"]
    )
    return set(zipfile.ZipFile(path).namelist())


@pytest.fixture(scope="module")
def project(root):
    return tomllib.loads((root / "pyproject.toml").read_text())["project"]


@pytest.fixture(scope="module")
def locked(root):
    """Versions by name, without their hashes."""
    text = (root / "requirements.lock").read_text()
    return dict(re.findall(r"^(\S+)==(\S+)", text, re.M))


def test_the_wheels_top_level_names_are_the_librarys_and_the_tasks(wheel):
    """Nothing called `envs`, `train`, `eval`, `tests` or `benchmarks`."""
    top = {name.split("/")[0] for name in wheel}
    found = {name for name in top if not name.endswith(".dist-info")}
    assert found == {"rmp_mjx", "rmp_mjx_envs"}


@pytest.mark.parametrize(
    ("folder", "installed"), [("rmp_mjx", "rmp_mjx"), ("envs", "rmp_mjx_envs")]
)
def test_the_wheel_carries_every_module_and_description(wheel, root, folder, installed):
    kinds = {".py", ".xml", ".toml", ".typed"}
    files = [p for p in (root / folder).rglob("*") if p.suffix in kinds]
    files.append(root / folder / "py.typed")
    wanted = {f"{installed}/{p.relative_to(root / folder).as_posix()}" for p in files}
    assert any(name.endswith(".xml") for name in wanted)
    assert wanted <= wheel


def test_the_console_commands_are_functions_of_the_package(project):
    scripts = project["scripts"]
    assert set(scripts) == {
        f"rmp-mjx-{name}"
        for name in ("train", "eval", "replay", "export", "check-robot")
    }
    for target in scripts.values():
        module, _, function = target.partition(":")
        assert callable(getattr(importlib.import_module(module), function))


def test_an_editable_install_copies_nothing(root, tmp_path):
    (path,) = WheelBuilder(str(root)).build(
        directory=str(tmp_path), versions=["editable"]
    )
    files = zipfile.ZipFile(path).namelist()
    assert [name for name in files if ".dist-info/" not in name] == ["_rmp_mjx.pth"]


def test_the_wheel_carries_the_licence(wheel):
    assert any(name.endswith("licenses/LICENSE") for name in wheel)


def test_the_lock_is_pins_with_hashes_without_the_project_itself(root, locked):
    digest = r"( \\\n    --hash=sha256:[0-9a-f]{64})+\n"
    pins = re.compile(rf"([A-Za-z0-9._-]+==[A-Za-z0-9.!+]+{digest})+")
    assert pins.fullmatch((root / "requirements.lock").read_text())
    assert len(locked) > 100
    assert not any(name.lower().startswith("rmp") for name in locked)


def test_the_lock_meets_every_requirement_that_the_project_states(project, locked):
    pins = {canonicalize_name(name): version for name, version in locked.items()}
    stated = project["dependencies"] + project["optional-dependencies"]["dev"]
    stated += project["optional-dependencies"]["peers"]
    for requirement in map(Requirement, stated):
        if requirement.name == project["name"]:
            continue
        version = pins[canonicalize_name(requirement.name)]
        assert version in requirement.specifier, f"{requirement} but {version} locked"


def test_the_version_is_said_once(project, root):
    import rmp_mjx

    assert "version" in project["dynamic"]
    said = re.findall(
        r'^__version__ = "(.+)"$', (root / "rmp_mjx/__init__.py").read_text(), re.M
    )
    assert said == [rmp_mjx.__version__]


def test_no_source_file_is_too_long_to_read(root):
    folders = ("rmp_mjx", "envs", "tests", "benchmarks")
    files = [p for folder in folders for p in (root / folder).rglob("*.py")]
    files += list(root.glob("*.py"))
    long = {
        p.relative_to(root).as_posix(): n
        for p in files
        if (n := len(p.read_text().splitlines())) > MAX_LINES
    }
    assert not long

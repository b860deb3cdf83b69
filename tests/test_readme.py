"""The documents' Python blocks run and their commands exist."""

import importlib.util
import re
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "benchmarks" / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
]


SMALLER = {
    "num_timesteps=400_000": "num_timesteps=1",
    "num_envs=256": "num_envs=8, num_eval_envs=8, batch_size=8, num_minibatches=1",
    "episode_length=1024": "episode_length=8",
}
"""Sizes in the documents' blocks that the tests replace: they do not train."""


def blocks(path: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", path.read_text(), re.S | re.M)


def commands() -> list[tuple[str, str]]:
    """Every shell line of the documents, comments stripped: (document, command)."""
    found = []
    for document in DOCUMENTS:
        for block in blocks(document, "bash"):
            for line in block.replace("\\\n", " ").splitlines():
                command = line.split("#")[0].strip()
                if command:
                    found.append((document.name, command))
    return found


@cache
def help_text(*target: str) -> str:
    done = subprocess.run(
        [sys.executable, *target, "--help"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@cache
def namespace(document: Path) -> dict[str, Any]:
    """What a document's Python blocks define, run in order."""
    names: dict[str, Any] = {}
    for block in blocks(document, "python"):
        for size, smaller in SMALLER.items():
            block = block.replace(size, smaller)
        exec(compile(block, document.name, "exec"), names)
    return names


SLOW = ("brax",)
"""Documents whose blocks compile other trainers."""


@pytest.mark.parametrize("size", SMALLER)
def test_what_is_made_smaller_is_in_a_document(size):
    assert any(size in b for d in DOCUMENTS for b in blocks(d, "python"))


@pytest.mark.parametrize(
    "document",
    [
        pytest.param(d, id=d.stem, marks=[pytest.mark.slow] * (d.stem in SLOW))
        for d in DOCUMENTS
        if blocks(d, "python")
    ],
)
def test_the_python_blocks_of_a_document_run_in_order(document):
    assert namespace(document)


def test_the_readmes_controller_example_gives_torques_within_the_limits():
    tau, robot = (namespace(ROOT / "README.md")[name] for name in ("tau", "robot"))
    assert tau.shape == (256, robot.n)
    assert (abs(tau) <= robot.tau_max * (1 + 1e-6)).all()  # one float32 rounding


@pytest.mark.parametrize(
    ("document", "command"), commands(), ids=lambda v: v.replace(" ", "_")[:50]
)
def test_the_commands_of_the_documents_exist(document, command):
    words = command.split()
    while words and re.match(r"^[A-Z_]+=", words[0]):
        words = words[1:]
    if words[0] == "make":
        target = next(w for w in words[1:] if "=" not in w)
        makefile = (ROOT / "Makefile").read_text()
        assert re.search(rf"^{re.escape(target)}:", makefile, re.M), target
    elif words[0].startswith("rmp-mjx-"):
        project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
        assert words[0] in project["scripts"]
    elif words[0] in ("python", ".venv/bin/python"):
        if words[1] == "-m":
            assert importlib.util.find_spec(words[2]), f"no module {words[2]}"
            if not words[2].startswith("benchmarks"):
                return
            target, rest = ("-m", words[2]), words[3:]
        else:
            assert (ROOT / words[1]).exists(), f"no script {words[1]}"
            target, rest = (words[1],), words[2:]
            if not rest:  # a script without options may have no help
                return
            if "--env" in rest:  # its options are flags
                at = rest.index("--env")
                target += tuple(rest[at : at + 2])
        # Underscores and dashes are both accepted in option names.
        shown = help_text(*target).replace("_", "-")
        for flag in (w.split("=")[0] for w in rest if w.startswith("--")):
            assert re.search(rf"{flag.replace('_', '-')}\b", shown), (
                f"{document}: {flag}"
            )

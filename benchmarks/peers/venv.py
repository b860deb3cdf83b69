"""Virtual environments of the peers, made once under the user's cache."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from rmp_mjx import runtime

STAMP = "requirements.txt"


class NotInstalled(RuntimeError):
    """A peer could not be installed; the message is pip's."""


def folder() -> Path:
    """Where the environments are: beside the compile cache."""
    return runtime.default_cache_dir().parent / "peers"


def python(name: str, requirements: Sequence[str]) -> Path:
    """The interpreter of a peer's environment; makes it if it is missing or stale.

    Args:
        name: The peer; its environment's folder.
        requirements: What pip installs.

    Raises:
        NotInstalled: venv or pip failed.
    """
    home = folder() / name
    interpreter, stamp = home / "bin" / "python", home / STAMP
    wanted = "\n".join(requirements) + "\n"
    if stamp.exists() and stamp.read_text() == wanted:
        return interpreter
    shutil.rmtree(home, ignore_errors=True)
    _run([sys.executable, "-m", "venv", str(home)], name)
    pip = [str(interpreter), "-m", "pip", "--disable-pip-version-check", "install"]
    _run([*pip, "--quiet", *requirements], name)
    stamp.write_text(wanted)
    return interpreter


def _run(command: Sequence[str], name: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        tail = " ".join(done.stderr.split())[-300:]
        raise NotInstalled(f"{name} could not be installed: {tail}")

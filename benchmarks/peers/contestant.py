"""The driver's side of a `worker`: start it, query it, stop it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.common import ROOT
from benchmarks.peers.worker import ANSWERS


class ContestantError(RuntimeError):
    """A contestant's process failed."""


class Contestant:
    """A running `worker`."""

    def __init__(
        self,
        module: str,
        arguments: Sequence[str] = (),
        python: Path | str = sys.executable,
        xla_flags: str = "",
    ):
        """Start the process.

        Args:
            module: What it runs, as for ``python -m``; it calls `worker.serve`.
            arguments: Its options.
            python: Its interpreter.
            xla_flags: Its XLA flags.

        Raises:
            ContestantError: It failed; the message has the end of what it printed.
        """
        self.module = module
        self.log = tempfile.TemporaryFile("w+")  # noqa: SIM115
        read, write = os.pipe()
        env = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
        env |= {ANSWERS: str(write)} | ({"XLA_FLAGS": xla_flags} if xla_flags else {})
        self.process = subprocess.Popen(
            [str(python), "-m", module, *arguments],
            cwd=ROOT,
            env=env,
            stdin=subprocess.PIPE,
            stdout=self.log,
            stderr=self.log,
            pass_fds=(write,),
            text=True,
        )
        os.close(write)
        self.answers = os.fdopen(read)
        self.versions = self._answer()["versions"]

    def measure(self, name: str, seconds: float) -> float:
        """One measurement; the first of a name also makes it ready."""
        assert self.process.stdin is not None
        try:
            self.process.stdin.write(
                json.dumps({"name": name, "seconds": seconds}) + "\n"
            )
            self.process.stdin.flush()
        except BrokenPipeError:
            pass  # the answer says why
        return self._answer()["value"]

    def close(self) -> None:
        """Let the process end."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        try:
            self.process.wait(timeout=20)
        except subprocess.TimeoutExpired:
            self.process.kill()

    def _answer(self) -> dict[str, Any]:
        line = self.answers.readline()
        if not line:
            self.log.seek(0)
            tail = self.log.read().strip().splitlines()[-4:]
            raise ContestantError(f"{self.module} failed: " + " | ".join(tail))
        return json.loads(line)

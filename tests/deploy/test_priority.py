"""Real-time priority: all threads get it, or none does."""

import os
import subprocess
import sys

import pytest

from rmp_mjx import deploy

if not hasattr(os, "SCHED_FIFO"):
    pytest.skip("Linux alone has these priorities", allow_module_level=True)


def test_all_threads_of_a_process_become_urgent_and_usual_again():
    script = (
        "import threading; threading.Thread(target=input).start(); print(flush=True)"
    )
    with subprocess.Popen(
        [sys.executable, "-u", "-c", f"{script}; input()"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        threads = [int(x) for x in os.listdir(f"/proc/{process.pid}/task")]
        assert len(threads) == 2
        allowed = deploy.hurry(process.pid)
        wanted = os.SCHED_FIFO if allowed else os.SCHED_OTHER
        assert {os.sched_getscheduler(x) for x in threads} == {wanted}
        assert deploy.relax(process.pid)
        assert {os.sched_getscheduler(x) for x in threads} == {os.SCHED_OTHER}
        process.kill()


def test_where_it_is_not_allowed_nothing_is_raised(monkeypatch):
    def refuse(*arguments):
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    assert not deploy.hurry()

"""The command: load an arm, open the page, run until interrupted."""

import argparse
import contextlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from rmp_mjx import runtime
from rmp_mjx.fields import arguments
from rmp_mjx.names import unknown
from rmp_mjx.robot import Robot, robots
from rmp_mjx.viewer.dials import CONTROLLERS
from rmp_mjx.viewer.things import SCENES


def main(args: Sequence[str] | None = None) -> int:
    """Show the page; returns the exit code."""
    try:
        import viser as viser
    except ImportError as missing:
        _say(Console(stderr=True), f"error: pip install 'rmp-mjx[viewer]': {missing}")
        return 2
    with contextlib.suppress(KeyboardInterrupt):
        try:
            options, rest = _parser().parse_known_args(arguments(args))
            page = _page(options, rest)
        except (ValueError, OSError) as error:
            _say(Console(stderr=True), f"error: {error}")
            return 2
        if page is None:
            return 0
        hint = "" if options.watch else ", end with Ctrl+C"
        _say(Console(), f"open {page.url}{hint}")
        page.run(options.seconds)
    return 0


def _page(options: argparse.Namespace, rest: list[str]) -> Any:
    """The page that the options ask for; None: what it is to show has ended.

    Raises:
        ValueError: The options contradict each other, or there is no such thing.
    """
    if options.run is not None or options.episode is not None:
        return _task(options, rest)
    if options.teleoperate is not None:
        from rmp_mjx_envs import teleoperate

        return teleoperate.page(options.teleoperate, rest, options.port, options.out)
    if options.worst or options.watch:
        raise ValueError("--worst and --watch need --run RUN")
    if rest:
        raise ValueError(f"unknown: {' '.join(rest)}. See --help")
    from rmp_mjx.viewer.objects import NONE
    from rmp_mjx.viewer.page import Page
    from rmp_mjx.viewer.session import Session

    runtime.configure()
    scene, objects = options.scene, NONE
    if scene in SCENES:
        arm = Robot.load(options.robot)
    else:
        arm, objects = _in_task(scene, options.robot)
        scene = "free"
    session = Session(arm, options.controller, scene, objects)
    return Page(
        session,
        options.robot,
        port=options.port,
        show=options.show,
        folder=options.out,
    )


def _task(options: argparse.Namespace, rest: list[str]) -> Any:
    """A page with a policy or kept episodes in a task.

    Raises:
        ValueError: The options contradict each other, or there is no such episode.
    """
    from rmp_mjx_envs import episode_page, view, watch

    where = options.port, options.out
    if options.watch and options.run is not None:
        return watch.page(["--run", options.run, *rest], *where, options.leash)
    if options.run is not None and not options.worst:
        return view.page(["--run", options.run, *rest], *where)
    if rest or (options.run is not None and options.episode is not None):
        raise ValueError("give --episode FILE, or --run RUN --worst, and no other flag")
    episode = options.episode
    files = episode_page.of_run(options.run) if episode is None else [episode]
    return episode_page.EpisodePage(files, *where)


def _in_task(task: str, robot: str) -> Any:
    """An arm and the objects of a task.

    Raises:
        ValueError: There is no such task.
    """
    import rmp_mjx_envs

    known = rmp_mjx_envs.names()
    if task not in known and ":" not in task:
        raise ValueError(unknown("scene", task, [*SCENES, *known]))
    return rmp_mjx_envs.live.scene(task, robot)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m rmp_mjx.viewer",
        description="Show in the browser what the tree thinks.",
        epilog=f"Names of arms here: {', '.join(robots())}.",
    )
    add = parser.add_argument
    add(
        "--run",
        help="run, policy file or pretrained/NAME: play it in its task. "
        "Flags of eval.py may follow: --deterministic --obstacles 2",
    )
    add(
        "--teleoperate",
        metavar="TASK",
        help="drive a task yourself, and record demonstrations for train.py --demos. "
        "Flags of the task may follow: --controller vices",
    )
    add("--worst", action="store_true", help="of a run: its worst episodes instead")
    add("--watch", action="store_true", help="a run: follow its training")
    add("--leash", action="store_true", help=argparse.SUPPRESS)
    add("--episode", type=Path, help="an episode that eval.py kept in RUN/worst")
    add("--robot", default="jaco2", help="name of an arm, or path of its model")
    add(
        "--controller",
        nargs="+",
        default=["rmp_vices"],
        choices=list(CONTROLLERS),
        help="who drives; an arm for each",
    )
    add(
        "--scene",
        default="sphere",
        help=f"things to begin with: {', '.join(SCENES)}; or a task, for its objects: "
        "door, push",
    )
    add("--show", default="meshes", choices=["meshes", "capsules"], help="the arm as")
    add("--port", type=int, default=8080, help="the next free one if it is taken")
    add("--seconds", type=float, help="end after so long; default: never")
    add("--out", type=Path, default=Path("runs/viewer"), help="folder of recordings")
    return parser


def _say(console: Console, line: str) -> None:
    console.print(line, markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    sys.exit(main())

"""The command: load an arm, open the page, run until interrupted."""

import argparse
import contextlib
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from rmp_mjx import runtime
from rmp_mjx.fields import arguments
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
    from rmp_mjx.viewer.page import Page
    from rmp_mjx.viewer.session import Session

    try:
        options, rest = _parser().parse_known_args(arguments(args))
        if options.run is not None or options.episode is not None:
            with contextlib.suppress(KeyboardInterrupt):
                return _task(options, rest)
            return 0
        if options.teleoperate is not None:
            from rmp_mjx_envs import teleoperate

            place = options.port, options.out, options.seconds
            with contextlib.suppress(KeyboardInterrupt):
                return teleoperate.main(options.teleoperate, rest, *place)
            return 0
        if options.worst or options.watch:
            raise ValueError("--worst and --watch need --run RUN")
        if rest:
            raise ValueError(f"unknown: {' '.join(rest)}. See --help")
        runtime.configure()
        session = Session(Robot.load(options.robot), options.controller, options.scene)
        page = Page(
            session,
            options.robot,
            port=options.port,
            show=options.show,
            folder=options.out,
        )
    except (ValueError, OSError) as error:
        _say(Console(stderr=True), f"error: {error}")
        return 2
    _say(Console(), f"open {page.url}, end with Ctrl+C")
    with contextlib.suppress(KeyboardInterrupt):
        page.run(options.seconds)
    return 0


def _task(options: argparse.Namespace, rest: list[str]) -> int:
    """Show a policy or kept episodes in a task; returns the exit code.

    Raises:
        ValueError: The options contradict each other, or there is no such episode.
    """
    from rmp_mjx_envs import episode_page, view, watch

    where = options.port, options.out, options.seconds
    if options.watch and options.run is not None:
        return watch.main(["--run", options.run, *rest], *where, options.leash)
    if options.run is not None and not options.worst:
        return view.main(["--run", options.run, *rest], *where)
    if rest or (options.run is not None and options.episode is not None):
        raise ValueError("give --episode FILE, or --run RUN --worst, and no other flag")
    if options.episode is not None:
        return episode_page.main([options.episode], *where)
    return episode_page.main(episode_page.of_run(options.run), *where)


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
    add("--scene", default="sphere", choices=list(SCENES), help="things to begin with")
    add("--show", default="meshes", choices=["meshes", "capsules"], help="the arm as")
    add("--port", type=int, default=8080, help="the next free one if it is taken")
    add("--seconds", type=float, help="end after so long; default: never")
    add("--out", type=Path, default=Path("runs/viewer"), help="folder of recordings")
    return parser


def _say(console: Console, line: str) -> None:
    console.print(line, markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    sys.exit(main())

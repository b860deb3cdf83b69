"""Where the end effector is: a site of the file, or a new one on a body."""

from __future__ import annotations

import itertools

import mujoco

from rmp_mjx.names import unknown
from rmp_mjx.robot.errors import Numbers, RobotError, vector


def end_effector(
    spec: mujoco.MjSpec,
    site: str | None,
    body: str | None,
    offset: Numbers,
) -> str:
    """The end-effector site's name; the site is added where a body is named instead.

    Args:
        spec: The file.
        site: Name of a site, or None.
        body: Name of a body that the end effector is on, or None.
        offset: Its position in the body's frame, (3,) [m].

    Raises:
        RobotError: Unknown name, or not exactly one of site and body.
    """
    sites = sorted(s.name for s in spec.sites if s.name)
    bodies = [b.name for b in spec.bodies if b.name != "world"]
    if (site is None) == (body is None):
        raise RobotError(
            "name the end effector, by site= or by body= (one of them); "
            f"sites: {', '.join(sites) or 'none'}; bodies: {', '.join(bodies)}"
        )
    position = vector("offset", offset, 3)
    if site is not None:
        if position.any():
            raise RobotError("offset= goes with body=: a site has a place of its own")
        if not sites:
            raise RobotError(
                f"unknown site '{site}': the file has no sites. Name a body instead, "
                f"body='{_outermost(spec)}'; bodies: {', '.join(bodies)}"
            )
        if site not in sites:
            raise RobotError(
                f"{unknown('site', site, sites)} Or name a body, "
                f"body='{_outermost(spec)}'; bodies: {', '.join(bodies)}"
            )
        return site
    if body not in bodies:
        raise RobotError(unknown("body", str(body), bodies))
    names = itertools.chain(
        ["end_effector"], (f"end_effector_{k}" for k in itertools.count(1))
    )
    name = next(name for name in names if name not in sites)
    spec.body(body).add_site(name=name, pos=position, quat=[1.0, 0.0, 0.0, 0.0])
    return name


def _outermost(spec: mujoco.MjSpec) -> str:
    """Name of the body with the most bodies between it and the world."""

    def depth(body: mujoco.MjsBody) -> int:
        count = 0
        while body.name != "world":
            count, body = count + 1, body.parent
        return count

    return max(spec.bodies, key=depth).name

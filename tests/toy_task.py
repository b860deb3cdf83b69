"""The counting toy as a task that the command line knows by its name."""

import dataclasses
from typing import ClassVar, Literal

import envs
from envs.options import Options
from tests.training import toys


@dataclasses.dataclass(frozen=True)
class CounterOptions(Options):
    """Options of counting."""

    env: ClassVar[str] = "counter"
    variant: Literal["light", "heavy"] = "light"
    """Which counter."""


class Counter:
    """Makes the toy in place of an arm; the engine's name is what was asked for."""

    Options = CounterOptions

    def __new__(cls, options, robot=None, controller=None):
        return toys.Counter(engine=options.physics)


def register(monkeypatch):
    """Make the toy known; returns the options that tasks are made with from then on."""
    made, make = [], envs.make

    def noted(options, *rest):
        made.append(options)
        return make(options, *rest)

    monkeypatch.setitem(envs.ENVS, "counter", Counter)
    monkeypatch.setattr(envs, "make", noted)
    return made

"""The things in the arm's way: gizmos in the scene, and the panel that changes them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh
import viser

from rmp_mjx.viewer.drawing import capsule_mesh
from rmp_mjx.viewer.stage import Stage
from rmp_mjx.viewer.things import SCENES, SIZES, SLOTS, Thing

NEW = (0.45, 0.0, 0.5)
"""Where a new thing appears [m]."""
_COLOR = (70, 150, 110)


class ThingPanel:
    """Adds, drags, sizes, moves and removes things."""

    def __init__(self, page: Stage):
        """Make the controls in the tab that is open."""
        self.page, gui = page, page.server.gui
        self.handles: list[Any] = []
        self._shown: list[tuple[str, tuple[float, ...]]] = []
        self._held: set[int] = set()
        self.scene = gui.add_dropdown(
            "Scene", list(SCENES), initial_value=page.session.scene
        )
        there = page.session.floor is not None
        self.floor = gui.add_checkbox("Floor", there)
        self.add = {kind: gui.add_button(f"Add {kind}") for kind in SLOTS}
        self.which = gui.add_slider("Thing number", 1, sum(SLOTS.values()), 1, 1)
        self.size = gui.add_vector3(
            "Size", np.full(3, 0.06), min=np.full(3, 0.01), step=0.01
        )
        self.velocity = gui.add_vector3("Velocity", np.zeros(3), step=0.05)
        self.apply = gui.add_button("Set size and velocity")
        self.remove = gui.add_button("Remove it")
        self._wire()

    def _wire(self) -> None:
        page = self.page
        session = page.session
        self.scene.on_update(lambda _: page.order(self._load))
        self.floor.on_update(
            lambda _: page.order(lambda: session.set_floor(self.floor.value))
        )
        for kind, button in self.add.items():
            button.on_click(lambda _, kind=kind: page.order(lambda: self._add(kind)))
        self.which.on_update(lambda _: page.order(self._fill))
        self.apply.on_click(lambda _: page.order(self._apply))
        self.remove.on_click(lambda _: page.order(self._remove))

    def _load(self) -> None:
        self.page.session.load(self.scene.value)

    def _add(self, kind: str) -> None:
        session = self.page.session
        session.set_things([*session.things, Thing(kind, NEW, SIZES[kind])])
        self.which.value = len(session.things)
        self._fill()

    def _fill(self) -> None:
        """Show the numbers of the chosen thing."""
        thing = self._chosen()
        self.size.value = np.array([*thing.size, *(0.06,) * 3][:3])
        self.velocity.value = np.array(thing.velocity)

    def _chosen(self) -> Thing:
        things = self.page.session.things
        if self.which.value > len(things):
            raise ValueError(f"there is no thing number {self.which.value}")
        return things[self.which.value - 1]

    def _apply(self) -> None:
        thing = self._chosen()
        size = tuple(map(float, self.size.value[: len(thing.size)]))
        velocity = tuple(map(float, self.velocity.value))
        new = dataclasses.replace(thing, size=size, velocity=velocity, place=None)
        self._replace(self.which.value - 1, new)

    def _remove(self) -> None:
        self._chosen()
        things = list(self.page.session.things)
        del things[self.which.value - 1]
        self.page.session.set_things(things)

    def _replace(self, k: int, thing: Thing) -> None:
        things = list(self.page.session.things)
        if k < len(things):
            things[k] = thing
            self.page.session.set_things(things)

    def show(self, things: Sequence[Thing]) -> None:
        """Draw the things; a gizmo that is being dragged stays with its user."""
        kinds = [(thing.kind, thing.size) for thing in things]
        if kinds != self._shown:
            for handle in self.handles:
                handle.remove()
            self._held.clear()
            self.handles = [self._draw(k, thing) for k, thing in enumerate(things)]
            self._shown = kinds
        for k, (handle, thing) in enumerate(zip(self.handles, things, strict=True)):
            if k not in self._held:
                handle.position, handle.wxyz = thing.position, thing.wxyz

    def _draw(self, k: int, thing: Thing) -> Any:
        scene = self.page.server.scene
        handle = scene.add_transform_controls(
            f"/things/{k}",
            scale=0.14,
            disable_rotations=thing.kind == "sphere",
            position=np.array(thing.position),
            wxyz=np.array(thing.wxyz),
        )
        mesh = _mesh(thing)
        scene.add_mesh_simple(
            f"/things/{k}/body",
            np.asarray(mesh.vertices),
            np.asarray(mesh.faces),
            color=_COLOR,
            opacity=0.75,
            flat_shading=thing.kind == "box",
        )

        @handle.on_update
        def _(event: viser.TransformControlsEvent) -> None:
            (self._held.discard if event.phase == "end" else self._held.add)(k)
            place = np.array(handle.position), np.array(handle.wxyz)
            self.page.order(lambda: self._put(k, *place))

        return handle

    def _put(self, k: int, position: np.ndarray, wxyz: np.ndarray) -> None:
        things = self.page.session.things
        if k < len(things):
            self._replace(k, things[k].put(position, wxyz))


def _mesh(thing: Thing) -> trimesh.Trimesh:
    if thing.kind == "box":
        return trimesh.creation.box(extents=2.0 * np.array(thing.size))
    half = thing.size[1] if thing.kind == "capsule" else 0.0
    return capsule_mesh(np.array([[0, 0, -half], [0, 0, half]]), thing.size[0])

"""The page: draws a session in the browser and takes its users' orders."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
import viser

from rmp_mjx.viewer import drawing, film, physics, texts
from rmp_mjx.viewer.charts import Charts
from rmp_mjx.viewer.dial_panel import DialPanel
from rmp_mjx.viewer.drive_panel import DrivePanel
from rmp_mjx.viewer.session import Frame, Session
from rmp_mjx.viewer.stage import Stage
from rmp_mjx.viewer.thing_panel import ThingPanel
from rmp_mjx.viewer.tree_panel import TreePanel

_SLOW = 6
"""Status and charts change with every so many pictures."""
EYE, MIDDLE = (1.05, -0.95, 0.95), (0.3, 0.05, 0.4)
"""Where the camera is at first, and what it looks at [m]."""
GHOSTS = ((235, 120, 30), (60, 160, 80), (150, 80, 190))
"""Colors of the second arm and the others."""


class Page(Stage):
    """The scene and the panels of a session."""

    def __init__(
        self,
        session: Session,
        robot: str,
        *,
        port: int = 8080,
        show: str = "meshes",
        folder: Path = Path("runs/viewer"),
    ):
        """Start the server.

        Args:
            session: What is shown.
            robot: Name of its arm.
            port: Where the page is; the next free one if it is taken.
            show: `meshes` or `capsules`.
            folder: Where recordings go.
        """
        self.show = show
        super().__init__(session, robot, port, folder)
        self.pictures = 0
        self._data = mujoco.MjData(session.model)
        self._dragging = False
        self._shown_target = session.target
        self._build()

    def tick(self, elapsed: float) -> None:
        """Renew the spring's force, then simulate and draw."""
        self.drive.spring.tick()
        super().tick(elapsed)

    def refuse(self, error: ValueError) -> None:
        """Say why an order is not obeyed."""
        self.drive.say(f"**{error}**")

    def draw(self, frame: Frame) -> None:
        """Show a frame in all browsers."""
        self._fit_arms(len(frame.arms))
        insight = self.session.think(frame)
        with self.server.atomic():
            for bodies, arm in zip(self._arms, frame.arms, strict=True):
                self._data.qpos[:] = [*arm.q, *arm.rest[0]]
                mujoco.mj_kinematics(self.session.model, self._data)
                bodies.move(self._data)
            self.tree.show(insight, frame.controllers[0])
            self.things.show(frame.things)
            if not self._dragging and frame.target is not self._shown_target:
                self.target.position, self.target.wxyz = frame.target
                self._shown_target = frame.target
            if self.pictures % _SLOW == 0:
                self.drive.say(texts.status(frame, self.player.pace))
            if self.pictures % _SLOW == _SLOW // 2:
                with self._chart_tab:
                    self.charts.show(list(self.session.history))
        self.drive.clock.show()
        self.pictures += 1

    def render(self, frames: Sequence[Frame]) -> list[np.ndarray]:
        """Frames drawn by MuJoCo: arms and things, seen as at first."""
        model = film.lit(self.session.model)
        things, arm = mujoco.MjData(model), mujoco.MjData(model)
        seen, drawn = film.camera(np.array(EYE), np.array(MIDDLE)), []
        look, hand = mujoco.MjvOption(), mujoco.MjvPerturb()
        movable = int(mujoco.mjtCatBit.mjCAT_DYNAMIC)
        physics.place(model, arm, ())
        with mujoco.Renderer(model, *film.SIZE) as renderer:
            for frame in frames:
                physics.resize(model, frame.things, self.session.floor)
                physics.place(model, things, frame.things)
                things.qpos[:] = [*frame.arms[0].q, *frame.arms[0].rest[0]]
                mujoco.mj_forward(model, things)
                renderer.update_scene(things, seen)
                for other in frame.arms[1:]:
                    arm.qpos[:] = [*other.q, *other.rest[0]]
                    mujoco.mj_forward(model, arm)
                    mujoco.mjv_addGeoms(model, arm, look, hand, movable, renderer.scene)
                drawn.append(renderer.render().copy())
        return drawn

    def _build(self) -> None:
        """Make the scene and the panels."""
        server = self.server
        server.initial_camera.position = EYE
        server.initial_camera.look_at = MIDDLE
        server.scene.add_grid(
            "/grid",
            4.0,
            4.0,
            cell_size=0.1,
            section_size=0.5,
            position=(0.0, 0.0, self.session.objects.floor),
        )
        self._arms: list[drawing.Bodies] = []
        self._fit_arms(1)
        robot, model = self.session.robot, self.session.model
        thoughts = drawing.Thoughts(server.scene, robot, model, "/arm0")
        position, wxyz = self.session.target
        self.target = server.scene.add_transform_controls(
            "/target", scale=0.18, position=position, wxyz=wxyz, depth_test=False
        )
        server.scene.add_icosphere("/target/ball", 0.02, (26, 110, 190))

        @self.target.on_update
        def _(event: viser.TransformControlsEvent) -> None:
            self._dragging = event.phase != "end"
            place = np.array(self.target.position), np.array(self.target.wxyz)
            self.order(lambda: self._aim(place))

        tabs = server.gui.add_tab_group()
        with tabs.add_tab("Drive"):
            self.drive = DrivePanel(self)
        with tabs.add_tab("Things"):
            self.things = ThingPanel(self)
        with tabs.add_tab("Tree"):
            self.tree = TreePanel(self, thoughts)
        with tabs.add_tab("Leaves"):
            self.dials = DialPanel(self)
        self._chart_tab = tabs.add_tab("Charts")
        self.charts = Charts(server.gui, self.session.robot)

    def _aim(self, place: tuple[np.ndarray, np.ndarray]) -> None:
        self.session.target = place
        shown = self.player.shown
        if shown is not None and self.player.paused:
            self.player.shown = shown._replace(target=place)

    def _fit_arms(self, count: int) -> None:
        """As many arms in the scene as in the frame."""
        model, robot = self.session.model, self.session.robot
        while len(self._arms) > count:
            self._arms.pop().remove()
        while len(self._arms) < count:
            k = len(self._arms)
            tint = GHOSTS[(k - 1) % len(GHOSTS)] if k else None
            geoms = [g for g in range(model.ngeom) if not physics.is_thing(model, g)]
            parts = drawing.mesh_parts(model, geoms, tint)
            if self.show == "capsules":
                names = self.session.objects.geoms
                own = {int(model.geom(name).bodyid[0]) for name in names}
                beside = [part for part in parts if part[0] in own]
                parts = drawing.capsule_parts(robot, model, tint) + beside
            opacity = 0.45 if k else None
            self._arms.append(
                drawing.Bodies(self.server.scene, model, f"/arm{k}", parts, opacity)
            )

"""The arm, and what the tree thinks, as nodes of a viser scene."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
import trimesh
import viser
from mjviser.conversions import create_primitive_mesh, mujoco_mesh_to_trimesh

from rmp_mjx.robot import Robot
from rmp_mjx.robot.kinematics import base_point, forward_kinematics
from rmp_mjx.viewer.insight import Insight

COLORS = {
    "collision": (215, 48, 39),
    "self_collision": (244, 140, 60),
    "position": (26, 110, 190),
    "orientation": (110, 190, 240),
    "joint_limit": (122, 70, 170),
    "posture": (90, 140, 90),
}
"""Of the tree's branches."""
OTHER = (110, 110, 110)
"""Of a branch that is none of these."""
WEIGHTS = (1e-3, 1e3)
"""The weights of the first and the last color of a control point."""
LONGEST = 0.35
"""Length that the arrow of a very strong pull approaches [m]."""
_HALFWAY = 10.0
"""Acceleration whose arrow has half of that length [m/s^2]."""
_RAMP = np.array([[170, 175, 180], [254, 217, 118], [253, 141, 60], [200, 10, 30]])
_OPACITY = 0.45
"""Of the control points: the arm below them is seen."""
_VISIBLE_GROUPS = 3
"""MuJoCo shows the geoms of the groups before this one."""


class Bodies:
    """The moving bodies of a model, each with its meshes."""

    def __init__(
        self,
        scene: viser.SceneApi,
        model: mujoco.MjModel,
        root: str,
        parts: Iterable[tuple[int, trimesh.Trimesh, Any]],
        opacity: float | None = None,
    ):
        """Make the nodes.

        Args:
            scene: Where they go.
            model: The model.
            root: Name of the node above them.
            parts: Body, mesh in the body's frame, and color of each part.
            opacity: None for opaque.
        """
        self._frames: dict[int, viser.FrameHandle] = {}
        self._model, self._root = model, scene.add_frame(root, show_axes=False)
        for k, (body, mesh, color) in enumerate(parts):
            name = f"{root}/{body}"
            if body not in self._frames:
                self._frames[body] = scene.add_frame(name, show_axes=False)
            scene.add_mesh_simple(
                f"{name}/{k}",
                np.asarray(mesh.vertices),
                np.asarray(mesh.faces),
                color=color,
                opacity=opacity,
                cast_shadow=opacity is None,
            )

    def move(self, data: mujoco.MjData) -> None:
        """Put the bodies where they are in a state with kinematics."""
        for body, frame in self._frames.items():
            frame.position = data.xpos[body]
            frame.wxyz = data.xquat[body]

    def remove(self) -> None:
        """Take them out of the scene."""
        self._root.remove()


def mesh_parts(
    model: mujoco.MjModel, geoms: Iterable[int], tint: Any = None
) -> list[tuple[int, trimesh.Trimesh, Any]]:
    """Geoms as parts of `Bodies`.

    Args:
        model: The model.
        geoms: Their ids. Those of hidden groups are left out if others are visible,
            and those that touch where a body has others for the eye alone.
        tint: One color for all; None: the model's.
    """
    geoms = list(geoms)
    shown = [g for g in geoms if model.geom_group[g] < _VISIBLE_GROUPS] or geoms
    touching = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    adorned = {model.geom_bodyid[g] for g in shown if not touching[g]}
    shown = [g for g in shown if not (touching[g] and model.geom_bodyid[g] in adorned)]
    parts = []
    for geom in shown:
        mesh_geom = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH
        make = mujoco_mesh_to_trimesh if mesh_geom else create_primitive_mesh
        mesh = make(model, geom)
        pose = np.eye(4)
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        pose[:3, :3], pose[:3, 3] = rotation.reshape(3, 3), model.geom_pos[geom]
        mesh.apply_transform(pose)
        material = model.geom_matid[geom]
        rgba = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
        color = tuple((255 * rgba[:3]).astype(int)) if tint is None else tint
        parts.append((int(model.geom_bodyid[geom]), mesh, color))
    return parts


def capsule_parts(
    robot: Robot, model: mujoco.MjModel, tint: Any = None
) -> list[tuple[int, trimesh.Trimesh, Any]]:
    """The link capsules that the controllers know, as parts of `Bodies`."""
    q = jnp.asarray(robot.q_ref)
    p, R = (np.asarray(x, float) for x in forward_kinematics(robot, q))
    origin = np.asarray(base_point(robot), float)
    data = mujoco.MjData(model)
    data.qpos[: robot.n] = robot.q_ref
    mujoco.mj_kinematics(model, data)
    parts, caps = [], robot.capsules
    for start, end, radius, joint in zip(
        caps.start, caps.end, caps.radius, caps.segment, strict=True
    ):
        ends = np.array([start, end], float)
        body = 0
        if joint >= 0:
            ends = ends @ R[..., joint].T + p[:, joint] + origin
            body = int(model.jnt_bodyid[model.joint(robot.joint_names[joint]).id])
        ends = (ends - data.xpos[body]) @ data.xmat[body].reshape(3, 3)
        parts.append((body, capsule_mesh(ends, float(radius)), tint or (70, 80, 95)))
    return parts


def capsule_mesh(ends: np.ndarray, radius: float) -> trimesh.Trimesh:
    """A capsule between two points, (2, 3) [m]."""
    length = float(np.linalg.norm(ends[1] - ends[0]))
    if length < 1e-6:
        mesh = trimesh.creation.icosphere(subdivisions=2, radius=radius)
        return mesh.apply_translation(ends[0])
    mesh = trimesh.creation.capsule(height=length, radius=radius, count=[16, 16])
    turn = trimesh.geometry.align_vectors([0, 0, 1], (ends[1] - ends[0]) / length)
    if abs(mesh.bounds[0][2] + mesh.bounds[1][2]) > 1e-6:  # it begins at the origin
        mesh.apply_translation([0, 0, -length / 2])
    mesh.apply_transform(turn)
    return mesh.apply_translation(ends.mean(axis=0))


def weight_colors(weight: np.ndarray) -> np.ndarray:
    """Colors of control points by their weights, (p, 3) uint8, spaced by decades."""
    low, high = np.log10(WEIGHTS)
    decades = np.log10(np.maximum(weight, WEIGHTS[0]))
    at = np.clip((decades - low) / (high - low), 0.0, 1.0) * (len(_RAMP) - 1)
    ramp = [np.interp(at, range(len(_RAMP)), _RAMP[:, i]) for i in range(3)]
    return np.stack(ramp, axis=1).astype(np.uint8)


def arrow(start: np.ndarray, pull: np.ndarray) -> np.ndarray:
    """Ends of the arrow of a pull, (2, 3) [m]; strong ones grow ever more slowly."""
    size = float(np.linalg.norm(pull))
    length = LONGEST * size / (size + _HALFWAY)
    return np.stack([start, start + pull * (length / max(size, 1e-9))])


class Thoughts:
    """Control points, the gap and the pulls, in the scene."""

    def __init__(
        self,
        scene: viser.SceneApi,
        robot: Robot,
        model: mujoco.MjModel,
        root: str,
        prefix: str = "",
    ):
        """Make the nodes.

        Args:
            scene: Where they go.
            robot: The arm.
            model: The model that it is in.
            root: The control points hang on the bodies below this node.
            prefix: Of the arm's names in the model.
        """
        self._scene = scene
        ball = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
        radius = 1.04 * np.asarray(robot.points.radius, float)  # outside of the arm
        carried = np.array(robot.points.body)
        self._points: list[tuple[np.ndarray, viser.BatchedMeshHandle]] = []
        for name in dict.fromkeys(robot.points.body):
            here = np.flatnonzero(carried == name)
            handle = scene.add_batched_meshes_simple(
                f"{root}/{model.body(prefix + name).id}/points",
                np.asarray(ball.vertices),
                np.asarray(ball.faces),
                np.tile([1.0, 0.0, 0.0, 0.0], (len(here), 1)),
                np.asarray(robot.points.body_offset, float)[here],
                batched_scales=radius[here],
                batched_colors=np.zeros((len(here), 3), np.uint8),
                opacity=_OPACITY,
                lod="off",
                cast_shadow=False,
            )
            self._points.append((here, handle))
        self.gap = scene.add_line_segments(
            "/gap", np.zeros((1, 2, 3)), (20, 20, 20), thickness=0.006
        )
        self.label = scene.add_label(
            "/gap_label", "", anchor="bottom-left", font_screen_scale=0.8
        )
        self.arrows: viser.ArrowsHandle | None = None
        self.show_points = self.show_gap = self.show_pulls = True

    @property
    def wanted(self) -> bool:
        """Whether anything of it is to be drawn."""
        return self.show_points or self.show_gap or self.show_pulls

    def hide(self) -> None:
        """Draw nothing."""
        nodes = [self.gap, self.label, *(handle for _, handle in self._points)]
        for node in [*nodes, self.arrows]:
            if node is not None and node.visible:
                node.visible = False

    def show(self, insight: Insight) -> None:
        """Draw what the tree thinks now."""
        colors = weight_colors(np.asarray(insight.weight))
        for here, handle in self._points:
            handle.visible = self.show_points
            if self.show_points:
                handle.batched_colors = colors[here]
        near = bool(self.show_gap and insight.clearance < 1.0)
        self.gap.visible = self.label.visible = near
        if near:
            ends = np.asarray(insight.gap, np.float32)
            self.gap.points = ends[None]
            self.label.position = ends.mean(axis=0)
            self.label.text = f"{1e3 * float(insight.clearance):.0f} mm"
        names = list(insight.pull)
        starts, pulls = insight.start, insight.pull
        ends = np.stack(
            [arrow(np.asarray(starts[n]), np.asarray(pulls[n])) for n in names]
        )
        if self.arrows is None:
            self.arrows = self._scene.add_arrows(
                "/pulls",
                ends,
                np.array([COLORS.get(n, OTHER) for n in names]),
                shaft_radius=0.006,
                head_radius=0.015,
                head_length=0.03,
            )
        self.arrows.visible = self.show_pulls
        if self.show_pulls:
            self.arrows.points = ends.astype(np.float32)
            self.arrows.colors = np.array(
                [COLORS.get(n, OTHER) for n in names], np.uint8
            )

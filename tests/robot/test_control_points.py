"""Control points and link capsules against MuJoCo's geoms."""

import warnings

import mujoco
import numpy as np
import pytest

from rmp_mjx import Robot, RobotWarning
from rmp_mjx.robot.configurations import capsule_ends
from rmp_mjx.robot.control_points import hull_corners
from rmp_mjx.robot.enclose import distance_to_segment
from tests.oracles import BENT
from tests.robot.test_model import GRIPPER, ODD


def _in_world(model, data, robot):
    """Centre and radius of every control point at data's configuration."""
    for body, offset, radius in robot.control_points:
        b = model.body(body).id
        yield data.xpos[b] + data.xmat[b].reshape(3, 3) @ offset, radius


def test_points_lie_inside_their_capsules(robot):
    """Each sphere is a ball of the geom: same radius, centre on the axis."""
    model = robot.mj_model
    data = mujoco.MjData(model)
    data.qpos[:] = np.random.default_rng(0).uniform(-3, 3, 7)
    mujoco.mj_kinematics(model, data)
    for (body, _, radius), (x, _) in zip(
        robot.control_points, _in_world(model, data, robot), strict=True
    ):
        depths = []
        for g in np.flatnonzero(model.geom_bodyid == model.body(body).id):
            local = data.geom_xmat[g].reshape(3, 3).T @ (x - data.geom_xpos[g])
            capsule = model.geom_type[g] == mujoco.mjtGeom.mjGEOM_CAPSULE
            half = model.geom_size[g, 1] if capsule else 0.0
            local[2] -= np.clip(local[2], -half, half)
            depths.append(model.geom_size[g, 0] - np.linalg.norm(local) - radius)
        # 1e-6 m: rounding of six digits in the file's rotations.
        assert max(depths) > -1e-6


def test_about_64_points_cover_every_moving_link(robot):
    assert 56 <= len(robot.control_points) <= 72
    links = {f"link_{i}" for i in range(1, 8)}
    assert links | {"fingers"} == set(robot.points.body)
    assert set(robot.points.segment) == set(range(7))


def test_the_hand_is_what_the_last_joint_moves(robot):
    """Of an arm with a single joint that is all of it."""
    np.testing.assert_array_equal(
        robot.points.hand, [k == 6 for k in robot.points.segment]
    )
    one = """<mujoco><worldbody><body><joint name="a" range="-1 1"/>
    <geom name="one" type="capsule" size=".05 .1"/><site name="tip"/></body></worldbody>
    <actuator><motor joint="a" ctrlrange="-5 5"/></actuator></mujoco>"""
    assert Robot.from_mjcf(one, site="tip").points.hand.all()


def test_no_gap_between_neighbours_is_wider_than_the_spacing(robot):
    """Along each capsule, ends included: so their union covers it."""
    for c, k in enumerate(robot.capsules.segment):
        if k < 0:
            continue
        start, end = robot.capsules.start[c], robot.capsules.end[c]
        offsets = robot.points.offset[np.array(robot.points.segment) == k]
        along = end - start
        length = float(np.linalg.norm(along))
        if length < 1e-9:
            continue
        s = (offsets - start) @ along / length
        off_axis = np.linalg.norm(offsets - start - s[:, None] * along / length, axis=1)
        s = np.sort(s[(off_axis < 1e-9) & (s > -1e-9) & (s < length + 1e-9)])
        np.testing.assert_allclose([s[0], s[-1]], [0.0, length], atol=1e-9)
        assert np.diff(s).max() <= 0.0135 + 1e-9


def test_sampling_is_deterministic_and_denser_with_smaller_spacing(robot):
    again, dense = Robot.load(), Robot.load(spacing=0.005)
    np.testing.assert_array_equal(again.points.offset, robot.points.offset)
    assert again.capsules.pairs == robot.capsules.pairs
    assert len(dense.control_points) > 2 * len(robot.control_points)
    # Ends stay: a denser sampling never uncovers what a sparser one covered.
    for radius in np.unique(robot.points.radius):
        assert radius in dense.points.radius


@pytest.mark.parametrize("text", [ODD, GRIPPER], ids=["odd", "gripper"])
def test_capsules_enclose_geoms_of_any_shape(text):
    """No corner of a geom's bounding box (nor the geom) sticks out of its capsule."""
    robot = Robot.from_mjcf(text, site="tip")
    model = robot.mj_model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    moving = [c for c, k in enumerate(robot.capsules.segment) if k >= 0]
    assert len(moving) == len(robot.capsules.geom) - sum(
        k < 0 for k in robot.capsules.segment
    )
    for c in moving:
        g = model.geom(robot.capsules.geom[c]).id
        body = model.body(int(model.geom_bodyid[g])).name
        balls = [
            ball
            for ball, name in zip(
                _in_world(model, data, robot), robot.points.body, strict=True
            )
            if name == body
        ]
        for corner in _surface(model, data, g):
            gaps = [np.linalg.norm(corner - x) - radius for x, radius in balls]
            # Between two balls of a row the surface dips by spacing^2 / (8 radius).
            assert min(gaps) < 1e-6 + 0.0135**2 / (8 * robot.capsules.radius[c])


@pytest.mark.parametrize("text", [ODD, GRIPPER, BENT], ids=["odd", "gripper", "bent"])
def test_every_geom_is_inside_its_capsules(text):
    """Also the fixed base's, in five configurations. 1e-6 m: the arm's text has six
    digits."""
    robot = Robot.from_mjcf(text, site="tip")
    model, rng, seen = robot.mj_model, np.random.default_rng(0), set()
    data = mujoco.MjData(model)
    for q in robot.q_ref + rng.uniform(-1, 1, (5, robot.n)):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        ends = capsule_ends(robot, q[None], range(len(robot.capsules.geom)))
        for g in range(model.ngeom):
            name = model.geom(g).name
            own = [c for c, geom in enumerate(robot.capsules.geom) if geom == name]
            seen |= set(own)
            gaps = [
                distance_to_segment(_surface(model, data, g), *(x[0] for x in ends[c]))
                - robot.capsules.radius[c]
                for c in own
            ]
            assert np.min(gaps, axis=0).max() < 1e-6
    assert len(seen) == len(robot.capsules.geom)


def _rod(length, first="", second="", base=""):
    """Two links, each with a capsule of this length, on a base with a ball."""
    rod = f'type="capsule" fromto="0 0 .1 {length} 0 .1" size=".02"'
    return f"""<mujoco><worldbody><body name="base">
    <geom name="base" size=".05" {base}/>
    <body><joint name="a" axis="0 0 1" range="-2 2"/><geom name="one" {rod} {first}/>
    <body><joint name="b" axis="0 1 0" range="-2 2"/><geom name="two" {rod} {second}/>
    <site name="tip"/></body></body></body></worldbody><actuator>
    <motor joint="a" ctrlrange="-9 9"/><motor joint="b" ctrlrange="-9 9"/></actuator>
    </mujoco>"""


@pytest.mark.parametrize("count", range(1, 12))
def test_a_length_of_whole_spacings_has_a_point_at_each(count):
    """Whether the quotient is rounded up or down; and the next point a little later."""
    for length, more in ((count * 0.05, 0), (count * 0.05 + 1e-5, 1)):
        points = Robot.from_mjcf(_rod(length), site="tip", spacing=0.05).points
        each = count + 1 + more
        assert points.segment == (0,) * each + (1,) * each
        along = np.linalg.norm(points.offset[each - 1] - points.offset[0])
        np.testing.assert_allclose(along, length, atol=1e-6)


GHOST, ONE_WAY = 'contype="0" conaffinity="0"', 'contype="0"'
OTHER_WAY = 'conaffinity="0"'


@pytest.mark.parametrize(
    ("first", "second", "base", "names"),
    [
        ("", "", "", ("base", "one", "two")),
        ("", GHOST, "", ("base", "one")),
        ("", GHOST, GHOST, ("one",)),
        (GHOST, "", GHOST, ("two",)),
        (ONE_WAY, OTHER_WAY, "", ("base", "one", "two")),
        (OTHER_WAY, ONE_WAY, GHOST, ("one", "two")),
    ],
)
def test_what_collides_either_way_becomes_a_capsule(first, second, base, names):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        robot = Robot.from_mjcf(_rod(0.2, first, second, base), site="tip")
    assert robot.capsules.geom == names


def test_where_only_the_base_collides_everything_becomes_a_capsule():
    with pytest.warns(RobotWarning, match="no geom of a moving link collides"):
        robot = Robot.from_mjcf(_rod(0.2, GHOST, GHOST), site="tip")
    assert robot.capsules.geom == ("base", "one", "two")


SHAPES = """<mujoco><asset>
<mesh name="first" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/>
<mesh name="second" vertex=".1 0 0 .5 0 .1 .1 .3 0 0 0 .4 .2 .2 .5"/>
</asset><worldbody><geom type="box" size=".1 .2 .3"/>
<geom type="ellipsoid" size=".3 .1 .2"/><geom type="cylinder" size=".2 .4"/>
<geom type="mesh" mesh="second"/></worldbody></mujoco>"""


def test_corners_support_a_geom_from_every_side():
    """A box and a mesh exactly, a cylinder up to the corners of a polygon of 32 sides;
    an ellipsoid has the corners of its box. 1e-6: meshes are in float32."""
    model, rng = mujoco.MjModel.from_xml_string(SHAPES), np.random.default_rng(0)
    d = rng.normal(size=(500, 3))
    box, ellipsoid, cylinder, mesh = (hull_corners(model, g) for g in range(4))

    def support(points):
        return (d @ points.T).max(axis=1)

    sides = np.abs(d)
    np.testing.assert_allclose(support(box), sides @ [0.1, 0.2, 0.3], atol=1e-6)
    np.testing.assert_allclose(support(ellipsoid), sides @ [0.3, 0.1, 0.2], atol=1e-6)
    radial, axial = 0.2 * np.hypot(*d.T[:2]), 0.4 * sides[:, 2]
    found = support(cylinder)
    assert np.all(found > radial + axial - 1e-9)
    assert np.all(found < radial / np.cos(np.pi / 32) + axial + 1e-9)
    assert mesh.shape == (5, 3) and cylinder.shape == (2 * 32, 3)
    vertices = model.mesh_vert[model.mesh_vertadr[1] :]  # in the frame of the geom
    np.testing.assert_array_equal(mesh, vertices)


def _surface(model, data, g):
    """Points on the hull of a geom: corners of a box, rims and poles of round ones."""
    size, kind = model.geom_size[g], model.geom_type[g]
    signs = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    ring = np.array([[np.cos(t), np.sin(t)] for t in np.arange(0, 6.3, 0.3)])
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        local = signs * size
    elif kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        local = np.concatenate([np.eye(3), -np.eye(3)]) * size[0]
    else:  # the rims of a cylinder or a capsule
        local = np.concatenate(
            [
                np.column_stack([ring * size[0], np.full(len(ring), h)])
                for h in (-size[1], size[1])
            ]
        )
    return data.geom_xpos[g] + local @ data.geom_xmat[g].reshape(3, 3).T


def test_watched_pairs_are_links_that_can_touch(robot):
    """At least three joints apart; the hand can reach the base and the upper arm."""
    names = robot.capsules.geom
    pairs = {(names[far], names[near]) for far, near in robot.capsules.pairs}
    assert ("hand", "base") in pairs and ("fingers", "link_1") in pairs
    for far, near in robot.capsules.pairs:
        assert robot.capsules.segment[far] - robot.capsules.segment[near] >= 3

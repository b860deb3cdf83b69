"""The end effector: a site, or a point on a body; files, texts and specs."""

import re

import mujoco
import numpy as np
import pytest

from rmp_mjx import Robot, RobotError

CORNERS = ["0 0 0", ".1 0 0", "0 .1 0", "0 0 .1"]
FACES = ["1 3 2", "1 2 4", "1 4 3", "2 3 4"]
MESH = "\n".join([f"v {c}" for c in CORNERS] + [f"f {f}" for f in FACES])
"""A tetrahedron, as an OBJ file."""


def text(site="", meshdir="assets"):
    return f"""<mujoco model="little"><compiler meshdir="{meshdir}"/>
    <asset><mesh name="part" file="part.obj"/></asset><worldbody>
    <body name="arm" pos="0 0 .2" euler="0 0 90"><joint name="a" axis="0 0 1"/>
    <geom type="mesh" mesh="part"/>
    <body name="hand" pos=".3 0 0" euler="0 90 0"><geom size=".04"/>{site}</body>
    </body></worldbody><actuator><motor joint="a" ctrlrange="-1 1"/></actuator>
    </mujoco>"""


@pytest.fixture
def path(tmp_path):
    """A file with its mesh in a folder beside it."""
    (tmp_path / "assets").mkdir()
    (tmp_path / "assets" / "part.obj").write_text(MESH)
    (tmp_path / "arm.xml").write_text(text())
    return tmp_path / "arm.xml"


def test_a_body_with_an_offset_is_as_good_as_a_site(path):
    """The same arrays as with a site at that place; the site gets a name."""
    robot = Robot.from_mjcf(path, body="hand", offset=[0.01, 0.02, 0.1])
    assert robot.site_name == "end_effector"
    path.write_text(text('<site name="tip" pos=".01 .02 .1"/>'))
    sited = Robot.from_mjcf(path, site="tip")
    for name in ("site_offset", "site_rotation", "mass", "inertia", "offset"):
        np.testing.assert_array_equal(getattr(robot, name), getattr(sited, name))
    data = mujoco.MjData(robot.mj_model)
    mujoco.mj_forward(robot.mj_model, data)
    # base turned by 90 degrees about z, hand by 90 about y: z of the hand is world y.
    expected = [0.0 - 0.02, 0.3 + 0.1, 0.2 - 0.01]
    np.testing.assert_allclose(data.site("end_effector").xpos, expected, atol=1e-6)


def test_the_new_site_takes_a_name_that_is_free(path):
    path.write_text(text('<site name="end_effector"/>'))
    assert Robot.from_mjcf(path, body="hand").site_name == "end_effector_1"


def test_bodies_may_have_names_beyond_the_worlds(path):
    """In the alphabet; the outermost one is proposed."""
    path.write_text(text().replace('"hand"', '"zone"'))
    assert Robot.from_mjcf(path, body="zone").n == 1
    with pytest.raises(RobotError, match="body='zone'; bodies: arm, zone"):
        Robot.from_mjcf(path, site="ee")


REFUSED = {
    "no sites": (
        "",
        {"site": "ee"},
        "unknown site 'ee': the file has no sites. Name a body instead, body='hand'; "
        "bodies: arm, hand",
    ),
    "unknown body": (
        "",
        {"body": "hnd"},
        "unknown body 'hnd'; valid names: arm, hand. Did you mean 'hand'?",
    ),
    "neither": (
        '<site name="tip"/>',
        {},
        "name the end effector, by site= or by body= (one of them); sites: tip; "
        "bodies: arm, hand",
    ),
    "both": (
        '<site name="tip"/>',
        {"site": "tip", "body": "hand"},
        "name the end effector, by site= or by body= (one of them)",
    ),
    "offset of a site": (
        '<site name="tip"/>',
        {"site": "tip", "offset": [0, 0, 0.1]},
        "offset= goes with body=",
    ),
    "offset of the wrong length": (
        "",
        {"body": "hand", "offset": [0.1]},
        "offset must be 3 finite numbers, got [0.1]",
    ),
    "the world": (
        "",
        {"body": "world"},
        "unknown body 'world'; valid names: arm, hand.",
    ),
}


@pytest.mark.parametrize(
    ("site", "given", "message"), REFUSED.values(), ids=REFUSED.keys()
)
def test_a_refusal_lists_what_there_is(path, site, given, message):
    path.write_text(text(site))
    with pytest.raises(RobotError, match=re.escape(message)):
        Robot.from_mjcf(path, **given)


def test_a_spec_is_read_and_left_as_it_was(path):
    """With its mesh folder, from any working folder."""
    spec = mujoco.MjSpec.from_file(str(path))
    before = spec.to_xml()
    robot = Robot.from_mjcf(spec, body="hand")
    assert spec.to_xml() == before
    assert robot == Robot.from_mjcf(path, body="hand")
    assert robot.mj_model.nmesh == 1 and robot.name == "little"


def test_a_spec_may_hold_its_files_in_memory():
    spec = mujoco.MjSpec.from_string(text(), assets={"assets/part.obj": MESH.encode()})
    robot = Robot.from_mjcf(spec, body="hand")
    assert robot.mj_model.nmesh == 1
    scene = mujoco.MjSpec()
    scene.attach(robot.mj_spec, prefix="arm/", frame=scene.worldbody.add_frame())
    assert scene.compile().nmesh == 1


def test_a_spec_may_be_put_together_from_files(path):
    """A hand from one file on an arm from another, each with meshes of its own."""
    hand = mujoco.MjSpec.from_file(str(path))
    hand.compiler.meshdir = str(path.parent / "assets")
    for actuator in list(hand.actuators):
        hand.delete(actuator)
    for joint in list(hand.joints):
        hand.delete(joint)
    arm = mujoco.MjSpec.from_file(str(path))
    arm.attach(hand, prefix="tool/", frame=arm.body("hand").add_frame())
    robot = Robot.from_mjcf(arm, body="tool/hand")
    assert robot.mj_model.nmesh == 2 and robot.n == 1


def test_a_spec_whose_files_cannot_be_found_says_what_to_do(path):
    parent = mujoco.MjSpec()
    child = mujoco.MjSpec.from_file(str(path))
    parent.attach(child, prefix="x/", frame=parent.worldbody.add_frame())
    with pytest.raises(RobotError, match=r"absolute compiler\.meshdir before"):
        Robot.from_mjcf(parent, body="x/hand")

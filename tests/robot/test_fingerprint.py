"""One name per arm: the same everywhere, another for any other arm."""

import dataclasses
import os
import subprocess
import sys

import numpy as np
import pytest

from rmp_mjx import Robot
from rmp_mjx.robot.fingerprint import _LEFT_OUT

CHANGES = {
    "q_home": lambda robot: robot.replace(q_home=robot.q_home + 1e-6),
    "mass": lambda robot: robot.replace(mass=robot.mass * 1.001),
    "points": lambda robot: Robot.load(spacing=0.02),
    "armature": lambda robot: Robot.load(armature="robosuite"),
    "joint names": lambda robot: robot.replace(joint_names=robot.joint_names[::-1]),
    "hinge": lambda robot: robot.replace(hinge=(False,) * 7),
    "damping": lambda robot: Robot.load(compensate_passive=True),
    "capsule pairs": lambda robot: robot.replace(
        capsules=robot.capsules.replace(pairs=robot.capsules.pairs[:-1])
    ),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
def test_another_arm_has_another_fingerprint(robot, change):
    assert change(robot).fingerprint != robot.fingerprint


def test_every_field_but_the_text_counts(robot):
    left_out = {f.name for f in dataclasses.fields(robot)} & _LEFT_OUT
    assert left_out == {"mjcf", "assets", "name"}


def test_how_the_arm_is_written_does_not_count(robot):
    assert len(robot.fingerprint) == 32 and int(robot.fingerprint, 16)
    rewritten = robot.replace(mjcf="<!-- a note -->" + robot.mjcf, name="other")
    assert rewritten.fingerprint == robot.fingerprint
    last_bit = robot.replace(mass=np.nextafter(robot.mass, 9.0))
    assert last_bit.fingerprint == robot.fingerprint
    negative_zero = robot.replace(site_offset=-0.0 + robot.site_offset)
    assert negative_zero.fingerprint == robot.fingerprint


def test_it_is_the_same_in_another_process(robot):
    code = "from rmp_mjx import Robot; print(Robot.load().fingerprint)"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONHASHSEED": "7"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == robot.fingerprint


def test_a_robot_prints_on_one_line(robot):
    expected = "Robot('jaco2', 7 joints to site 'grip', 59 control points)"
    assert repr(robot) == expected

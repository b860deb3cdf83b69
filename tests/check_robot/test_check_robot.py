"""The checker says what is wrong with an arm, and nothing about a good one."""

from pathlib import Path

import numpy as np
import pytest

from rmp_mjx import Robot, RobotWarning, runtime
from rmp_mjx.check_robot.__main__ import main
from rmp_mjx.check_robot.advice import about_model, about_motion
from rmp_mjx.check_robot.certificate import ENOUGH, certify
from rmp_mjx.check_robot.coverage import coverage
from rmp_mjx.check_robot.reaches import BLOCKED, draw_reaches, reach_of, run_reaches
from rmp_mjx.robot.library import find

REACHES = 8


@pytest.fixture(scope="module")
def good():
    """An arm that ships."""
    return Robot.load("planar3", spacing=0.05)


@pytest.fixture(scope="module")
def ill(tmp_path_factory):
    """A file of the same arm: one link a mesh that sticks out, no rotors, friction."""
    corners = np.array(np.meshgrid([-0.03, 0.03], [-0.03, 0.03], [0.05, 0.2]))
    mesh = " ".join(f"{x:g}" for x in corners.reshape(3, -1).T.ravel())
    asset = f'<asset><mesh name="link2" vertex="{mesh}"/></asset><worldbody>'
    old = '<geom name="link2" fromto="0 0 .04 0 0 .21" size=".035" mass="1.4"/>'
    new = (
        '<geom name="link2" type="mesh" mesh="link2" mass="1.4"/>'
        '<geom type="mesh" mesh="link2" pos="0 0 .05" contype="0" conaffinity="0"/>'
    )
    text = Path(find("planar3")[0]).read_text()
    assert old in text
    text = text.replace(old, new).replace("<worldbody>", asset)
    text = text.replace('armature=".05"', 'frictionloss=".1"')
    path = tmp_path_factory.mktemp("arm") / "ill.xml"
    path.write_text(text.replace('"2 2 3"', '"1 1 1"').replace("-.6 1.5", "-2.55 1.5"))
    return path


def test_a_good_arm_has_nothing_to_be_said_about_it(good):
    errors = certify(good)
    assert "MuJoCo C" in errors
    for terms in errors.values():
        assert max(terms.values()) < ENOUGH
    assert list(about_model(good, errors, coverage(good))) == []


def test_reaches_are_drawn_where_the_arm_can_go(good):
    draws, reach = draw_reaches(good, 40), reach_of(good)
    assert reach == pytest.approx(0.3 + 0.25 + 0.15)
    start = np.asarray(good.q_home)
    assert draws.goal.shape == (40, 3) and start.shape == (3,)
    np.testing.assert_allclose(draws.goal[:, 1], 0.0, atol=1e-9)  # in its plane
    assert np.count_nonzero(~draws.blocked) == 40 // BLOCKED
    near = np.linalg.norm(draws.sphere - draws.goal, axis=1)[draws.blocked]
    assert near.min() > draws.radius


def test_the_controller_reaches_without_contacts_within_the_speeds(good):
    """Eight reaches; 1.001: rounding."""
    draws = draw_reaches(good, REACHES)
    track = run_reaches(good, draws)
    assert not track.touched.any() and not track.crossed.any()
    assert np.all(track.nearest[~draws.blocked] < draws.radius)
    assert np.all(track.speed <= 1.001 * good.qd_max)
    assert np.all(track.rate <= 1.001 * good.tau_rate_max)
    said = " ".join(about_motion(good, draws, track))
    assert "contacts" not in said and "velocity" not in said
    unknown = good.replace(qd_max=None, tau_rate_max=None)
    said = " ".join(about_motion(unknown, draws, track))
    assert "no velocity limits are known" in said and "torque_rate_limits=" in said


def test_the_command_names_what_is_wrong(ill, capsys):
    assert main([str(ill), "--site", "ee", "--reaches", "0"]) == 0
    said = capsys.readouterr().out
    for part in ("planar3", "joint2", "1.00", "MuJoCo C", "What does not fit:"):
        assert part in said
    assert "no rotor inertia at joint1, joint2, joint3" in said
    assert "dry friction" in said
    assert "q_home puts joint joint1 within 0.1 of its range's end" in said
    assert "Everything fits" not in said


def test_what_sticks_out_of_the_capsules_is_measured(ill):
    """A box 6 x 6 x 15 cm in one capsule, and its picture 5 cm further out."""
    with pytest.warns(RobotWarning):
        links = {link.body: link for link in coverage(Robot.load(str(ill), site="ee"))}
    link = links["link2"]
    assert link.capsules == 1 and 1.5 < link.ratio < 2.3
    assert 0.1 < link.outside < 0.4
    assert 0.02 < link.farthest < 0.05
    assert np.isnan(links["link1"].ratio) and links["link1"].outside == 0.0


def test_the_file_of_parameters_makes_the_same_arm(ill, tmp_path, capsys):
    out = tmp_path / "parameters" / "arm.toml"
    out.parent.mkdir()
    options = ["--site", "ee", "--velocity_limits", "1", "2", "3", "--spacing", "0.04"]
    assert main([str(ill), *options, "--reaches", "0", "--out", str(out)]) == 0
    assert str(out) in capsys.readouterr().out.replace("\n", "")
    limits = [1.0, 2.0, 3.0]
    with pytest.warns(RobotWarning, match="dry friction"):
        arm = Robot.load(str(ill), site="ee", velocity_limits=limits, spacing=0.04)
        assert Robot.load(str(out)).fingerprint == arm.fingerprint


def test_an_unknown_name_ends_with_what_there_is(capsys):
    assert main(["planr3"]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "unknown robot 'planr3'" in said and "Did you mean 'planar3'?" in said


def test_the_picture_shows_two_sides(good):
    if runtime.choose_gl() is None:
        pytest.skip("no headless rendering on this machine")
    from rmp_mjx.check_robot.picture import views

    picture = views(good, (90, 80))
    assert picture.shape == (90, 160, 3)
    for side in (picture[:, :80], picture[:, 80:]):
        assert len(np.unique(side.reshape(-1, 3), axis=0)) > 50

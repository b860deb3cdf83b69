"""The nominal posture is within the joint ranges, whatever the file says."""

import re
import warnings

import mujoco
import numpy as np
import pytest

from rmp_mjx import Robot, RobotError, RobotWarning
from rmp_mjx.robot import posture
from rmp_mjx.robot.configurations import capsule_gaps, random_configurations
from rmp_mjx.robot.posture import manipulability, search_posture
from tests.oracles import Measured


def text(second="-2 2", key="", first=""):
    return f"""<mujoco><compiler angle="radian"/><worldbody><body name="one">
    <joint name="a" axis="0 0 1" {first}/>
    <geom name="one" type="capsule" size=".05 .1"/>
    <body name="two" pos="0 0 .3"><joint name="b" axis="0 1 0" range="{second}"/>
    <geom name="two" type="capsule" size=".04 .1"/><site name="tip"/></body></body>
    </worldbody><actuator><motor joint="a" ctrlrange="-5 5"/>
    <motor joint="b" ctrlrange="-5 5"/></actuator><keyframe>{key}</keyframe></mujoco>"""


HOME = '<key name="home" qpos="{} {}"/>'


def load(mjcf, **kwargs):
    return Robot.from_mjcf(mjcf, site="tip", **kwargs)


def test_the_keyframe_home_is_the_posture():
    robot = load(text(key='<key name="up" qpos="1 1"/>' + HOME.format(0.3, -1.9)))
    np.testing.assert_allclose(robot.q_home, [0.3, -1.9])


def test_a_keyframe_outside_a_range_is_refused():
    message = "keyframe 'home' puts joint 'b' at 2.5, outside its range [-2, 2]: pass"
    with pytest.raises(RobotError, match=re.escape(message)):
        load(text(key=HOME.format(0.3, 2.5)))


@pytest.mark.parametrize("end", [-1.0, 1.0])
def test_a_hundred_thousandth_beyond_a_range_is_rounding(end):
    """Of a radian, or of the coordinate where that is more."""
    span = "0 9" if end < 0 else "-9 0"
    assert load(text(span), q_home=[0.0, end * 1e-5]).q_home[1] == end * 1e-5
    with pytest.raises(RobotError, match="outside its range"):
        load(text(span), q_home=[0.0, end * 1.1e-5])
    assert load(text("-8 8"), q_home=[0.0, end * 8.00007]).q_home[1] == end * 8.00007
    with pytest.raises(RobotError, match="outside its range"):
        load(text("-8 8"), q_home=[0.0, end * 8.00009])


def test_a_posture_given_replaces_the_files():
    robot = load(text(key=HOME.format(0.3, 2.5)), q_home=[7.0, 2.0])
    assert robot.q_home.tolist() == [7.0, 2.0]  # joint a turns freely


@pytest.mark.parametrize(
    ("q_home", "message"),
    [
        ([0.0, -2.1], "q_home puts joint 'b' at -2.1, outside its range [-2, 2]"),
        ([0.0], "q_home must be 2 finite numbers, got [0.0]"),
        ([0.0, float("nan")], "q_home must be 2 finite numbers"),
    ],
)
def test_a_bad_posture_is_refused(q_home, message):
    with pytest.raises(RobotError, match=re.escape(message)):
        load(text(), q_home=q_home)


@pytest.mark.parametrize(
    "span",
    ["-3 -0.1", "0.5 1", "-0.1 4", "-4 0.1"],
    ids=["above", "below", "near the lower end", "near the upper end"],
)
def test_without_a_keyframe_a_joint_at_its_end_rests_well_within_its_range(span):
    with pytest.warns(RobotWarning, match=r"near the end .* searched\. Pass q_home="):
        robot = load(text(span))
    low, high = map(float, span.split())
    share = (robot.q_home[1] - low) / (high - low)
    assert 0.2 < share < 0.8


def test_a_stretched_arm_rests_in_a_better_posture():
    """The UR5e at zero is stretched out: its Jacobian has no inverse there."""
    ur5e = Robot.load("ur5e")
    with pytest.warns(RobotWarning, match="the reference pose is singular"):
        robot = Robot.from_mjcf(ur5e.mjcf, site="ee")
    both = np.stack([robot.q_ref, robot.q_home])
    stretched, better = manipulability(robot, both)
    assert stretched < 1e-6 and better > 0.05
    assert better == pytest.approx(_by_mujoco(robot, robot.q_home), rel=1e-6)
    assert capsule_gaps(robot, both[1:], robot.capsules.pairs).min() > 0.05


def _by_mujoco(robot, q):
    """The root of the determinant of J J^T, of J^T J for fewer than six joints."""
    model = robot.mj_model
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    J = np.zeros((2, 3, robot.n))
    mujoco.mj_jacSite(model, data, J[0], J[1], model.site(robot.site_name).id)
    return np.prod(np.linalg.svd(J.reshape(6, -1), compute_uv=False))


@pytest.mark.parametrize("name", ["bent", "ur5e", "jaco2"])
def test_manipulability_is_that_of_mujocos_jacobian(name, bent):
    """Four, six and seven joints, 20 postures; 1e-6: the root of a determinant."""
    robot = bent if name == "bent" else Robot.load(name)
    q = random_configurations(robot, 20)
    expected = [_by_mujoco(robot, q_k) for q_k in q]
    np.testing.assert_allclose(manipulability(robot, q), expected, rtol=1e-6, atol=1e-6)


def _crowded(robot, share):
    """The arm with its last joint's reference at this share of half the range."""
    room = robot.q_ref[3] - robot.q_lower[3]
    upper = robot.q_upper.copy()
    upper[3] = robot.q_ref[3] + room * share / (2.0 - share)
    return robot.replace(q_upper=upper)


def test_a_tenth_of_half_the_range_is_room_enough(bent):
    assert search_posture(_crowded(bent, 0.11), 50)[1] == ""
    for share in (0.09, -0.1):
        found = search_posture(_crowded(bent, share), 50)[1]
        assert found == "is outside or near the end of a joint's range"


@pytest.mark.parametrize("seed", range(40))
def test_the_searched_posture_has_the_greatest_product(bent, seed, monkeypatch):
    """Of manipulability, room and distance from itself, by MuJoCo C; 2 pi away from the
    reference pose a joint counts 1 / e. Of 30 postures in each of 40 draws."""

    def draw(robot, count):
        return random_configurations(robot, count, seed)

    monkeypatch.setattr(posture, "random_configurations", draw)
    robot, measured, samples = _crowded(bent, 0.05), Measured(bent), 30
    q = np.vstack([robot.q_ref, draw(robot, samples)])
    gap = [measured.gaps(x, bent.capsules.pairs).min() for x in q]
    ends = np.stack([q - robot.q_lower, robot.q_upper - q])[:, :, 1:]
    room = (2.0 * ends / (robot.q_upper - robot.q_lower)[1:]).min(axis=(0, 2))
    near = np.exp(-np.square((q - robot.q_ref) / (2 * np.pi)).sum(axis=1))
    reach = np.array([_by_mujoco(robot, x) for x in q])
    product = reach * np.maximum(room, 0.0) * np.clip(gap, 0.0, 0.1) * near
    np.testing.assert_array_equal(
        search_posture(robot, samples)[0], q[product.argmax()]
    )


def test_four_thousand_postures_are_compared(bent, monkeypatch):
    counts = []

    def draw(robot, count):
        counts.append(count)
        return random_configurations(robot, 10)

    monkeypatch.setattr(posture, "random_configurations", draw)
    search_posture(bent)
    assert counts == [4000]


def test_an_arm_whose_links_touch_in_the_reference_pose_rests_elsewhere(bent):
    """Links thicker by half the gap that there is: a millimetre more or less."""
    pairs = bent.capsules.pairs
    gap = Measured(bent).gaps(bent.q_ref, pairs).min()
    for more, expected in ((-1e-3, ""), (1e-3, "is in collision with itself")):
        radius = bent.capsules.radius + (gap + more) / 2.0
        thick = bent.replace(capsules=bent.capsules.replace(radius=radius))
        q, fault = search_posture(thick, 50)
        assert fault == expected
        assert np.array_equal(q, bent.q_ref) == (more < 0.0)


def test_a_reference_pose_well_within_the_ranges_is_the_posture():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        robot = load(text(first='ref=".7"'))
    np.testing.assert_allclose(robot.q_home, [0.7, 0.0])

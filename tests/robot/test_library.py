"""Arms by name: against published Denavit-Hartenberg tables, and files of all kinds."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

import rmp_mjx as rmp
from rmp_mjx import Robot, RobotError
from rmp_mjx.robot.configurations import capsule_gaps, joint_frames
from rmp_mjx.robot.library import find

SHIPPED = ["jaco2", "panda", "fr3", "ur5e", "iiwa14", "planar3"]
HALF = np.pi / 2


def modified(q, a, alpha, d):
    """Craig's transform: about and along the last x axis, then z."""
    return _about_x(alpha, [a, 0, 0]) @ _about_z(q, [0, 0, d])


def classic(q, a, alpha, d):
    """Denavit and Hartenberg's transform: about and along z, then the new x axis."""
    return _about_z(q, [0, 0, d]) @ _about_x(alpha, [a, 0, 0])


def _about_x(angle, offset):
    c, s = np.cos(angle), np.sin(angle)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = [[1, 0, 0], [0, c, -s], [0, s, c]], offset
    return T


def _about_z(angle, offset):
    c, s = np.cos(angle), np.sin(angle)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = [[c, -s, 0], [s, c, 0], [0, 0, 1]], offset
    return T


TURNED = np.diag([-1.0, -1.0, 1.0, 1.0])
FRANKA = (
    modified,
    np.eye(4),
    [
        (0, 0, 0.333),
        (0, -HALF, 0),
        (0, HALF, 0.316),
        (0.0825, HALF, 0),
        (-0.0825, -HALF, 0.384),
        (0, HALF, 0),
        (0.088, HALF, 0),
    ],
    0.107,
)
"""Franka Control Interface documentation, table of the DH parameters."""
UR5E = (
    classic,
    TURNED,
    [
        (0, HALF, 0.1625),
        (-0.425, 0, 0),
        (-0.3922, 0, 0),
        (0, HALF, 0.1333),
        (0, -HALF, 0.0997),
        (0, 0, 0.0996),
    ],
    0.0,
)
"""Universal Robots' page of the DH parameters; ROS' base_link is turned."""
IIWA = (
    classic,
    np.eye(4),
    [
        (0, -HALF, 0.36),
        (0, HALF, 0),
        (0, HALF, 0.42),
        (0, -HALF, 0),
        (0, -HALF, 0.4),
        (0, HALF, 0),
        (0, 0, 0.126),
    ],
    0.0,
)
"""Distances of KUKA's data sheet; DH convention of Faria et al. (2018)."""
TABLES = {"panda": FRANKA, "fr3": FRANKA, "ur5e": UR5E, "iiwa14": IIWA}


def planar():
    """The text of an arm that ships."""
    return Path(find("planar3")[0]).read_text()


@pytest.fixture(scope="module")
def arms():
    """Every arm that ships."""
    return {name: Robot.load(name) for name in SHIPPED}


@pytest.mark.parametrize("name", TABLES)
def test_the_flange_is_where_the_vendors_table_puts_it(arms, name):
    """1e-6 m and rad: the files' six digits."""
    robot, (link, base, rows, flange) = arms[name], TABLES[name]
    q = np.random.default_rng(0).uniform(-3, 3, (20, robot.n))
    p, R = joint_frames(robot, q)
    x = p[-1] + R[-1] @ robot.site_offset
    z = R[-1] @ robot.site_rotation[:, 2]
    for k in range(len(q)):
        T = base
        for angle, row in zip(q[k], rows, strict=True):
            T = T @ link(angle, *row)
        T = T @ _about_z(0.0, [0, 0, flange])
        np.testing.assert_allclose(x[k], T[:3, 3], atol=2e-6)
        np.testing.assert_allclose(z[k], T[:3, 2], atol=5e-6)


@pytest.mark.parametrize("name", SHIPPED)
def test_an_arm_can_work_from_its_home_posture(arms, name):
    """It is clear of itself, away from the joints' ends, and its motors hold it."""
    robot = arms[name]
    room = np.minimum(robot.q_home - robot.q_lower, robot.q_upper - robot.q_home)
    assert room.min() > 0.3  # rad
    assert capsule_gaps(robot, robot.q_home[None], robot.capsules.pairs).min() > 0.05
    model = robot.mj_model
    data = mujoco.MjData(model)
    data.qpos[:] = robot.q_home
    mujoco.mj_forward(model, data)
    assert np.max(np.abs(data.qfrc_bias) / robot.tau_max) < 0.6
    singular = np.linalg.svd(_jacobian(model, data, robot.site_name), compute_uv=False)
    assert singular[min(robot.n, 6) - 1] > 0.03


def _jacobian(model, data, site):
    J = np.zeros((2, 3, model.nv))
    mujoco.mj_jacSite(model, data, J[0], J[1], model.site(site).id)
    return J.reshape(6, -1)


def test_arms_carry_the_limits_of_their_data_sheets(arms):
    np.testing.assert_allclose(arms["panda"].qd_max, [2.175] * 4 + [2.61] * 3)
    np.testing.assert_allclose(arms["fr3"].tau_rate_max, [1000.0] * 7)
    np.testing.assert_allclose(arms["ur5e"].qd_max, [np.pi] * 6, atol=1e-5)
    degrees = [85, 85, 100, 75, 130, 135, 135]
    np.testing.assert_allclose(np.rad2deg(arms["iiwa14"].qd_max), degrees, rtol=1e-5)
    assert arms["ur5e"].tau_rate_max is None  # not published
    assert arms["panda"].tau_max.tolist() == [87.0] * 4 + [12.0] * 3
    record = arms["panda"].mj_model.numeric("acceleration_limits").data
    assert record.tolist() == [15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0]


def test_the_jaco_has_no_limits_of_speed_so_that_its_numbers_stay(arms):
    assert arms["jaco2"].qd_max is None and arms["jaco2"].tau_rate_max is None


def test_limits_survive_the_arms_own_text_and_can_be_replaced(arms):
    again = Robot.from_mjcf(arms["fr3"].mjcf, "ee", q_home=arms["fr3"].q_home)
    assert again == arms["fr3"]
    slow = Robot.load("fr3", velocity_limits=[1.0] * 7)
    np.testing.assert_array_equal(slow.qd_max, [1.0] * 7)


def test_a_files_limits_must_be_one_positive_number_for_each_joint():
    text = planar().replace('data="2 2 3"', 'data="2 2"')
    message = "numeric 'velocity_limits' must be 3 finite numbers, got [2.0, 2.0]"
    with pytest.raises(RobotError, match=re.escape(message)):
        Robot.from_mjcf(text, site="ee")


def test_a_body_takes_the_place_of_the_site_that_goes_with_a_name():
    robot = Robot.load("planar3", body="link3", offset=[0.0, 0.0, 0.1])
    assert robot.site_name == "end_effector"
    assert Robot.load("planar3", site="ee").site_name == "ee"


def test_rotor_inertias_can_be_given_by_numbers():
    robot = Robot.load("planar3", armature=[0.1, 0.2, 0.3])
    np.testing.assert_allclose(robot.armature, [0.1, 0.2, 0.3])


def test_names_of_packages_are_listed_where_they_are_installed(tmp_path, monkeypatch):
    text = planar()
    here = tmp_path / "robosuite" / "models" / "assets" / "robots" / "xarm7"
    here.mkdir(parents=True)
    (tmp_path / "robosuite" / "__init__.py").write_text("")
    hand = '<body name="right_hand" pos="0 0 .2"/></body>'
    (here / "robot.xml").write_text(text.replace("</body>", hand, 1))
    there = tmp_path / "menagerie" / "kinova_gen3"
    there.mkdir(parents=True)
    (there / "gen3.xml").write_text(text.replace('"ee"', '"pinch_site"'))
    assert not [name for name in rmp.robots() if name.startswith("menagerie")]
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path / "menagerie"))
    assert rmp.robots() == [*SHIPPED, "robosuite/xarm7", "menagerie/kinova_gen3"]
    assert Robot.load("robosuite/xarm7").site_offset @ [1, 1, 1] == pytest.approx(0.2)
    assert Robot.load("menagerie/kinova_gen3").site_name == "pinch_site"


def test_a_file_of_parameters_stands_for_an_arm(tmp_path):
    (tmp_path / "arm.xml").write_text(planar())
    parameters = 'model = "arm.xml"\nsite = "ee"\nvelocity_limits = [1.0, 1.0, 2.0]\n'
    (tmp_path / "mine.toml").write_text(parameters)
    robot = Robot.load(str(tmp_path / "mine.toml"))
    assert robot.qd_max is not None and robot.qd_max.tolist() == [1.0, 1.0, 2.0]
    other = 'model = "mine.toml"\nbody = "link3"\nspacing = 0.05\n'
    (tmp_path / "other.toml").write_text(other)
    assert Robot.load(str(tmp_path / "other.toml")).site_name == "end_effector"
    direct = Robot.load(str(tmp_path / "arm.xml"), site="ee")
    assert direct.n == 3


REFUSED = {
    "no model": ('site = "ee"', "has no model: give a name of robots() or a path"),
    "unknown model": (
        'model = "pand"',
        "unknown robot 'pand'; valid names: jaco2, panda",
    ),
    "no TOML": ("site = ee", "is not TOML"),
}


@pytest.mark.parametrize(("text", "message"), REFUSED.values(), ids=REFUSED.keys())
def test_a_bad_file_of_parameters_gets_a_clear_error(tmp_path, text, message):
    (tmp_path / "arm.toml").write_text(text)
    with pytest.raises(RobotError, match=re.escape(message)):
        Robot.load(str(tmp_path / "arm.toml"))


def test_a_missing_file_of_parameters_is_named():
    with pytest.raises(RobotError, match=r"no file of parameters at 'nowhere\.toml'"):
        Robot.load("nowhere.toml")

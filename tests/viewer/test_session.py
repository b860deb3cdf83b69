"""Arms, things and their history, without a browser."""

import numpy as np
import pytest

from rmp_mjx.viewer.charts import quantities
from rmp_mjx.viewer.session import PERIOD, Session
from rmp_mjx.viewer.texts import bars, obeyed, status
from rmp_mjx.viewer.things import Thing

AHEAD = np.array([0.10, 0.15, 0.05])


def run(session, seconds):
    return [session.step() for _ in range(round(seconds / PERIOD))]


def aim(session, offset):
    position, wxyz = session.target
    session.target = position + offset, wxyz


@pytest.mark.parametrize("name", ["rmp_vices", "vices", "vices_cbf"])
def test_the_hand_comes_to_the_target(session, name):
    session.start([name])
    aim(session, AHEAD)
    run(session, 4.0)
    # 18 cm of way at 0.05 m of lead takes about 1.5 s; the tree's posture leaf and
    # dead ends of the wrist leave up to 1 cm
    assert np.linalg.norm(session.hand() - session.target[0]) < 0.02


def test_beside_it_the_tree_avoids_what_vices_hits(session):
    session.start(["rmp_vices", "vices"])
    place = session.hand() + 0.5 * AHEAD
    session.set_things([Thing("sphere", tuple(place), (0.05,))])
    aim(session, AHEAD)
    frames = run(session, 3.0)
    tree, vices = zip(*(frame.arms for frame in frames), strict=True)
    assert max(arm.force for arm in tree) == 0.0
    assert min(arm.clearance for arm in tree) > 0.005
    assert max(arm.force for arm in vices) > 10.0
    assert "HIT" in status(max(frames, key=lambda f: f.arms[1].force), 1.0)


def test_a_slider_compiles_nothing(session):
    session.step()
    programs = session._control._cache_size()
    session.dials["rmp_vices"]["leaves.collision.mu"] *= 2.0
    session.stiffness["kp_pos"] = 300.0
    session.drive(["vices", "vices_cbf"])
    session.set_things([Thing("box", (0.5, 0.0, 0.9), (0.05, 0.05, 0.05))])
    session.step()
    assert session._control._cache_size() == programs == 1


def test_a_dial_changes_what_the_controller_does(session):
    place = session.hand() + np.array([0.0, 0.0, 0.08])
    session.set_things([Thing("sphere", tuple(place), (0.05,))])
    usual = session.step().arms[0].tau
    session.start()
    session.dials["rmp_vices"]["leaves.collision.margin"] = 0.1
    assert np.abs(session.step().arms[0].tau - usual).max() > 0.1
    assert "margin=0.1" in session.as_python("rmp_vices", "jaco2")


def test_a_push_moves_the_arm_and_the_controller_knows_of_it(session):
    run(session, 0.5)
    before = session.hand()
    session.push = session.robot.body_names[-1], np.array([0.0, 20.0, 0.0])
    pushed = run(session, 0.5)[-1]
    assert session.hand()[1] > before[1] + 0.01
    assert np.abs(pushed.arms[0].tau_ext).max() > 1.0


def test_a_session_goes_on_from_a_frame_as_before(session):
    session.start(["rmp_vices", "vices"])
    aim(session, AHEAD)
    frames = run(session, 0.5)
    session.restore(frames[49])
    assert session.time == frames[49].time and len(session.history) == 50
    again = run(session, 0.25)
    for old, new in zip(frames[-1].arms, again[-1].arms, strict=True):
        # MuJoCo's warm start and the last torque are not kept: 1 mrad in 0.25 s
        assert np.abs(old.q - new.q).max() < 1e-3


def test_things_touch_the_arm_in_their_new_size(session):
    place = session.hand() + np.array([0.0, 0.25, 0.0])
    session.start(["vices"])
    session.set_things([Thing("sphere", tuple(place), (0.05,))])
    assert session.step().arms[0].force == 0.0
    session.set_things([Thing("sphere", tuple(place), (0.24,))])
    assert max(frame.arms[0].force for frame in run(session, 0.1)) > 1.0


def test_an_insight_adds_up(session):
    place = session.hand() + np.array([0.0, 0.12, 0.0])
    session.set_things([Thing("sphere", tuple(place), (0.06,))])
    aim(session, AHEAD)
    frame = run(session, 0.2)[-1]
    insight = session.think(frame)
    assert set(insight.asked) == {
        *("collision", "self_collision", "position"),
        *("orientation", "joint_limit", "posture"),
    }
    # the insight is of the state after the step: 5 ms of motion, at most 5 mm
    assert abs(insight.clearance - frame.arms[0].clearance) < 5e-3
    width = np.linalg.norm(insight.gap[0] - insight.gap[1])
    assert abs(width - insight.clearance) < 1e-5  # float32 of half a metre
    heaviest = insight.points[np.argmax(insight.weight)]
    assert np.linalg.norm(heaviest - insight.gap[0]) < 0.07  # a link's radius
    towards = place - insight.start["collision"]
    assert insight.pull["collision"] @ towards < 0.0
    assert insight.pull["position"] @ AHEAD > 0.0
    assert (insight.eigenvalues > -1e-4).all()
    assert "collision" in bars(insight, "rmp_vices")


def test_a_branch_gets_between_nothing_and_all_of_what_it_asks():
    assert obeyed(2.0, 0.0) == 1.0 and obeyed(2.0, 1.0) == 0.5
    assert obeyed(2.0, 5.0) == 0.0 and obeyed(0.0, 0.0) == 1.0


def test_the_charts_show_the_history(session):
    session.start(["rmp_vices", "vices"])
    frames = run(session, 0.05)
    charts = quantities(session.robot, frames)
    assert set(charts["contact force [N]"]) == {"1 rmp_vices", "2 vices"}
    assert len(charts["room to joint limits [rad]"]) == 3  # the others turn freely
    torque = charts["torque / limit"][session.robot.joint_names[1]]
    assert len(torque) == 10 and 0.0 < torque.max() <= 1.0


def test_wrong_names_are_refused(jaco):
    with pytest.raises(ValueError, match="controller"):
        Session(jaco, ["rmpvices"])
    with pytest.raises(ValueError, match="scene"):
        Session(jaco, scene="desk")
    with pytest.raises(ValueError, match="at least one"):
        Session(jaco, [])


def test_there_are_only_so_many_slots(session):
    ball = Thing("sphere", (0.5, 0.0, 0.5), (0.05,))
    with pytest.raises(ValueError, match="at most 8"):
        session.set_things([ball] * 9)

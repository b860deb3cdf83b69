"""One session for all tests here: its two programs take most of the time."""

import pytest

from rmp_mjx.robot import Robot

pytest.importorskip("viser", reason="the extra viewer is not installed")


@pytest.fixture(scope="session")
def jaco():
    return Robot.load("jaco2")


@pytest.fixture(scope="session")
def shared_session(jaco):
    from rmp_mjx.viewer.session import Session

    return Session(jaco)


@pytest.fixture
def session(shared_session):
    """The shared one, as new."""
    shared_session.set_floor(False)
    shared_session.load("free")
    shared_session.push = None
    shared_session.stiffness.update(kp_pos=150.0, kp_ori=150.0)
    for name in shared_session.dials:
        shared_session.reset_dials(name)
    shared_session.start(["rmp_vices"])
    return shared_session

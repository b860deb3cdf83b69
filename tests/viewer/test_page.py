"""The page in a real browser: Debian's Chromium, headless, with software WebGL."""

import numpy as np
import pytest

from rmp_mjx.viewer.page import Page
from rmp_mjx.viewer.spring import STRONGEST, pull
from tests.viewer import chromium

needs_chromium = pytest.mark.skipif(bool(chromium.missing()), reason=chromium.missing())


@pytest.fixture(scope="module")
def browser():
    with chromium.browser() as found:
        yield found


@pytest.fixture
def tabs(browser, page):
    """Opens tabs, and closes them: each takes half a core for its software WebGL."""
    opened = []

    def opener():
        opened.append(chromium.Tab(browser, page))
        return opened[-1]

    yield opener
    for tab in opened:
        tab.window.close()


@pytest.fixture
def page(session, tmp_path):
    session.step()  # compiled before the clock runs
    page = Page(session, "jaco2", port=8710, folder=tmp_path)
    page.server.scene.configure_default_lights(cast_shadow=False)
    with chromium.running(page):
        yield page


def _arm(page):
    """The numbers of the arm that is shown."""
    return page.player.shown.arms[0]


def _idle(tab):
    """Let the browser's events arrive."""
    tab.window.wait_for_timeout(50)
    return True


@needs_chromium
def test_the_arm_follows_avoids_and_hits_as_its_users_order(tabs, page, tmp_path):
    session = page.session
    tab = tabs()
    tab.window.wait_for_timeout(2000)
    before, hand = tab.picture(), session.hand()
    assert before.std() > 5.0  # there is something to see

    tab.press("Record")
    start = session.target[0]
    tab.drag(start, np.array([0.0, 1.0, 0.0]), 0.2)
    chromium.wait(lambda: session.target[0][1] > start[1] + 0.1, "the target moved")
    chromium.wait(
        lambda: bool(np.linalg.norm(session.hand() - session.target[0]) < 0.03),
        "the arm follows",
    )
    assert session.hand()[1] > hand[1] + 0.1
    tab.window.wait_for_timeout(1000)
    changed = np.abs(tab.picture() - before).max(axis=2) > 30.0
    assert changed.mean() > 0.01, "the pictures are the same"

    tab.click("Things", "tab")
    tab.press("Add sphere")
    chromium.wait(lambda: len(session.things) == 1, "a sphere")
    chromium.wait(lambda: np.isfinite(_arm(page).clearance), "a clearance")
    ahead = session.target[0] + np.array([0.0, 0.02, 0.12])
    page.order(lambda: session.set_things([session.things[0].put(ahead)]))
    tab.window.wait_for_timeout(1500)
    assert _arm(page).force == 0.0 and _arm(page).clearance > 0.0

    tab.click("Drive", "tab")
    tab.choose("Controller", "vices")
    chromium.wait(lambda: session.controllers == ("vices",), "another controller")
    chromium.wait(lambda: _arm(page).force > 1.0, "VICES hits the sphere")
    assert not page.player.paused and page.player.pace > 0.5

    tab.press("Stop and save")
    chromium.wait(lambda: list(tmp_path.glob("*.html")) != [], "a recording")
    assert tab.faults == []

    page.stop()
    (file,) = tmp_path.glob("*.html")
    tab.window.goto(file.as_uri())
    chromium.drawn(tab.window)
    tab.window.wait_for_timeout(2000)
    assert tab.picture().std() > 5.0 and tab.faults == []


@needs_chromium
def test_two_tabs_show_the_same_through_a_reload_and_an_end(tabs, page):
    first, second = tabs(), tabs()
    first.press("Pause")
    chromium.wait(lambda: page.player.paused, "a pause")
    second.window.get_by_role("button", name="Go on", exact=True).first.wait_for()
    first.window.reload()
    first.press("Go on")
    chromium.wait(lambda: not page.player.paused, "the end of the pause")
    second.window.wait_for_timeout(300)
    assert first.faults == [] == second.faults
    page.stop()
    chromium.wait(lambda: _idle(second) and second.closed, "the end of the connection")
    assert second.faults == []


def test_paused_users_step_scrub_and_go_on_from_the_past(page):
    drive, session = page.drive, page.session
    chromium.wait(lambda: session.time > 1.0, "a second of history")
    page.order(drive.clock.toggle)
    chromium.wait(lambda: page.player.paused, "a pause")
    time = session.time
    page.order(drive.clock.step_once)
    chromium.wait(lambda: session.time > time, "a step")
    assert session.time == pytest.approx(time + 0.005)
    drive.clock.back.value = 0.5
    chromium.wait(lambda: page.player.shown.time < time - 0.4, "the past")
    past = page.player.shown.time
    page.order(drive.clock.go_on_from_there)
    chromium.wait(lambda: not page.player.paused, "the end of the pause")
    assert past < session.time < time


def test_a_link_that_is_dragged_gives_way_until_its_users_let_go(page):
    session, spring = page.session, page.drive.spring
    link = session.robot.body_names[-1]
    page.order(lambda: spring.choose(link))
    chromium.wait(lambda: spring.handle is not None, "a handle")
    assert session.push is None  # a handle on its link pulls nothing
    before = session.hand()
    spring.handle.position = session.body(link) + np.array([0.0, 0.2, 0.0])
    page.order(spring.drag)
    chromium.wait(lambda: session.push is not None, "a force")
    name, force = session.push or ("", np.zeros(3))
    # 200 N/m over 20 cm; the link has moved by some centimetres at most since then
    assert name == link and 20.0 < force[1] <= 41.0
    chromium.wait(lambda: bool(session.hand()[1] > before[1] + 0.01), "a motion")
    assert spring._label.text.endswith(" N") and spring._arrow.visible
    page.order(page.drive._home)
    chromium.wait(lambda: spring.handle is None, "the end of the pull")
    assert session.push is None and not spring._arrow.visible


def test_a_spring_pulls_no_more_than_its_greatest_force():
    near, far = np.array([0.0, 0.1, 0.0]), np.array([0.0, 0.0, 9.0])
    assert np.allclose(pull(np.zeros(3), near), 200.0 * near)
    assert np.allclose(pull(np.zeros(3), far), [0.0, 0.0, STRONGEST])
    assert not pull(near, near).any()


def test_orders_that_make_no_sense_are_answered_not_obeyed(page):
    page.order(page.things._remove)
    chromium.wait(lambda: "no thing number" in page.drive.status.content, "an answer")
    for _ in range(9):
        page.order(lambda: page.things._add("sphere"))
    chromium.wait(lambda: len(page.session.things) == 8, "eight spheres")


def test_the_address_is_on_this_machine_alone(page):
    assert page.url.startswith("http://127.0.0.1:")

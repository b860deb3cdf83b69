"""What a cell of the arms' tables counts, and where it stands."""

import numpy as np

from benchmarks.common import Row
from benchmarks.studies import arms
from envs.safety import ENDING


def results(**counts):
    names = (*ENDING, *arms.COUNTED, "success")
    return {name: np.array(counts.get(name, [0, 0, 0])) for name in names}


def test_an_episode_with_an_event_is_no_success():
    found = arms.judged(results(success=[1, 1, 0], joint_limit=[0, 2, 0]))
    np.testing.assert_array_equal(found["success"], [True, False, False])
    np.testing.assert_array_equal(found["event"], [False, True, False])


def test_a_fast_joint_is_counted_and_fails_nothing():
    found = arms.judged(results(success=[1, 1, 1], joint_velocity=[0, 0, 5]))
    assert found["success"].all() and not found["event"].any()
    np.testing.assert_array_equal(found["motor"], [False, False, True])


def test_a_table_has_a_row_for_each_policy_and_marks_its_own_arm():
    rows = [
        Row(f"push/{own}/{arm}/{name}", value, "%", "")
        for own in ("jaco2", "panda")
        for arm in arms.ARMS
        for name, value in (("success", 90.0 + 5.0 * (own == arm)), ("event", 0.5))
    ]
    lines = arms.table("push", rows).splitlines()
    assert (
        lines[0]
        == "| push: trained with | "
        + " | ".join(f"`{arm}`" for arm in arms.ARMS)
        + " |"
    )
    assert lines[2].startswith("| `jaco2` | **95; 0.5** | 90; 0.5 |")
    assert lines[3].startswith("| `panda` | 90; 0.5 | **95; 0.5** |")
    assert len(lines) == 4


def test_the_policies_that_ship_are_found_by_their_arm(root):
    found = arms.policies_of("door", root / "pretrained")
    assert list(found) == list(arms.TRAINED)


def test_random_events_are_summed_and_shown_from_vices_to_ours():
    rows = [
        Row(f"random/{arm}/{name}/{event}", value, "1/1000 steps", "")
        for arm in arms.ARMS
        for name, value in zip(arms.CONTROLLERS, (4.0, 0.0), strict=True)
        for event in (*ENDING, "joint_velocity")
    ]
    line = arms.random_table(rows).splitlines()[3]
    assert line == "| `panda` | 8 -> **0** | 4 -> **0** | 4 -> **0** |"

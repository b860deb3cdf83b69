import numpy as np
import pytest

import rmp_mjx as rmp
from benchmarks.speed import scaling


def test_the_exponent_of_a_power_law_is_found_in_the_upper_half():
    sizes = (1, 2, 4, 8, 16, 32)
    times = (9.0, 9.0, 9.0, *(0.1 * s**1.5 for s in sizes[3:]))
    curve = scaling.Curve("things", "call", sizes, times)
    assert curve.exponent == pytest.approx(1.5)  # exact but for rounding
    assert [r.key for r in curve.rows()][-2:] == ["us_things_32", "exponent_things"]


@pytest.mark.parametrize("joints", [3, 14])
def test_a_generated_chain_is_an_arm_with_so_many_joints(joints):
    robot = rmp.Robot.from_mjcf(scaling.chain(joints), site="tip", spacing=0.03)
    assert robot.n == joints
    assert set(robot.points.segment) == set(range(joints))
    np.testing.assert_array_equal(robot.tau_max, 30.0)


def test_the_densest_arm_has_about_as_many_control_points_as_asked_for():
    # Points come and go by the capsule, a few at once.
    assert len(scaling._with_points(64).points.segment) == pytest.approx(64, abs=8)


def test_the_state_of_an_environment_is_far_below_its_target_of_32_kb():
    import jax

    import envs

    for task in envs.names():
        state = jax.eval_shape(envs.load(task).reset, jax.random.key(0))
        assert 500 < scaling.state_bytes(state) < 8192

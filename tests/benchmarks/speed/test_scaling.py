import threading

import jax.numpy as jnp
import numpy as np
import pytest

import rmp_mjx as rmp
from benchmarks.common import Row
from benchmarks.speed import gpu, scaling


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


def test_a_program_gives_what_the_function_gives():
    x = jnp.arange(3.0)
    compiled, seconds = gpu.Programs().add(lambda x: 2.0 * x, x).result()
    np.testing.assert_array_equal(compiled(x), 2.0 * x)
    assert seconds > 0.0


def test_parts_wait_for_each_other_and_one_that_fails_stops_nobody():
    barrier, turn, found = threading.Barrier(2), threading.Lock(), {}
    row = Row("speed", 1.0, "1/s", "")

    def fails(programs):
        raise ValueError("no such scene")

    def works(programs):
        return lambda: [row]

    def run(part):
        found[part] = gpu.work(part, barrier, turn)

    threads = [threading.Thread(target=run, args=(part,)) for part in (fails, works)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=60.0)
    assert "no such scene" in found[fails]
    assert found[works] == [row]


def test_the_grid_is_the_papers_six_cells_on_every_engine():
    cells = [name.split(", ")[1] for name in gpu.grid(small=False)]
    once = cells[: len(cells) // len(gpu.engines())]
    assert sorted(set(cells)) == sorted(once)
    assert len(once) == 6 and "door/rmp_vices/0" in once

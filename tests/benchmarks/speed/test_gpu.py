"""The accelerator sweep's own parts; its figures are measured elsewhere."""

import threading

import jax.numpy as jnp
import numpy as np

from benchmarks.common import Row
from benchmarks.speed import gpu


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

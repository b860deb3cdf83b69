"""How the sweep counts, tabulates and writes; one smoke test runs it."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from benchmarks.common import Row, insert
from benchmarks.studies import failures, robustness, safety_study, sweeps
from benchmarks.studies.random_policies import REACHING_LIMIT, poisson
from benchmarks.studies.safety_study import Group
from benchmarks.studies.sweeps import AXES, Cell, Outcome, Reaching
from rmp_mjx.control.controller import ImpedanceController

QUIET = ("collision", "self_collision", "joint_limit")


def figures(steps, worlds, **changes):
    names = (*QUIET, "moved", "torque_jump", "joint_jerk", "turns", "torque_saturation")
    names += ("success", "via_points", "over", "age", "unplaced_obstacles")
    values = {name: np.zeros((steps, worlds)) for name in names}
    values["commanded"] = values["clearance"] = np.ones((steps, worlds))
    return values | changes


def outcome(collisions=0, limits=0, steps=1000):
    return Outcome(steps, collisions, limits, 0.2, 10.0, 1e3, 2.0, 0.01, 0.0)


def everything():
    """A result for every cell and policy that a table may ask for."""
    return {
        (cell.name, controller, policy): Reaching(9, 1, 0)
        if policy == "straight"
        else outcome(3 if controller == "rmp_vices" else 30)
        for controller in sweeps.CONTROLLERS
        for cells in sweeps.cells_of(controller, tuple(AXES)).values()
        for cell in cells
        for policy in (*sweeps.RANDOM, "straight")
    }


def test_an_outcome_counts_events_and_their_interval():
    event = np.zeros((10, 4))
    event[3, 1] = 1.0
    judged = sweeps.judge(
        figures(10, 4, collision=event, joint_limit=event, moved=np.full((10, 4), 0.3))
    )
    assert (judged.steps, judged.collisions, judged.limits) == (40, 1, 1)
    assert judged.rate == pytest.approx(50.0)
    assert judged.interval == tuple(25.0 * bound for bound in poisson(2))
    assert judged.progress == pytest.approx(0.3)


def test_turns_count_near_an_obstacle_only():
    clearance, turns = np.full((2, 2), 0.2), np.full((2, 2), 7.0)
    clearance[0, 0], turns[0, 0] = 0.01, 2.0
    judged = sweeps.judge(figures(2, 2, clearance=clearance, turns=turns))
    assert judged.turns == pytest.approx(2.0 / 0.05)


def test_reaching_leaves_out_episodes_that_the_run_cut_short():
    steps = REACHING_LIMIT + 10
    age = np.tile(np.arange(1, steps + 1)[:, None], (1, 3))
    over, success, points, event = (np.zeros((steps, 3)) for _ in range(4))
    points[[3, 5, 7, 13], 0] = over[13, 0] = success[13, 0] = 1  # reached all four
    points[2, 1] = over[4, 1] = event[4, 1] = 1  # one, then a collision
    age[14:, 0] -= 14  # starts again too late to be judged
    points[20, 0] = 1
    judged = sweeps.judge_reaching(
        figures(
            steps, 3, age=age, over=over, success=success, via_points=points,
            collision=event,
        )
    )  # fmt: skip
    assert judged == Reaching(reached=5, missed=1, lost=1)
    assert judged.share == pytest.approx(5 / 6)


def test_every_axis_holds_the_unvaried_cell_and_names_are_unique():
    cells = {cell for axis in AXES.values() for cell in axis.cells.values()}
    assert all(Cell() in axis.cells.values() for axis in AXES.values())
    assert len({cell.name for cell in cells}) == len(cells)
    assert Cell().name == "default" and Cell(torque=0.5).name == "torque=0.5"


def test_vices_runs_no_cell_that_only_blinds_it():
    ours, base = (
        {c for cells in sweeps.cells_of(k, tuple(AXES)).values() for c in cells}
        for k in ("rmp_vices", "vices")
    )
    assert base == {c for c in ours if c.noise == c.delay == 0}
    assert len(base) < len(ours)
    programs = sweeps.cells_of("rmp_vices", tuple(AXES))
    assert len(programs) == 6  # one compile each: three timesteps, crowd, armature


def test_a_table_shows_every_value_beside_what_vices_does():
    for axis in AXES.values():
        lines = robustness.table(axis, everything()).splitlines()
        assert [line.split("|")[1].strip() for line in lines[2:]] == list(axis.cells)
        assert all("3 (0.62-8.8) / 3 (0.62-8.8) | 30 / 30" in x for x in lines[2:])
        assert len({line.count("|") for line in lines}) == 1


def test_tables_go_where_the_page_wants_them_and_nowhere_else():
    page = "a\n<!-- noise -->\nold\n<!-- end -->\nb\n<!-- torque -->\n<!-- end -->\nc"
    tables = {"noise": "| 1 |", "torque": "| 2 |"}
    new = insert(page, tables)
    assert "old" not in new and insert(new, tables) == new
    assert new.startswith("a\n") and new.endswith("\nc") and "\nb\n" in new
    with pytest.raises(ValueError, match="no '<!-- delay -->'"):
        insert(page, {"delay": ""})


def test_the_page_has_a_place_for_every_table(root):
    tables = dict.fromkeys((*AXES, *failures.FAILURES), "| new |")
    text = (root / "docs" / "robustness.md").read_text()
    assert insert(text, tables).count("| new |") == len(tables)


def test_the_plot_is_drawn(tmp_path):
    robustness.plot(everything(), tmp_path / "new" / "plot.png")
    assert (tmp_path / "new" / "plot.png").read_bytes().startswith(b"\x89PNG")


def test_options_that_make_no_sense_end_with_exit_code_2(capsys):
    for argv in (["--axis", "noise", "--docs", "x"], ["--steps", "300"]):
        with pytest.raises(SystemExit) as error:
            robustness.parse(argv)
        assert error.value.code == 2
    assert "must exceed 300" in capsys.readouterr().err


def test_a_share_has_the_exact_binomial_interval():
    value, text = failures.share(np.zeros(100, bool))
    # 1 - 0.025^(1/100): the largest rate that gives no hit with probability 2.5 %.
    assert value == 0.0 and text == "0 of 100; 95 % interval 0.000-0.036"


@pytest.fixture(scope="module")
def env():
    return envs.load("trajectory", controller="vices", physics="mujoco", obstacles=2)


@pytest.fixture(scope="module")
def states(env):
    return jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 4))


def test_a_group_keeps_its_first_spheres(states):
    kept = jax.vmap(safety_study._with_spheres)(states, jnp.array([2, 1, 0, 2]))
    placed, before = kept.info["spheres"].placed, states.info["spheres"].placed
    assert np.all(before)
    np.testing.assert_array_equal(placed, [[1, 1], [1, 0], [0, 0], [1, 1]])
    away = np.asarray(kept.data.mocap_pos)[..., 2] < -4.0
    np.testing.assert_array_equal(away, ~np.asarray(placed))
    np.testing.assert_array_equal(kept.data.mocap_pos[0], states.data.mocap_pos[0])


def test_what_is_special_about_a_group_reaches_its_worlds(env):
    study = object.__new__(safety_study.Study)
    study.env = env
    study.groups = (
        Group("hard", 2, noise=0.01, torque=0.5),
        Group("smooth", 1, None, delay=0.2),
    )
    special = study._special()
    np.testing.assert_allclose(special["noise"], [0.01, 0.01, 0.0])
    np.testing.assert_allclose(special["delay"], [0.0, 0.0, 0.2])
    np.testing.assert_allclose(special["torque"], [0.5, 0.5, 1.0])
    np.testing.assert_array_equal(special["spheres"], [2, 2, 0])  # no layout, none
    first = safety_study.under(env, {k: v[0] for k, v in special.items()})
    assert isinstance(first.controller, ImpedanceController)
    np.testing.assert_allclose(
        first.controller.robot.tau_max, 0.5 * env.robot.tau_max, rtol=1e-6
    )
    assert first.options.obstacle_noise == pytest.approx(0.01)
    assert env.options.obstacle_noise == 0.0


def test_a_crossing_puts_the_spheres_halfway_beside_the_way(env):
    offsets = jnp.array([[-0.02, 0.07], [0.0, failures.AWAY]])
    case = failures.Crossing(offsets, jnp.array([0.5, 1.0]))
    start = jax.jit(
        jax.vmap(lambda case: failures.crossing_start(env, jax.random.key(3), case))
    )
    world, _ = start(case)
    state = jax.tree.map(lambda x: x[0], world.state)
    grip, target = env.site(state.data).p, state.task["points"][0]
    beside = state.data.mocap_pos - 0.5 * (grip + target)
    # float32 positions of about 0.5 m.
    np.testing.assert_allclose(beside @ (target - grip), 0.0, atol=1e-6)
    np.testing.assert_allclose(
        jnp.linalg.norm(beside, axis=1), jnp.abs(offsets[0]), rtol=1e-4
    )
    assert float(beside[0] @ beside[1]) < 0  # to either side
    np.testing.assert_array_equal(world.state.info["spheres"].placed[1], [True, False])
    np.testing.assert_allclose(world.special["torque"], [0.5, 1.0])


def test_one_command_renews_rows_plot_and_page(tmp_path, root, monkeypatch):
    monkeypatch.setattr(robustness, "sweep", lambda *_: everything().items())
    rows = [Row("a/failure", 1.0, "s", "a note")]
    for name in failures.FAILURES:
        monkeypatch.setitem(failures.FAILURES, name, lambda *_: (rows, "| hand-made |"))
    page, plot, file = (
        tmp_path / name for name in ("page.md", "plot.png", "rows.json")
    )
    page.write_text((root / "docs" / "robustness.md").read_text())
    where = ["--docs", str(page), "--plot", str(plot), "--json", str(file)]
    robustness.main(where)
    assert page.read_text().count("| hand-made |") == len(failures.FAILURES)
    assert "| 3 (0.62-8.8) / 3 (0.62-8.8) |" in page.read_text() and plot.exists()
    keys = {row["key"] for row in json.loads(file.read_text())["rows"]}
    assert {"a/failure", "default/vices/hard/events"} <= keys


@pytest.mark.slow
def test_an_axis_runs_from_the_command_line_to_its_file(tmp_path):
    file = tmp_path / "rows.json"
    robustness.main(["--quick", "--axis", "layout", "--json", str(file)])
    rows = {row["key"] for row in json.loads(file.read_text())["rows"]}
    for name in ("default", "layout=far"):
        for controller in sweeps.CONTROLLERS:
            assert f"{name}/{controller}/hard/events" in rows
            assert f"{name}/{controller}/straight/reached" in rows

"""A metric is declared in one place and appears everywhere."""

import dataclasses
import io

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

import envs
from envs import safety, types
from envs.door import Door, DoorOptions
from envs.safety import SafetyRecord
from envs.trajectory import Trajectory, TrajectoryOptions
from rmp_mjx.metric import SUCCESS, Metric, by_name, number, of_fields, reductions
from rmp_mjx.training.evaluation import report
from rmp_mjx.training.evaluation.evaluate import run_episodes, summarise
from rmp_mjx.training.learning.networks import zero_agent
from rmp_mjx.training.runs.logging import RunLogger
from tests.envs.arm_tasks import Torques


class Measured(Trajectory):
    """Trajectory following with one more metric."""

    task_metrics = (
        *Trajectory.task_metrics,
        Metric("height", "max", unit="m", headline="height", table=("mean", "max")),
    )

    def score(self, data, site, record, task, step):
        found = super().score(data, site, record, task, step)
        return found._replace(metrics=found.metrics | {"height": site.p[2]})


@pytest.fixture(scope="module")
def env():
    options = TrajectoryOptions(physics="mujoco", episode_length=3)
    return Measured(options, controller=Torques(jnp.zeros(7)))


def test_a_new_metric_is_one_declaration(env, tmp_path):
    """In the step's metrics, the episodes, the summary, the table, the terminal."""
    results = run_episodes(env, zero_agent(env.action_size), 2, jax.random.key(0))
    summary = summarise(results, env.metrics)
    assert summary["height_max"] == pytest.approx(results["height"].max())
    text = io.StringIO()
    console = Console(file=text, width=80)
    console.print(report.table({"toy": summary}, "title", env.metrics))
    assert "height [mm]" in text.getvalue() and "height, max [mm]" in text.getvalue()
    row = {"iteration": 1, "steps": 10, "time/steps_per_s": 1.0, "episode/height": 0.25}
    with RunLogger(tmp_path / "m.parquet", env.metrics, 1, console=console) as logger:
        logger.add(row)
    assert "height 250 mm" in text.getvalue()


def test_every_environment_has_the_shared_metrics_and_its_own():
    for name in envs.names():
        task = envs.ENVS[name]
        own = {metric.name for metric in task.task_metrics}
        assert own and not own & types.METRICS.keys()
    assert set(types.METRICS) > set(safety.METRICS)


def test_a_record_folds_each_field_as_it_declares():
    def record(flag, number):
        values = {"any": jnp.array(flag), "mean": jnp.array(number)}
        values["max"] = values["mean"]
        return SafetyRecord(**{n: values[fold] for n, fold in safety.FOLDS.items()})

    one, two = record(True, 3.0), record(False, 1.0)
    both = SafetyRecord.empty().then(one, 0.5).then(two, 0.5)
    expected = {"any": True, "mean": 2.0, "max": 3.0}
    for field in dataclasses.fields(both):
        fold = safety.FOLDS[field.name]
        np.testing.assert_allclose(getattr(both, field.name), expected[fold])
    assert both.events.keys() | both.values.keys() == safety.METRICS.keys()
    assert not both.events.keys() & both.values.keys()


def test_what_a_wrapper_adds_to_the_info_is_not_the_tasks(env):
    """It passes through a step; the task sees its own part alone."""
    seen = []

    class Spy(Door):
        def score(self, data, site, record, task, step):
            seen.append(set(task))
            return super().score(data, site, record, task, step)

    spy = Spy(DoorOptions(physics="mujoco"), controller=Torques(jnp.zeros(7)))
    start = jax.eval_shape(spy.reset, jax.random.key(0))
    shared = {"rng", "step", "spheres", "control", "active_events"}
    assert set(start.info) == shared | {"task"}

    def stepped(key):
        state = spy.reset(key)
        state = state.replace(info=state.info | {"steps": jnp.int32(7)})
        return spy.step(state, jnp.zeros(spy.action_size))

    after = jax.eval_shape(stepped, jax.random.key(0))
    assert seen == [{"held", "grip_force"}]
    assert set(after.info) == set(start.info) | {"steps"}
    assert set(after.task) == set(start.task)


def test_people_read_metres_as_millimetres_and_shares_as_percent():
    metres, share, newtons, count = (
        Metric("x", "mean", unit=unit) for unit in ("m", "share", "N", "")
    )
    assert (metres.shown_unit, metres.factor) == ("mm", 1e3)
    assert (share.shown_unit, share.factor) == ("%", 100.0)
    assert (newtons.shown_unit, newtons.factor) == ("N", 1.0)
    assert (count.shown_unit, count.factor) == ("", 1.0)


def test_an_event_is_shown_by_its_rate_and_anything_else_by_its_episodes():
    assert Metric("crash", "sum", event=True).column == "per_1000_steps/crash"
    assert Metric("laps", "sum").column == "episode/laps"
    assert Metric("lap_time", "mean").label == "lap time"


def test_an_unknown_reduction_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match=r"'median'.*sum, mean, max, min, last"):
        Metric("speed", "median")  # pyright: ignore[reportArgumentType]


def test_a_metric_has_one_declaration():
    laps = Metric("laps", "sum")
    assert by_name([SUCCESS, laps]) == {"success": SUCCESS, "laps": laps}
    assert reductions(by_name([SUCCESS, laps])) == {"success": "max", "laps": "sum"}
    with pytest.raises(ValueError, match="declared twice: laps"):
        by_name([laps, SUCCESS, laps])


def test_a_field_and_its_metric_have_the_same_name():
    def record(name):
        field = dataclasses.field(metadata={"metric": Metric("laps", "sum")})
        return dataclasses.make_dataclass("Record", [(name, int, field)])

    assert list(of_fields(record("laps"))) == ["laps"]
    with pytest.raises(ValueError, match="field 'rounds' declares metric 'laps'"):
        of_fields(record("rounds"))


def test_numbers_have_three_digits_and_large_ones_separators():
    shown = [number(x) for x in (0.12345, 999.4, 999.6, 12345.6)]
    assert shown == ["0.123", "999", "1,000", "12,346"]

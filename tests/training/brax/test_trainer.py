"""A run of Brax's trainer: its folder, its policy, and a stop."""

import inspect
import io
import os
import signal

import jax
import jax.numpy as jnp
import numpy as np
import polars as pl
import pytest
from brax.training.agents.ppo import networks as ppo_networks
from brax.training.agents.ppo import train as brax_ppo
from rich.console import Console

from rmp_mjx.training.brax import trainer
from rmp_mjx.training.brax.environment import Batch
from rmp_mjx.training.brax.replicated import NAME, device_put_replicated
from rmp_mjx.training.config import ConfigError, TrainConfig
from rmp_mjx.training.evaluation import evaluate
from rmp_mjx.training.learning import rollout
from rmp_mjx.training.records import read_record
from rmp_mjx.training.runs import run_folder
from rmp_mjx.training.runs.logging import RunLogger
from rmp_mjx.training.runs.policies import load_agent
from rmp_mjx.training.runs.saving import TrainingFailure
from tests.training import toys
from tests.training.conftest import ITERATIONS, SMALL, small


def run(folder, console=None):
    """Train on the counting toy."""
    steps = SMALL["num_envs"] * SMALL["unroll_length"] * ITERATIONS
    config = small(num_timesteps=steps, run_dir=str(folder), trainer="brax")
    folder, lock = run_folder.open_run(config)
    with lock:
        console = console or Console(quiet=True)
        return trainer.train(toys.Counter(), config, folder, console), config


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Folder, result, configuration, what was said, and Brax's own parameters."""
    folder, said = tmp_path_factory.mktemp("brax") / "run", io.StringIO()
    params, keep = [], trainer._Iterations.keep

    def also_keep(self, steps, make_policy, new):
        params.append(new)
        keep(self, steps, make_policy, new)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trainer._Iterations, "keep", also_keep)
        result, config = run(folder, console=Console(file=said, width=200))
    return folder, result, config, said.getvalue(), params[-1]


def test_a_run_leaves_the_same_folder_as_our_own_loop(trained, finished):
    folder, result, *_ = trained
    assert (result.iterations, result.exit_code) == (ITERATIONS, 0)
    assert read_record(folder / run_folder.CONFIG)["trainer"] == "brax"
    rows, ours = (
        pl.read_parquet(f / run_folder.METRICS) for f in (folder, finished[0])
    )
    learned = [c for c in rows.columns if c.startswith("learning/")]
    assert len(learned) == len(trainer.LEARNING) and set(learned) < set(ours.columns)
    other = [c for c in ours.columns if not c.startswith("learning/")]
    assert [c for c in rows.columns if c not in learned] == other
    assert rows["steps"].to_list() == ours["steps"].to_list()
    assert rows["episode/finished"].sum() > 0
    assert {p.name for p in folder.iterdir()} == {p.name for p in finished[0].iterdir()}


def test_what_brax_does_not_use_is_said_once(trained):
    said = trained[3]
    assert all(said.count(name) == 1 for name in trainer.NOT_IN_BRAX)
    assert "reward_scaling" in said


def test_the_policy_acts_as_braxs_own_and_is_read_from_the_folder(trained):
    folder, result, config, _, params = trained
    env = toys.Counter()
    networks = trainer.arguments(env, config)["network_factory"]()
    brax_policy = ppo_networks.make_inference_fn(networks)(params, deterministic=True)
    obs, key = jax.random.normal(jax.random.key(1), (5, 3)), jax.random.key(2)
    wanted = np.clip(brax_policy(obs, key)[0], -1.0, 1.0)
    iterations, read = load_agent(env, config, folder, True, pytest.fail)
    assert iterations == ITERATIONS
    for agent in (result.agent, read):
        assert np.array_equal(agent(obs, key), wanted)
    assert np.ptp(wanted) > 0.0


def test_the_policy_evaluates(trained):
    results = evaluate.run_episodes(
        toys.Counter(), trained[1].agent, 4, jax.random.key(0)
    )
    assert (results["length"] > 0).all()


def test_a_signal_ends_it_after_the_iteration_with_all_saved(tmp_path, monkeypatch):
    add = RunLogger.add

    def stop_at_three(self, row):
        add(self, row)
        if row["iteration"] == 3:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(RunLogger, "add", stop_at_three)
    said = io.StringIO()
    result, config = run(tmp_path / "run", console=Console(file=said, width=200))
    assert (result.iterations, result.exit_code) == (3, 128 + signal.SIGINT)
    assert "stopped after iteration 3" in said.getvalue()
    assert "--resume" not in said.getvalue()
    folder = tmp_path / "run"
    assert load_agent(toys.Counter(), config, folder, True, pytest.fail)[0] == 3
    assert len(pl.read_parquet(folder / run_folder.METRICS)) == 3


def test_losses_that_become_nonfinite_end_it_unsaved(tmp_path, monkeypatch):
    def one_bad_step(environment, progress_fn, policy_params_fn, **given):
        environment._report(rollout.init_stats(toys.Counter(), 1))
        policy_params_fn(64, None, None)
        progress_fn(64, dict.fromkeys(trainer.LEARNING.values(), jnp.nan))

    monkeypatch.setattr(trainer.brax_ppo, "train", one_bad_step)
    with pytest.raises(TrainingFailure, match="non-finite; nothing is saved"):
        run(tmp_path / "run")
    assert not list((tmp_path / "run" / run_folder.CHECKPOINTS).glob("[0-9]*"))


@pytest.fixture
def without(monkeypatch):
    """A JAX that does not have the function, as the locked one."""
    monkeypatch.delattr(jax, NAME, raising=False)


def test_it_is_there_inside_the_context_alone(without):
    with device_put_replicated():
        assert hasattr(jax, NAME)
    assert not hasattr(jax, NAME)


def test_it_is_gone_after_an_error_too(without):
    with pytest.raises(KeyError), device_put_replicated():
        raise KeyError
    assert not hasattr(jax, NAME)


def test_a_jax_that_has_it_keeps_its_own(monkeypatch):
    own = object()
    monkeypatch.setattr(jax, NAME, own, raising=False)
    with device_put_replicated():
        assert getattr(jax, NAME) is own
    assert getattr(jax, NAME) is own


def test_each_device_gets_a_copy_that_pmap_takes(without):
    devices = jax.local_devices()[:2]
    tree = {"a": jnp.arange(3.0), "b": 7}
    with device_put_replicated():
        copies = getattr(jax, NAME)(tree, devices)
    sums = jax.pmap(lambda t: t["a"].sum() + t["b"], devices=devices)(copies)
    assert sums.tolist() == [10.0] * len(devices)
    assert {s.device for s in copies["a"].addressable_shards} == set(devices)


CONFIG = TrainConfig(toys.Options(), trainer="brax").replace(
    num_envs=24,
    num_timesteps=1000,
    seed=3,
    unroll_length=8,
    num_minibatches=4,
    num_updates_per_batch=5,
    discounting=0.98,
    gae_lambda=0.9,
    learning_rate=2e-4,
    clipping_epsilon=0.3,
    entropy_cost=1e-3,
    vf_coefficient=0.7,
    max_grad_norm=0.4,
    target_kl=0.03,
    reward_scaling=0.05,
)
GIVEN = {
    "seed": 3,
    "num_envs": 24,
    "unroll_length": 8,
    "num_minibatches": 4,
    "batch_size": 6,  # environments of a minibatch
    "num_updates_per_batch": 5,
    "discounting": 0.98,
    "gae_lambda": 0.9,
    "learning_rate": 2e-4,
    "clipping_epsilon": 0.3,
    "entropy_cost": 1e-3,
    "vf_loss_coefficient": 0.7,
    "max_grad_norm": 0.4,
    "learning_rate_schedule": "ADAPTIVE_KL",
    "desired_kl": 0.03,
    "reward_scaling": 0.05,
    "normalize_observations": True,
    # 6 iterations of 192 steps; Brax's epochs are their number less one
    "num_timesteps": 1152,
    "num_evals": 7,
}


def test_every_hyperparameter_has_its_place_in_braxs_trainer():
    given = trainer.arguments(toys.Counter(), CONFIG)
    assert {name: given[name] for name in GIVEN} == GIVEN
    assert set(given) <= set(inspect.signature(brax_ppo.train).parameters)


def test_without_a_target_the_learning_rate_stays():
    given = trainer.arguments(toys.Counter(), CONFIG.replace(target_kl=0.0))
    assert given["learning_rate_schedule"] == "NONE"


def test_a_training_step_of_brax_is_an_iteration_of_ours():
    given = trainer.arguments(toys.Counter(), CONFIG)
    step = given["batch_size"] * given["num_minibatches"] * given["unroll_length"]
    assert step == CONFIG.ppo.steps_per_iteration


def test_networks_are_ours_whatever_brax_proposes():
    factory = trainer.arguments(toys.Counter(), CONFIG)["network_factory"]
    networks = factory((3,), 1, preprocess_observations_fn=None)
    policy = networks.policy_network.init(jax.random.key(0))
    shapes = {leaf.shape for leaf in jax.tree.leaves(policy)}
    assert (3, CONFIG.ppo.hidden_sizes[0]) in shapes


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"resume": "runs/x"}, "resume"),
        ({"num_seeds": 2}, "num_seeds"),
        ({"num_envs": 6, "num_minibatches": 4}, "num_minibatches"),
    ],
)
def test_what_brax_cannot_do_is_refused_by_name(changes, named):
    with pytest.raises(ConfigError, match=named):
        CONFIG.replace(**changes)


def test_devices_share_environments_and_minibatches_equally(monkeypatch):
    monkeypatch.setattr(jax, "local_device_count", lambda: 4)
    assert trainer.devices(CONFIG) == 3  # 6 environments in a minibatch
    assert trainer.devices(CONFIG.replace(num_devices=2)) == 2
    assert trainer.devices(CONFIG.replace(num_envs=20)) == 1


COUNT, STEPS = 6, 24


def played(env, report_every=STEPS):
    """States after each step of zero actions, and the reports."""
    reports = []
    batch = Batch(env, report_every, reports.append)

    @jax.jit
    def play(key):
        start = batch.reset(jax.random.split(key, COUNT))
        action = jnp.zeros((COUNT, env.action_size))

        def step(state, _):
            state = batch.step(state, action)
            return state, (state.obs, state.reward, state.done, state.info)

        return start.obs, jax.lax.scan(step, start, None, length=STEPS)[1]

    result = jax.device_get(play(jax.random.PRNGKey(0)))
    jax.effects_barrier()
    return result, reports


@pytest.fixture(scope="module")
def counted():
    return played(toys.Counter())


def test_an_episode_that_ends_is_followed_by_a_new_start(counted):
    (first, (obs, _, done, _)), _ = counted
    draws = np.concatenate([first[None], obs])[..., 2]  # one number for each start
    changed = draws[1:] != draws[:-1]
    assert np.array_equal(changed, done > 0.5)
    assert len(np.unique(draws)) == COUNT + done.sum()


def test_the_time_limit_truncates_and_the_task_terminates(counted):
    (_, (_, reward, done, info)), _ = counted
    truncation = info["truncation"]
    assert truncation.sum() and (done - truncation).sum()
    assert np.array_equal(done - truncation, -reward)  # the toy's end costs 1


def test_a_report_has_the_sums_of_all_steps(counted):
    (_, (_, reward, done, _)), (report,) = counted
    assert report.step_sums["collision"] == -reward.sum()
    assert 0 < report.episodes <= done.sum()  # without those that only staggering cut
    assert report.episode_sums["return"] == reward.sum()


def test_reports_come_at_equal_distances():
    _, reports = played(toys.Counter(), report_every=STEPS // 4)
    assert len(reports) == 4


def test_a_step_that_becomes_nonfinite_is_left_out_by_braxs_losses():
    (_, (obs, reward, done, info)), (report,) = played(toys.Exploding())
    assert report.nonfinite > 0
    assert np.isfinite(obs).all() and np.isfinite(reward).all()
    left_out = info["truncation"] > 0.5
    assert left_out.sum() == report.nonfinite
    assert (done[left_out] == 1.0).all() and (reward[left_out] == 0.0).all()

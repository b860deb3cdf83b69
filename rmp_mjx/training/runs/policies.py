"""Policies of runs: found by name, read from checkpoints or files, written to files."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rmp_mjx.files import read_json
from rmp_mjx.training.config import ConfigError, TrainConfig
from rmp_mjx.training.learning import seeds
from rmp_mjx.training.learning.networks import Agent, make_agent
from rmp_mjx.training.learning.ppo import make_ppo
from rmp_mjx.training.learning.rollout import Env
from rmp_mjx.training.policy import SUFFIX, is_policy, load_policy, save_policy
from rmp_mjx.training.runs import identity, run_folder
from rmp_mjx.training.runs.checkpoint import NEWEST, Checkpointer

CONDITIONS = ("episodes", "task", "deterministic", "engine")
"""Names in an evaluation that say how it was made."""
RATE = "_rate"
"""In names of an evaluation's shares of episodes and of their intervals."""
MEAN = "return_mean"
"""Name of an evaluation's return, and beginning of its interval's."""


def find(run: str) -> Path:
    """The run folder or the policy file of a name; NAME may stand for NAME.safetensors.

    FOLDER/NAME is also found in FOLDER.safetensors, a file of many policies.

    Raises:
        ConfigError: There is neither.
    """
    path = Path(run)
    file = path if path.suffix == SUFFIX else path.with_name(path.name + SUFFIX)
    for found in (path, file):
        if found.is_dir() or is_policy(found):
            return found
    raise ConfigError(f"{run} is neither a run folder nor a policy file ({file.name})")


def results_of(path: Path) -> Path:
    """Where evaluations of a run or a policy go: the run's folder, or runs/NAME."""
    if path.suffix != SUFFIX:
        return path
    return path.parent if path.name == run_folder.POLICY else Path("runs") / path.stem


def load_agent(
    env: Env,
    config: TrainConfig,
    path: Path,
    deterministic: bool,
    note: Callable[[str], None],
    seed_index: int = 0,
    checkpoint: str = NEWEST,
    besides: Sequence[str] = (),
) -> tuple[int, Agent]:
    """Read the policy of a run, or of a policy file.

    Args:
        env: The environment it was trained on, or one with the same sizes.
        config: Configuration of the run.
        path: Run folder or policy file.
        deterministic: Act with the mean action.
        note: Called with one line for each damaged checkpoint.
        seed_index: Which agent, if the run trained several seeds.
        checkpoint: `newest`, `best`, or a number; a file has one policy.
        besides: What may differ of the environment's identity, for instance its arm.

    Returns:
        Iterations that trained the policy, and the policy.

    Raises:
        CheckpointError: There is no usable checkpoint.
        ConfigError: The policy was trained in another environment.
        PolicyError: The policy file cannot be used, or not for this environment.
    """
    if not path.is_dir():
        policy = load_policy(path)
        identity.check(policy.about.get(identity.KEY, {}), env, path, besides)
        agent = policy.agent(env.observation_size, env.action_size, deterministic)
        return policy.about["iterations"], agent
    own = path / run_folder.CONFIG
    identity.check(identity.saved(own), env, path, besides)
    ppo = make_ppo(env, config.ppo)
    whole = seeds.shapes(ppo, config.ppo)
    learner = whole.learner.replace(value=None, policy_opt=None, value_opt=None)
    needed = whole.replace(
        learner=learner, scale=None, rollout=None, key=None, iteration=None
    )
    checkpoints = Checkpointer(
        path / run_folder.CHECKPOINTS, read_only=True, run_id=identity.run_id(own)
    )
    step, state = checkpoints.restore(needed, note, checkpoint)
    checkpoints.close()
    stacked = make_agent(
        ppo.networks, state.normalizer, state.learner.policy, deterministic
    )
    return step, seeds.of_seed(stacked, seed_index, config.ppo)


def changed_software(path: Path) -> list[str]:
    """What is not as it was when a run or a policy was trained; starts no backend."""
    if path.is_dir():
        return run_folder.changed_software(path)
    before = load_policy(path).about["versions"]
    return run_folder.changes_since([before], run_folder.software())


def save(
    agent: Agent,
    config: TrainConfig,
    folder: Path,
    iterations: int,
    evaluated: bool,
) -> list[Path]:
    """Write the policy of every seed of a run.

    Args:
        agent: The policies, stacked where there are several seeds.
        config: Configuration of the run.
        folder: Its folder.
        iterations: Iterations of training behind the policies.
        evaluated: Whether each seed's folder has the evaluation of this policy.

    Returns:
        The files.
    """
    written = []
    for k, place in enumerate(run_folder.seed_folders(config, folder)):
        figures = evaluation(place) if evaluated else None
        about = describe(config, k, folder, iterations, figures)
        place.mkdir(parents=True, exist_ok=True)
        written.append(place / run_folder.POLICY)
        save_policy(written[-1], seeds.of_seed(agent, k, config.ppo), about)
    return written


def describe(
    config: TrainConfig,
    seed_index: int,
    folder: Path,
    iterations: int,
    evaluation: Mapping[str, Any] | None,
) -> dict[str, Any]:
    """What a policy file says of the policy of one of a run's seeds.

    Args:
        config: Configuration of the run.
        seed_index: Which of its seeds, from 0.
        folder: The run's folder.
        iterations: Iterations of training behind the policy.
        evaluation: Figures of its evaluation, if there is one.

    Returns:
        JSON-ready: `config`, as in config.json but of this seed alone and without what
        may differ between a run and its continuation; `environment`, its identity;
        `iterations`, `steps`, `versions`, and where there is one `evaluation`, in the
        task of the training unless it names another.
    """
    own = config.replace(num_seeds=1, seed=config.ppo.seed + seed_index).record()
    own["run"] = {"num_timesteps": config.run.num_timesteps}
    about = {
        "config": own,
        identity.KEY: identity.saved(folder / run_folder.CONFIG),
        "iterations": iterations,
        "steps": iterations * config.ppo.steps_per_iteration,
        "versions": run_folder.trained_with(folder),
    }
    return about | ({"evaluation": dict(evaluation)} if evaluation else {})


def evaluation(folder: Path) -> dict[str, Any] | None:
    """The figures of a folder's eval.json that a policy file repeats, if it exists."""
    path = folder / run_folder.EVALUATION
    return repeated(read_json(path)) if path.exists() else None


def repeated(summary: Mapping[str, Any]) -> dict[str, Any]:
    """The figures of an evaluation that a policy file repeats.

    They are the number of episodes, the return, and the shares of episodes that
    succeeded or had an event, with their intervals; and how the episodes were run.
    """
    return {
        name: value
        for name, value in summary.items()
        if name in CONDITIONS or name.startswith(MEAN) or RATE in name
    }

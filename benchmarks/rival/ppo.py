"""A small PPO in PyTorch, with the settings of our default run."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import mujoco
import mujoco.batch
import numpy as np
import torch  # pyright: ignore[reportMissingImports]
from torch import nn  # pyright: ignore[reportMissingImports]

from benchmarks.peers.worker import Measure, rate, serve
from benchmarks.rival import controller
from benchmarks.rival.task import ACTION_SIZE, OBSERVATION_SIZE, Trajectory

UNROLL, MINIBATCHES, EPOCHS = 16, 8, 10
DISCOUNT, LAMBDA, CLIP, TARGET_KL = 0.99, 0.97, 0.2, 0.02


def network(outputs: int) -> nn.Sequential:
    """Two hidden layers of 64, tanh."""
    return nn.Sequential(
        nn.Linear(OBSERVATION_SIZE, 64),
        nn.Tanh(),
        nn.Linear(64, 64),
        nn.Tanh(),
        nn.Linear(64, outputs),
    )


class Moments:
    """Running mean and deviation, one for each column."""

    def __init__(self, size: int):
        """Nothing seen yet."""
        self.mean, self.var, self.count = np.zeros(size), np.ones(size), 1e-4

    def add(self, x: np.ndarray) -> None:
        """Update with a batch (Chan et al., 1979)."""
        n, step = len(x), x.mean(axis=0) - self.mean
        total = self.count + n
        spread = self.var * self.count + x.var(axis=0) * n
        self.var = (spread + step**2 * self.count * n / total) / total
        self.mean, self.count = self.mean + step * n / total, total

    @property
    def std(self) -> np.ndarray:
        """Deviation, floored."""
        return np.maximum(np.sqrt(self.var), 1e-3)

    def normalise(self, x: np.ndarray) -> torch.Tensor:
        """In units of the deviation, clipped to ten of them."""
        y = np.clip((x - self.mean) / self.std, -10.0, 10.0)
        return torch.as_tensor(y, dtype=torch.float32)


def train(env: Trajectory, seed: int = 0) -> Iterator[dict[str, float]]:
    """Train for ever; yields after each iteration of `UNROLL` steps.

    Yields:
        Finished episodes and how many of them were solved.
    """
    torch.manual_seed(seed)
    policy, value = network(ACTION_SIZE), network(1)
    with torch.no_grad():
        policy[-1].weight *= 0.1
        policy[-1].bias.zero_()
    log_std = nn.Parameter(torch.full((ACTION_SIZE,), -0.5))
    actor = [*policy.parameters(), log_std]
    optimizers = (
        torch.optim.Adam(actor, lr=3e-4, eps=1e-5, fused=True),
        torch.optim.Adam(value.parameters(), lr=1e-3, eps=1e-5, fused=True),
    )
    moments, targets = Moments(OBSERVATION_SIZE), Moments(1)

    def log_density(obs: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        z = (action - policy(obs)) * torch.exp(-log_std)
        return -0.5 * (z * z).sum(1) - log_std.sum()

    def values(obs: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            out = value(moments.normalise(obs))[:, 0].numpy()
        return out * targets.std[0] + targets.mean[0]

    obs = env.observe()
    moments.add(obs)
    size = env.size
    while True:
        rows: dict[str, list] = {
            name: [] for name in ("obs", "next", "act", "r", "e", "d")
        }
        solved = ended = 0
        for _ in range(UNROLL):
            with torch.no_grad():
                mean = policy(moments.normalise(obs))
                action = mean + torch.exp(log_std) * torch.randn_like(mean)
            out = env.step(action.numpy())
            going_on = ~(out.terminated | out.truncated)
            values_of = (
                obs,
                out.next_obs,
                action,
                out.reward,
                out.terminated,
                going_on,
            )
            for name, x in zip(rows, values_of, strict=True):
                rows[name].append(x)
            solved += int(out.success.sum())
            ended += int((~going_on).sum())
            obs = out.obs
        seen, after = np.concatenate(rows["obs"]), np.concatenate(rows["next"])
        v, v_after = (values(x).reshape(UNROLL, size) for x in (seen, after))
        delta = np.array(rows["r"]) + DISCOUNT * ~np.array(rows["e"]) * v_after - v
        advantage = np.zeros((UNROLL + 1, size))
        for t in reversed(range(UNROLL)):
            later = rows["d"][t] * advantage[t + 1]
            advantage[t] = delta[t] + DISCOUNT * LAMBDA * later
        advantage = advantage[:-1]
        wanted = (advantage + v).reshape(-1, 1)
        targets.add(wanted)
        x, actions = moments.normalise(seen), torch.cat(rows["act"])
        adv = torch.as_tensor(advantage.reshape(-1), dtype=torch.float32)
        adv = (adv - adv.mean()) / (adv.std() + 1e-8)
        goal = torch.as_tensor((wanted - targets.mean) / targets.std)[:, 0].float()
        with torch.no_grad():
            old = log_density(x, actions)
        policy_may = True
        for _ in range(EPOCHS):
            kls = []
            for i in torch.randperm(len(x)).chunk(MINIBATCHES):
                log_ratio = log_density(x[i], actions[i]) - old[i]
                ratio = torch.exp(log_ratio)
                kls.append((ratio - 1.0 - log_ratio).mean().item())
                clipped = torch.clamp(ratio, 1.0 - CLIP, 1.0 + CLIP)
                loss = 0.5 * ((value(x[i])[:, 0] - goal[i]) ** 2).mean()
                if policy_may:
                    loss = loss - torch.minimum(ratio * adv[i], clipped * adv[i]).mean()
                for optimizer in optimizers:
                    optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(value.parameters(), 1.0)
                optimizers[1].step()
                if policy_may:
                    nn.utils.clip_grad_norm_(actor, 1.0)
                    optimizers[0].step()
            policy_may &= bool(np.mean(kls) <= 1.5 * TARGET_KL)
        moments.add(seen)
        yield {"episodes": ended, "solved": solved}


CONTROLLERS = {"rmp_vices": controller.rmp_vices, "vices": controller.vices}


class Rival:
    """The measures of the rival.

    Args:
        scene: The compiled scene.
        arrays: The problem.
        num_envs: Environments of a training.
    """

    def __init__(self, scene: Path, arrays: Path, num_envs: int):
        """Read the problem."""
        self.model = mujoco.MjModel.from_binary_path(str(scene))
        self.arrays = dict(np.load(arrays))
        constants = {
            name: self.arrays[f"arm_{name}"] for name in controller.Arm._fields
        }
        constants |= {"site": int(constants["site"])}
        constants |= {"table": float(constants["table"])}
        self.arm, self.num_envs = controller.Arm(**constants), num_envs

    def torques(self, name: str):
        """A call of the controller on the problem's states, and its result."""
        given = self.arrays
        size = len(given["q"])
        batch = mujoco.batch.Batch(self.model, size, persistent=True)
        fields = controller.Fields(
            *(batch.bind(field) for field in controller.Fields._fields)
        )
        fields.qpos[:], fields.qvel[:] = given["q"], given["qd"]
        batch.forward()
        spheres = np.broadcast_to(given["spheres"], (size, *given["spheres"].shape))
        tau = np.zeros_like(given["q"])
        args = (given["p_des"], given["R_des"], given["kp"], spheres.copy(), tau)
        return partial(CONTROLLERS[name], self.arm, fields, *args), tau

    def disagreement(self, name: str) -> Measure:
        """Largest difference of a torque to ours, over the joint's limit."""
        call, tau = self.torques(name)
        call()
        error = np.abs(tau - self.arrays[f"tau_{name}"]) / self.arm.tau_max
        return lambda seconds: float(error.max())

    def evals(self, name: str) -> Measure:
        """Evaluations a second of the whole batch."""
        call, tau = self.torques(name)
        return rate(call, len(tau))

    def env_steps(self, name: str) -> Measure:
        """Policy steps a second under random actions."""
        env = Trajectory(self.model, self.arm, CONTROLLERS[name], self.num_envs)
        rng = np.random.default_rng(1)
        return rate(lambda: env.step(rng.uniform(-1.0, 1.0, (env.size, 12))), env.size)

    def training(self, name: str) -> Measure:
        """Policy steps a second of training, updates included."""
        env = Trajectory(self.model, self.arm, CONTROLLERS[name], self.num_envs)
        iterations = train(env)
        return rate(lambda: next(iterations), env.size * UNROLL)


if __name__ == "__main__":
    # Before the first parallel loop: its threads must not spin while MuJoCo's work.
    os.environ["OMP_WAIT_POLICY"] = "passive"
    torch.set_num_threads(1)  # faster than two for networks and batches of this size
    rival = Rival(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]))
    serve(
        {
            f"{what}_{name}": partial(getattr(rival, what), name)
            for what in ("disagreement", "evals", "env_steps", "training")
            for name in CONTROLLERS
        },
        ("numba", "torch", "mujoco", "numpy"),
    )

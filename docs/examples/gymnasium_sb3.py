"""A task as a Gymnasium environment, learned by Stable-Baselines3.

    pip install '.[train,gym]' stable-baselines3
    python docs/examples/gymnasium_sb3.py

Stable-Baselines3 steps one environment at a time: this shows that it works, not speed.
"""

import numpy as np
from rmp_mjx_envs.gym import TaskEnv

import rmp_mjx_envs as envs


def main(steps: int = 20_000) -> float:
    """Return of one episode after so many policy steps of training."""
    from stable_baselines3 import PPO

    task = TaskEnv(envs.load("trajectory", episode_length=128))
    model = PPO("MlpPolicy", task, n_steps=min(steps, 1024), seed=0, device="cpu")
    model.learn(steps)
    return episode(task, lambda obs: model.predict(obs, deterministic=True)[0])


def episode(task: TaskEnv, act) -> float:
    """Return of an episode of a policy, observation to action."""
    obs, _ = task.reset(seed=1)
    total, over = 0.0, False
    while not over:
        obs, reward, terminated, truncated, _ = task.step(np.asarray(act(obs)))
        total, over = total + reward, terminated or truncated
    return total


if __name__ == "__main__":
    print(f"return of an episode: {main():.1f}")

"""The model card: what a policy is, what was measured, and what was not."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

RATES = {
    "success_rate": "success",
    "collision_rate": "ended in a collision of arm or hand",
    "self_collision_rate": "self-collision",
    "joint_limit_rate": "within 0.1 rad of a joint limit",
    "joint_velocity_rate": "joint velocity beyond the limit",
    "torque_rate_rate": "torque rate beyond the limit",
    "at_fault_rate": "contact with own speed above 1 cm/s",
}
"""What the card says of an evaluation, by the name of the figure."""


def card(metadata: Mapping[str, Any], about: Mapping[str, Any]) -> str:
    """A model card in Markdown.

    Args:
        metadata: Of the exported file.
        about: What the policy's file or run says of it.
    """
    robot, config = metadata["robot"], about.get("config", {})
    trained = config.get("task", {})
    lines = [
        f"# {metadata['task']}, {metadata['controller']}, {robot['name']}",
        "",
        f"A policy at {1 / metadata['policy_period']:g} Hz behind the controller "
        f"`{metadata['controller']}` at {1 / metadata['period']:g} Hz, exported by "
        f"rmp_mjx {metadata['versions']['rmp-mjx']}.",
        "",
        "## Arm",
        "",
        f"`{robot['name']}`, {len(robot['joints'])} joints, fingerprint "
        f"`{robot['fingerprint']}`. {robot['tool']} The base stands at "
        f"{robot['mount']} m in the task's frame.",
        "",
        "## Guard",
        "",
        guarded(metadata),
        "",
        "## Training",
        "",
        f"{about.get('steps', 'an unknown number of')} steps in simulation with the "
        f"arm `{trained.get('robot', 'unknown')}`, "
        f"{trained.get('obstacles', 0)} spheres, "
        f"control every {1e3 * trained.get('sim_dt', float('nan')):g} ms; versions: "
        + ", ".join(f"{k} {v}" for k, v in about.get("versions", {}).items())
        + ".",
        "",
        "## Measured in simulation",
        "",
        *_figures(about.get("evaluation")),
        "",
        "## Not tested",
        "",
        *(f"* {line}" for line in untested(metadata, trained)),
        "",
    ]
    return "\n".join(lines)


def _figures(evaluation: Mapping[str, Any] | None) -> list[str]:
    if not evaluation:
        return ["The run has no evaluation: run `eval.py` before you use the policy."]
    own = evaluation.get("task")
    where = "the task of the training"
    if isinstance(own, Mapping):
        where = ", ".join(
            f"{k} {own[k]}" for k in ("robot", "obstacles", "layout") if k in own
        )
    lines = [
        f"{evaluation.get('episodes')} episodes, {evaluation.get('engine', '')}, "
        f"{'mean actions' if evaluation.get('deterministic') else 'sampled actions'}; "
        f"in: {where}.",
        "",
        "| share of episodes | % | 95 % interval |",
        "|---|---|---|",
    ]
    for name, words in RATES.items():
        if name in evaluation:
            low, high = evaluation.get(f"{name}_ci95", (float("nan"), float("nan")))
            lines.append(
                f"| {words} | {100 * evaluation[name]:.1f} "
                f"| {100 * low:.1f} to {100 * high:.1f} |"
            )
    return lines


def guarded(metadata: Mapping[str, Any]) -> str:
    """What stands behind the controller, in a sentence."""
    guard = metadata["guard"]
    if guard is None:
        return "None: a contact may find the arm moving."
    return (
        f"A torque passes only if the arm can stop after it: whatever touches the arm, "
        f"itself no faster than {guard['obstacle_speed']:g} m/s, finds it slower than "
        f"{guard['speed']:g} m/s, under the assumptions of docs/guard.md."
    )


def untested(metadata: Mapping[str, Any], trained: Mapping[str, Any]) -> list[str]:
    """What nobody has tried with this policy, in sentences."""
    arm = trained.get("robot")
    lines = ["A real arm: every figure above is from simulation."]
    if arm != metadata["robot"]["name"]:
        lines.append(
            f"The figures are of the arm '{arm}', not of '{metadata['robot']['name']}'."
        )
    if trained.get("sim_dt") != metadata["period"]:
        lines.append("The figures are of another control period than the exported one.")
    noise = ("position_noise", "velocity_noise", "obstacle_noise", "obstacle_delay")
    quiet = [name.replace("_", " ") for name in noise if not trained.get(name)]
    if quiet:
        lines.append(f"Training had no {', no '.join(quiet)}.")
    lines += [
        "People in the workspace. The barriers are soft: collisions are rare by "
        "measurement, not impossible by proof.",
        "Obstacles that the source of obstacles does not report.",
        "Payloads and tools other than the one above.",
    ]
    return lines

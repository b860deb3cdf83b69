"""Run the tests that mirror the modules which differ from the last commit.

Run as ``python -m tests.changed``. Exit code 0 if no test fails.
"""

import subprocess
import sys
from pathlib import Path

OTHERS = {
    "rmp/leaf": "rmp/test_leaves control/test_contact",
    "rmp/leaves/attractor": "rmp/test_formulas rmp/test_leaves",
    "rmp/leaves/barrier": "rmp/test_formulas rmp/test_leaves control/test_contact",
    "rmp/leaves/collision": "rmp/test_formulas rmp/test_leaves",
    "rmp/leaves/joint_limit": "rmp/test_formulas rmp/test_leaves control/test_contact",
    "rmp/leaves/posture": "rmp/test_formulas rmp/test_leaves",
    "control/contact": "control/test_contact control/test_controller",
    "control/controller": "control/test_controller control/test_guard",
    "control/guard": "control/test_guard_terms control/test_guard",
    "control/leaves": "control/test_tree_equivalence control/test_pytree",
    "control/literal": "control/test_controller rmp/test_leaves",
    "control/relaxation": "control/test_dither control/test_controller",
    "control/rmp_vices": "control/test_tree_equivalence control/test_controller",
    "control/tree": "control/test_tree_equivalence",
    "control/vices": "control/test_vices control/test_controller",
    "robot/control_points": "robot/test_control_points robot/test_model",
    "robot/dynamics": "robot/test_dynamics robot/test_passive_forces robot/test_bounds",
    "robot/enclose": "robot/test_enclose robot/test_enclose_search",
    "robot/errors": "robot/test_errors robot/test_mjcf",
    "robot/fingerprint": "robot/test_fingerprint robot/test_model",
    "robot/kinematics": "robot/test_kinematics robot/test_model",
    "robot/limits": "robot/test_model robot/test_mjcf robot/test_library",
    "robot/links": "robot/test_model robot/test_mjcf",
    "robot/model": "robot/test_model robot/test_dynamics robot/test_library",
    "robot/mjcf": "robot/test_mjcf robot/test_model robot/test_passive_forces",
    "robot/motors": "robot/test_motors robot/test_passive_forces",
    "robot/point_state": "robot/test_point_state robot/test_kinematics",
}
"""Tests of the modules without a test file of their own name, or with more than it."""


def mirrors(module: str) -> list[str]:
    """The test files that mirror a module: of its name, or of its folder's."""
    path = Path(module).relative_to("rmp_mjx").with_suffix("")
    listed = OTHERS.get(str(path), "").split()
    own = path.parent / f"test_{path.name}"
    folders = path.parent.parent / f"test_{path.parent.name}"
    files = [f"tests/{name}.py" for name in listed or (own, folders)]
    return [name for name in files if Path(name).exists()][: len(listed) or 1]


def main() -> int:
    diff = subprocess.check_output(["git", "diff", "--name-only"], text=True)
    modules = [name for name in diff.split() if name.startswith("rmp_mjx/")]
    files = sorted({name for module in modules for name in mirrors(module)})
    options = ["-x", "-q", "--no-header", "--tb=no", "-p", "no:cacheprovider"]
    ended = subprocess.run([sys.executable, "-m", "pytest", *options, *files])
    nothing_ran = 5
    return ended.returncode if files and ended.returncode != nothing_ran else 0


if __name__ == "__main__":
    sys.exit(main())

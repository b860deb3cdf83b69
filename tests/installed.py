"""What an installed package must do, in an environment of its own (`make wheel`).

Run by a Python that has the package and its core dependencies, from another folder.
"""

import importlib.resources
import importlib.util
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import rmp_mjx as rmp
from rmp_mjx import runtime


def main() -> None:
    """Import, then control an arm beside a sphere."""
    runtime.configure()
    place = Path(rmp.__file__).resolve()
    assert Path(sys.prefix).resolve() in place.parents, f"imported from {place}"
    assert (importlib.resources.files("rmp_mjx") / "py.typed").is_file()
    for absent in ("envs", "train", "eval", "export", "tests", "benchmarks"):
        assert importlib.util.find_spec(absent) is None, f"{absent} is installed"
    for absent in ("brax", "polars", "tyro", "matplotlib"):
        assert importlib.util.find_spec(absent) is None, f"{absent} is not asked for"
    for name in ("train", "eval", "replay", "export", "check-robot"):
        command = [Path(sys.executable).with_name(f"rmp-mjx-{name}"), "--help"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 2, done
        assert "pip install 'rmp-mjx[train]'" in done.stderr, done.stderr
        assert len(done.stderr.splitlines()) == 1, done.stderr

    robot = rmp.Robot.load("jaco2")
    q, qd = jnp.asarray(robot.q_home, jnp.float32), jnp.zeros(robot.n)
    obstacles = rmp.Obstacles.empty(spheres=1, planes=1).with_spheres(
        jnp.array([[0.45, 0.10, 0.30]]), jnp.array([0.05])
    )
    zero, stiff = jnp.zeros(3), jnp.full(3, 200.0)
    rest = rmp.Action(dpos=zero, drot=zero, kp_pos=stiff, kp_ori=stiff)
    data = mujoco.MjData(model := robot.mj_model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    for controller in (rmp.RMPVICES(robot), rmp.VICES(robot)):
        setpoint = controller.setpoint(q, rest, 0.0)
        out = jax.jit(controller)(q, qd, setpoint, obstacles)
        assert out.tau.shape == (robot.n,) and bool(jnp.all(jnp.isfinite(out.tau)))
        # At rest on its target VICES holds the arm against gravity, as MuJoCo has it;
        # 1e-3 N m: float32.
        if isinstance(controller, rmp.VICES):
            np.testing.assert_allclose(out.tau, data.qfrc_bias, atol=1e-3)
    print(f"rmp_mjx {rmp.__version__} from {place.parent}: controllers evaluated")


if __name__ == "__main__":
    main()

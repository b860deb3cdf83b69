"""One policy exported for the FR3, and a loop over it in MuJoCo."""

from types import SimpleNamespace

import jax
import mujoco
import pytest

import envs
from envs import export
from envs.deployment import controller_of
from envs.flags import load_config
from rmp_mjx import deploy
from rmp_mjx.sim.robot import MujocoBackend
from rmp_mjx.training.runs import policies

ROOT = "pretrained/trajectory-rmp_vices-panda"


@pytest.fixture(scope="session")
def exported(root, tmp_path_factory):
    """The file that `export.py` writes."""
    file = tmp_path_factory.mktemp("deploy") / "fr3.rmp"
    run = str(root / ROOT)
    assert export.main([run, "--robot", "fr3", "--out", str(file)]) == 0
    return file


@pytest.fixture(scope="session")
def deployed(exported):
    return deploy.load(exported)


@pytest.fixture(scope="session")
def trained(root):
    """The same policy and controller as training has them, at the loop's period."""
    path = policies.find(str(root / ROOT))
    config = load_config(path)
    env = envs.load("trajectory", robot="fr3", physics="mujoco")
    _, agent = policies.load_agent(
        env, config, path, True, pytest.fail, besides=("arm",)
    )
    controller = controller_of(env, 0.001)
    return SimpleNamespace(
        env=env, agent=agent, controller=controller, key=jax.random.key(0)
    )


@pytest.fixture
def simulated(trained):
    """The FR3 of the tasks in MuJoCo, at the start of the task."""
    model = trained.env.robot.mj_model
    model.opt.timestep = 0.001
    data = mujoco.MjData(model)
    data.qpos[:] = trained.env.robot.q_home
    return MujocoBackend(model, data, 7)


@pytest.fixture
def source(deployed):
    """The table, measured at time 0 of a clock that the test turns."""
    clock = SimpleNamespace(now=0.0)
    found = deploy.ObstacleSource(deployed.obstacles(), clock=lambda: clock.now)
    found.put("planes", point=[[0.0, 0.0, -0.112]], normal=[[0.0, 0.0, 1.0]])
    return SimpleNamespace(source=found, clock=clock)

"""Names and options that do not exist are refused before anything compiles."""

from typing import Any, get_args, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.door import VARIANTS, DoorOptions
from envs.options import CONTROLLERS, Options, substeps
from envs.placement import LAYOUTS
from rmp_mjx import RMPVICES, sim
from rmp_mjx.rmp.leaves import PaperCollision, collision_near
from rmp_mjx.robot import Robot


def test_an_unknown_task_lists_the_tasks_and_suggests_one():
    with pytest.raises(ValueError, match=r"'trajectry'.*trajectory.*Did you mean"):
        envs.load("trajectry")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"obstacle": 2}, "'obstacle'.*obstacles.*Did you mean 'obstacles'"),
        ({"controller": "pid"}, "'pid'.*rmp_vices, vices"),
        ({"physics": "bullet"}, "'bullet'.*auto, mujoco, mjx"),
        ({"layout": "near"}, "'near'.*far, close"),
        ({"observation": "image"}, "'image'.*rotated, fixed"),
        ({"armature": "none"}, "'none'.*physical, robosuite"),
        ({"controller": "vices", "leaf_weights": True}, "leaf_weights.* rmp_vices; v"),
        ({"obstacles": -1}, "obstacles must be at least 0"),
        ({"sphere_radius": 0.0}, "sphere_radius must be positive"),
        ({"sim_dt": 0.004}, "0.004 s does not divide the policy step of 0.05 s"),
        ({"sim_dt": 0.0}, "sim_dt must be in"),
        ({"sim_dt": -0.005}, "sim_dt must be in"),
        ({"sim_dt": 0.1}, "sim_dt must be in"),
        ({"sim_dt": 1e-5}, "sim_dt must be in"),
        ({"sim_dt": float("nan")}, "sim_dt must be finite"),
        ({"obstacles": 10**5}, "obstacles must be at most"),
        ({"obstacles": 2.5}, "obstacles must be a whole number"),
        ({"observer": "perfect"}, "'perfect'.*none, momentum, exact"),
        ({"observer_gain": 0.0}, "observer_gain must be positive"),
        ({"observer_noise": -0.1}, "observer_noise must be at least 0"),
        ({"observer_delay": 0.007}, "0.007 s is no multiple of the control step"),
    ],
)
@pytest.mark.filterwarnings("ignore:Attach conflict")
def test_a_wrong_option_is_refused_with_the_valid_ones(options, message):
    with pytest.raises(ValueError, match=message):
        envs.load("trajectory", **options)


def test_the_names_that_options_take_are_the_names_that_exist():
    kind = get_type_hints(Options)
    assert get_args(kind["controller"]) == tuple(CONTROLLERS)
    assert get_args(kind["physics"]) == sim.NAMES
    assert get_args(kind["layout"]) == tuple(LAYOUTS)
    assert get_args(get_type_hints(DoorOptions)["variant"]) == tuple(VARIANTS)
    for name in get_args(kind["armature"]):
        Robot.load("jaco2", armature=name)


def test_leaf_weights_are_three_more_entries_of_an_action():
    for name in envs.names():
        env = envs.load(name, physics="mujoco", leaf_weights=True)
        assert env.action_size == 15
        start = jax.eval_shape(env.reset, jax.random.key(0))
        jax.eval_shape(env.step, start, jnp.zeros(15))
    env = envs.load("push", physics="mujoco", leaf_weights=True)
    own = RMPVICES(env.robot)
    with pytest.raises(ValueError, match="action_range=WeightedActionRange"):
        envs.load("push", physics="mujoco", leaf_weights=True, controller=own)
    assert envs.load("push", physics="mujoco", controller=env.controller).action_size


def test_options_are_the_same_by_name_and_made_by_hand():
    made = envs.make_options("door", variant="heavy", obstacles=2)
    assert made == DoorOptions(variant="heavy", obstacles=2)
    assert made.record() | {"env": "door"} == made.record()
    assert envs.make_options(**made.record()) == made


@pytest.mark.parametrize("sim_dt", [0.001, 0.002, 0.0025, 0.005, 0.01, 0.05])
def test_a_policy_step_lasts_its_physics_steps(sim_dt):
    n = substeps(sim_dt)
    assert n * sim_dt == pytest.approx(0.05, abs=1e-12)


def test_the_physics_steps_by_the_chosen_timestep():
    env = envs.load("trajectory", physics="mujoco", sim_dt=0.0025)
    assert env.scene.model.opt.timestep == 0.0025
    assert env.n_substeps == 20
    assert env.dt == 0.05 and env.action_size == 12


def test_only_the_watched_pairs_can_collide():
    """Table with all links that can reach it, spheres with all moving links."""
    scene = envs.load("trajectory", physics="mujoco", obstacles=2).scene
    model = scene.model
    assert not model.geom_contype.any() and not model.geom_conaffinity.any()
    pairs = [model.pair(k).name for k in range(model.npair)]
    links = [f"arm/link_{i}" for i in range(1, 7)] + ["arm/hand", "arm/fingers"]
    for link in links:
        assert (f"{link}/table" in pairs) == (link != "arm/link_1")
        assert f"{link}/sphere_0" in pairs and f"{link}/sphere_1" in pairs
    assert np.all(
        scene.hand.astype(int) + scene.arm + scene.self_pairs + scene.work == 1
    )
    assert np.sum(scene.hand) == 2 * 3  # hand and fingers, with table and two spheres


def collision_of(env) -> Any:
    """The collision leaves of a task's controller."""
    assert isinstance(env.controller, RMPVICES)
    return env.controller.leaves.collision


def test_a_controller_object_is_taken_as_it_is_and_a_named_one_has_its_leaves():
    own = RMPVICES(envs.load("push", physics="mujoco").robot)
    assert envs.load("push", physics="mujoco", controller=own).controller is own
    literal = envs.load("push", physics="mujoco", controller="rmp_vices_literal")
    assert isinstance(collision_of(literal), PaperCollision)
    assert collision_of(envs.load("door", physics="mujoco")) == collision_near()

"""Arms in the tasks: where they stand, how they start, what they reach."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from benchmarks.studies import experts
from envs.arms import JACO, fit, need, stored
from envs.push import REST_HEIGHT
from envs.scene import TABLE_HEIGHT, build_scene
from envs.stands import lead, search
from rmp_mjx import Robot, RobotError
from rmp_mjx.robot.configurations import capsule_ends, capsule_gaps

ARMS = ["panda", "fr3", "ur5e", "iiwa14"]
TASKS = list(envs.ENVS)


@functools.cache
def scene(name, task):
    """Scene of a task with an arm; nothing of JAX is built."""
    fitted = fit(name, envs.ENVS[task])
    made = object.__new__(envs.ENVS[task])
    made.options = envs.make_options(task)
    return build_scene(fitted.robot, 0.005, objects=made.objects, mount=fitted.mount)


def posed(model, site, q):
    """The state in MuJoCo C, and position and orientation of a site."""
    data = mujoco.MjData(model)
    data.qpos[: len(q)] = q
    if model.nq > len(q) + 1:
        data.qpos[len(q) :][:3] = [0.47, 0.0, REST_HEIGHT]  # the block
    mujoco.mj_forward(model, data)
    return data, data.site(site).xpos.copy(), data.site(site).xmat.reshape(3, 3).copy()


def test_every_shipped_arm_that_can_has_a_place():
    assert list(stored()) == ARMS


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("name", ARMS)
def test_the_grip_starts_where_the_jacos_does_without_contact(name, task):
    jaco, start = Robot.load(JACO), envs.ENVS[task].q_start
    _, p, R = posed(jaco.mj_model, "grip", start)
    fitted = fit(name, envs.ENVS[task])
    model = scene(name, task).model
    data, q, S = posed(model, "arm/grip", fitted.start)
    # Joint coordinates are rounded to 1e-6, models to six digits.
    np.testing.assert_allclose(q, p, atol=1e-5)
    np.testing.assert_allclose(S, R, atol=1e-5)
    touching = [c for c in data.contact if "arm/" in _names(model, c) and c.dist < 0]
    assert not touching


def _names(model, contact):
    return " ".join(model.geom(g).name for g in contact.geom)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("name", ARMS)
def test_an_arm_gets_from_the_start_to_everything_with_room(name, task):
    """Straight, the hand not turning, as an expert goes.

    A joint keeps 0.15 rad from its end (events begin at 0.1), links 1 cm from the table
    and from each other.
    """
    robot, _, start = fit(name, envs.ENVS[task])
    asked = need(envs.ENVS[task])
    assert asked.places
    p = np.stack([place.p for place in asked.places])
    q, R = np.tile(start, (len(p), 1)), np.tile(asked.start.R, (len(p), 1, 1))
    way = []
    _, miss = lead(robot, q, p, R, lambda q, *_: way.append(q))
    assert miss.max() < 1e-3
    q = np.concatenate(way)
    assert np.minimum(q - robot.q_lower, robot.q_upper - q).min() > 0.15
    assert capsule_gaps(robot, q, robot.capsules.pairs).min() > 0.01
    links = [c for c, k in enumerate(robot.capsules.segment) if 1 <= k < robot.n - 1]
    for c, ends in capsule_ends(robot, q, links).items():
        low = min(end[:, 2].min() for end in ends) - robot.capsules.radius[c]
        assert low > TABLE_HEIGHT + 0.01
    model = robot.mj_model
    for end, goal in zip(way[-1], p, strict=True):
        _, at, _ = posed(model, robot.site_name, end)
        np.testing.assert_allclose(at, goal, atol=1e-3)


def test_the_base_stands_on_the_table_or_on_a_pedestal():
    panda, iiwa = (scene(name, "trajectory").model for name in ("panda", "iiwa14"))
    assert stored()["panda"].mount[2] == pytest.approx(TABLE_HEIGHT)
    assert not any(panda.geom(g).name == "pedestal" for g in range(panda.ngeom))
    pedestal, base = iiwa.geom("pedestal"), stored()["iiwa14"].mount
    np.testing.assert_allclose(pedestal.pos[:2], base[:2])
    assert pedestal.pos[2] + pedestal.size[1] == pytest.approx(base[2])
    assert pedestal.pos[2] - pedestal.size[1] == pytest.approx(TABLE_HEIGHT)


@pytest.fixture(scope="module")
def ur5e():
    return envs.load("trajectory", robot="ur5e", physics="mujoco", start_noise=0.0)


@pytest.mark.slow
def test_an_expert_follows_the_via_points_with_six_joints(ur5e):
    """All of eight episodes within 100 steps; each takes some 30."""
    metrics = experts.play(ur5e, experts.follow, 8, 100, 0)
    assert experts.solved(metrics) == 1.0


def test_a_task_looks_the_same_with_every_arm(ur5e):
    """The first observation, the grip's velocity included; positions to 1e-5."""
    jaco = envs.load("trajectory", physics="mujoco", start_noise=0.0)
    assert ur5e.entries == jaco.entries
    seen = [jax.jit(env.reset)(jax.random.key(3)).obs[:18] for env in (ur5e, jaco)]
    np.testing.assert_allclose(*seen, atol=2e-5)
    for name in ("panda", "iiwa14"):
        other = envs.load("trajectory", robot=name, physics="mujoco")
        assert other.observation_size == jaco.observation_size
        start = jax.eval_shape(other.reset, jax.random.key(0))
        jax.eval_shape(other.step, start, jnp.zeros(other.action_size))


def test_the_identity_names_the_arm_in_its_place():
    env = envs.load("push", robot="ur5e", physics="mujoco")
    own = fit("ur5e", envs.ENVS["door"]).robot.fingerprint
    assert env.identity == {"arm": f"'ur5e' (fingerprint {own[:12]})"}
    assert env.options.record()["robot"] == "ur5e"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"robot": "pandaa"}, "unknown robot 'pandaa'.*panda"),
        ({"robot": "panda", "armature": "robosuite"}, "armature=robosuite is for the"),
        ({"robot": "planar3"}, "they need 6 degrees of freedom, it has 3"),
        ({"robot": "no/such/arm.xml"}, "no MJCF file at 'no/such/arm.xml'"),
    ],
)
def test_an_arm_that_cannot_be_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        envs.load("trajectory", **options)


def test_a_record_without_an_arm_is_of_the_jaco():
    record = envs.make_options("door").record()
    assert record.pop("robot") == JACO
    assert envs.make_options(**record).robot == JACO


LINK = """
<body pos="0 0 {length}">
  <joint name="j{k}" axis="{axis}" range="-170 170"/>
  <geom type="capsule" fromto="0 0 0 0 0 {length}" size="0.01" mass="0.3"/>
  {rest}
</body>"""


def test_an_arm_that_is_too_short_is_told_what_it_misses():
    rest = '<site name="ee" pos="0 0 0.05"/>'
    for k, axis in enumerate(("0 0 1", "0 1 0", "0 0 1", "0 1 0", "0 1 0", "0 0 1")):
        rest = LINK.format(k=k, axis=axis, length=0.06, rest=rest)
    motors = "".join(f'<motor joint="j{k}" ctrlrange="-9 9"/>' for k in range(6))
    short = Robot.from_mjcf(
        f'<mujoco model="short"><worldbody>{rest}</worldbody>'
        f"<actuator>{motors}</actuator></mujoco>",
        site="ee",
        finger=0.0,
        q_home=np.full(6, 0.5),
    )
    with pytest.raises(
        RobotError, match=r"'short' does not fit.*misses \(.* by \d+ cm"
    ):
        search(short, [need(envs.ENVS["trajectory"])])


def test_the_place_is_the_one_that_the_search_finds():
    """One arm, again: the file is what the command writes."""
    needs = [need(task) for task in envs.ENVS.values()]
    found, kept = search(Robot.load("ur5e", finger=0.0), needs), stored()["ur5e"]
    np.testing.assert_allclose(found.mount, kept.mount, atol=1e-6)
    np.testing.assert_allclose(found.posture, kept.posture, atol=1e-3)
    assert found.turn == pytest.approx(kept.turn, abs=1e-6)
    assert dataclasses.replace(envs.make_options("door"), robot="ur5e").robot == "ur5e"

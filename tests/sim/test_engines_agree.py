"""Every engine against MuJoCo C: free motion exactly, contact by what comes of it."""

import importlib.util
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rmp_mjx.sim import ENGINES, add_pairs, load_physics, read_contacts
from rmp_mjx.sim.base import _take

G = 9.81
HALF, FRICTION = 0.03, 0.4
STEPS, LANES = 750, 8  # 1.5 s

# A cube that falls, a sled that slides, a door with friction, a swinging double
# pendulum that touches nothing.
SCENE = f"""
<mujoco>
  <option timestep="0.002" integrator="implicitfast" iterations="20"/>
  <worldbody>
    <geom name="floor" type="plane" size="9 9 .1"/>
    <body name="cube" pos="0 0 .06">
      <freejoint/>
      <geom name="cube" type="box" size="{HALF} {HALF} {HALF}" mass=".3"/>
    </body>
    <body name="sled" pos="0 1 {HALF}">
      <joint name="sled_x" type="slide" axis="1 0 0"/>
      <joint name="sled_z" type="slide" axis="0 0 1"/>
      <geom name="sled" type="capsule" fromto="-.2 0 0 .2 0 0" size="{HALF}" mass="1"/>
    </body>
    <body name="door" pos="0 -1 .5">
      <joint name="hinge" axis="0 0 1" damping="2" frictionloss="2"/>
      <geom name="door" type="box" pos=".2 0 0" size=".2 .02 .2" mass="5"/>
    </body>
    <body name="upper" pos="0 3 2">
      <joint name="shoulder" axis="0 1 0"/>
      <geom name="upper" type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass="1"/>
      <body name="lower" pos="0 0 -.4">
        <joint name="elbow" axis="1 0 0"/>
        <geom name="lower" type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".5"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="hinge"/></actuator>
</mujoco>
"""
X, HINGE, SWING = 7, 9, slice(10, 12)  # in qpos; the cube's come first
SPEED = np.linspace(0.6, 1.8, LANES)  # of the sled at the start
PULL = np.linspace(1.0, 8.0, LANES)  # on the door in the end; 2 N m is its friction


@pytest.fixture(scope="module")
def scene():
    spec = mujoco.MjSpec.from_string(SCENE)
    add_pairs(spec, [("cube", "floor"), ("sled", "floor")], friction=FRICTION)
    return spec.compile()


@pytest.fixture(scope="module")
def played(scene):
    """`played(engine)`: positions and contacts at every step, (steps, lanes, ...)."""
    found = {}

    def play(name):
        if name == "warp" and importlib.util.find_spec("warp") is None:
            pytest.skip("warp-lang is not installed (extra 'warp')")
        if name not in found:
            found[name] = _play(load_physics(name, scene))
        return found[name]

    return play


def _play(engine):
    rng = np.random.default_rng(0)
    q = np.tile(engine.model.qpos0, (LANES, 1))
    qd = np.zeros((LANES, engine.model.nv))
    turn = rng.standard_normal((LANES, 4)) * [1.0, 0.2, 0.2, 1.0]
    q[:, 3:7] = turn / np.linalg.norm(turn, axis=1, keepdims=True)
    q[:, SWING] = rng.uniform(-1.0, 1.0, (LANES, 2))
    qd[:, 6] = SPEED
    start = jax.vmap(engine.init)(jnp.asarray(q), jnp.asarray(qd))
    pull = jnp.asarray(PULL, jnp.float32)[:, None]

    @jax.jit
    def run(state):
        def step(state, k):
            ramp = jnp.minimum(2.0 * (k + 1) / STEPS, 1.0)
            state = jax.vmap(engine.step)(state, ramp * pull)
            contacts = jax.vmap(lambda s: read_contacts(engine.model, s))(state)
            return state, (state.qpos, contacts.force)

        return jax.lax.scan(step, state, jnp.arange(STEPS))[1]

    q, force = (np.asarray(x, float) for x in run(start))
    return SimpleNamespace(q=q, force=force)


engines = pytest.mark.parametrize("name", sorted(set(ENGINES) - {"mujoco"}))


@engines
def test_free_motion_agrees(played, name):
    """Within 1e-3 rad after 1.5 s: float32 against float64, over 750 steps."""
    ours, true = played(name).q[:, :, SWING], played("mujoco").q[:, :, SWING]
    assert np.max(np.abs(true - true[0])) > 0.5
    np.testing.assert_allclose(ours, true, atol=1e-3)


@engines
def test_a_door_opens_along_the_same_curve(played, name):
    """Within 2e-3 rad of up to a radian at every instant of the ramp, or 1 %."""
    ours, true = played(name).q[:, :, HINGE], played("mujoco").q[:, :, HINGE]
    np.testing.assert_allclose(ours, true, rtol=0.01, atol=2e-3)
    assert np.all(np.abs(true[-1][PULL < 2.0]) < 0.01)  # the friction holds it
    assert true[-1].max() > 1.0


@pytest.mark.parametrize("name", sorted(ENGINES))
def test_a_sled_slides_as_far_as_its_friction_lets_it(played, name):
    """Within 3 % of C's and of v^2 / (2 mu g) (soft contact settles first).

    It then lies on its two contacts with its weight, to 1 %.
    """
    way = played(name).q[-1, :, X]
    np.testing.assert_allclose(way, SPEED**2 / (2 * FRICTION * G), rtol=0.03, atol=2e-3)
    np.testing.assert_allclose(way, played("mujoco").q[-1, :, X], rtol=0.03, atol=1e-3)
    np.testing.assert_allclose(played(name).force[-1, :, 1], G, rtol=0.01)


@pytest.mark.parametrize("name", sorted(ENGINES))
def test_a_cube_settles_on_a_face(played, name):
    """Tumbling differs; where it comes to rest does not.

    Its height is half an edge less a penetration under 1 mm, and C's to 0.1 mm.
    """
    height, true = (played(n).q[-1, :, 2] for n in (name, "mujoco"))
    assert np.all((height < HALF) & (height > HALF - 1e-3))
    np.testing.assert_allclose(height.mean(), true.mean(), atol=1e-4)


G = 9.81
ROD, TARGET, BALL = range(3)  # the order of the pairs in conftest.py


@pytest.fixture(scope="module", params=["mujoco", "mjx"])
def settled(request, weights):
    """0.8 s under constant forces: none, pressing, lifting, against the target."""
    engine = load_physics(request.param, weights)
    force = jnp.array([[0.0, 0.0], [5.0, 7.0], [30.0, 40.0], [50.0, 0.0]])
    target = jnp.full((4, 1, 3), jnp.array([0.0, 0.0, 5.0]))
    target = target.at[3].set(jnp.array([0.0, 0.0, 0.32]))
    force = force.at[1].multiply(-1.0)
    q = jnp.zeros((4, 2))
    state = jax.vmap(engine.init)(q, q, target)

    @jax.jit
    def run(state):
        step = lambda s, _: (jax.vmap(engine.step)(s, force), None)  # noqa: E731
        return jax.lax.scan(step, state, None, length=400)[0]

    state = run(state)
    return jax.vmap(lambda s: read_contacts(weights, s))(state), state


def test_resting_force_is_the_weight_in_the_order_of_the_pairs(settled):
    """Within 0.3 %: what is left of the settling motion after 0.8 s, in float32."""
    force = np.asarray(settled[0].force)
    expected = np.zeros((4, 3))
    expected[0, [ROD, BALL]] = 3 * G, 2 * G
    expected[1, [ROD, BALL]] = 3 * G + 7, 2 * G + 5
    expected[3, [ROD, TARGET]] = 3 * G, 50 - 2 * G
    np.testing.assert_allclose(force, expected, rtol=3e-3, atol=1e-3)


def test_touching_pairs_are_those_that_carry_force(settled):
    contacts = settled[0]
    np.testing.assert_array_equal(contacts.touching, np.asarray(contacts.force) > 0)


def test_what_is_lifted_off_touches_nothing(settled):
    contacts, state = settled
    assert np.all(state.qpos[2] > 0.5)
    assert not np.any(contacts.touching[2])


@pytest.mark.parametrize("index", [[], [3, 4, 5], [0, 1, 6, 7, 2]])
def test_what_is_read_by_slices_is_what_is_indexed(index):
    x, index = jnp.arange(8.0), np.array(index, int)
    np.testing.assert_array_equal(_take(x, index), x[index])


def test_pairs_that_are_not_watched_do_not_collide(weights):
    assert weights.npair == 3
    assert not weights.geom_contype.any() and not weights.geom_conaffinity.any()


def test_obstacles_start_where_the_model_puts_them(weights):
    engine = load_physics("mujoco", weights)
    state = engine.init(jnp.zeros(2), jnp.zeros(2))
    np.testing.assert_array_equal(state.mocap_pos, [[0.0, 0.0, 5.0]])

"""One compiled controller in float64 and one in float32, shared by all tests here."""

import copy

import jax
import numpy as np
import pytest

from rmp_mjx import RMPVICES, VICES, Obstacles

BATCH = 500
"""States per call; every test uses this shape, so each program compiles once."""


def fresh(tree):
    """The tree with copies of its NumPy arrays.

    JAX 0.10 keeps the float32 copy of a float64 array that a program has as a constant,
    and gives that one to programs in float64 as well ("expected f64, got f32").
    """
    return jax.tree.map(lambda x: x.copy() if isinstance(x, np.ndarray) else x, tree)


def changed(tree, **fields):
    """A tree with other fields of any type: batches, or what a caller gets wrong."""
    tree = copy.copy(tree)
    vars(tree).update(fields)
    return tree


def _controlled(ctrl, q, qd, action, obstacles, tau_ext=None):
    def one(q, qd, action, obstacles, tau_ext):
        setpoint = ctrl.setpoint(q, ctrl.decode(action), 0.0)
        return ctrl(q, qd, setpoint, obstacles, tau_ext)

    return jax.vmap(one)(q, qd, action, obstacles, tau_ext)


@pytest.fixture(scope="session")
def run64():
    """`run64(ctrl, q, qd, action, obstacles, tau_ext)`: outputs for BATCH states, in
    float64; without tau_ext nothing touches."""
    controlled = jax.jit(_controlled)

    def run(*args):
        with jax.enable_x64(True):
            return jax.device_get(controlled(*fresh(args)))

    return run


@pytest.fixture(scope="session")
def run32():
    """The same in float32, optimised as users run it."""
    controlled = jax.jit(_controlled)

    def run(*args):
        return jax.device_get(controlled(*jax.tree.map(_single, args)))

    return run


def _single(x):
    x = np.asarray(x)
    return x.astype(np.float32) if x.dtype == np.float64 else x


@pytest.fixture(scope="session")
def ctrl(robot):
    return RMPVICES(robot)


@pytest.fixture(scope="session")
def vices(robot):
    return VICES(robot)


@pytest.fixture(scope="session")
def states(robot):
    """`states(seed)`: q, qd, action (BATCH, ...) from home outwards to the limits."""

    def draw(seed=0, reach=1.0, speed=1.0):
        rng = np.random.default_rng(seed)
        q = robot.q_home + rng.uniform(-reach, reach, (BATCH, 7))
        qd = rng.normal(scale=speed, size=(BATCH, 7))
        return q, qd, rng.uniform(-1, 1, (BATCH, 12))

    return draw


@pytest.fixture(scope="session")
def obstacles():
    """`obstacles(seed)`: every kind, moving and turning, placed about the arm.

    Other obstacles for each of the BATCH states; one sphere slot stays unused, and one
    sphere may be touched by the hand.
    """

    def draw(seed=0, scale=0.4, speed=1.0):
        rng = np.random.default_rng(seed + 1000)

        def some(k, s=1.0):
            return rng.normal(scale=s, size=(BATCH, k, 3))

        def fill(sphere, sphere_v, floor_v, ends, capsule_v, box, box_v):
            slots = Obstacles.empty(spheres=3, planes=1, capsules=1, boxes=1)
            up = np.array([[0.0, 0.0, 1.0]])
            return (
                slots.with_spheres(
                    sphere,
                    np.array([0.05, 0.1]),
                    sphere_v,
                    hand_may_touch=np.array([False, True]),
                )
                .with_planes(-0.1 * up, up, floor_v)
                .with_capsules(ends[:1], ends[1:], 0.05, *capsule_v)
                .with_boxes(box, [[0.1, 0.2, 0.05]], None, 0.02, *box_v)
            )

        about = np.array([0.2, 0.0, 0.3])
        with jax.enable_x64(True):
            filled = jax.vmap(fill)(
                about + some(2, scale),
                some(2, speed),
                some(1, 0.1 * speed),
                about + some(2, scale),
                some(2, speed)[:, :, None],
                about + some(1, scale),
                some(2, speed)[:, :, None],
            )
            return jax.device_get(filled)

    return draw

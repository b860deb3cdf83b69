"""The guard: its bounds, its stop, and arms that are driven at what may be hit."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from envs.scene import TABLE_HEIGHT, build_scene
from rmp_mjx import RMPVICES, Obstacles, StopGuard
from rmp_mjx.control.avoidance import self_gaps
from rmp_mjx.control.guard import ROUNDING
from rmp_mjx.robot.bounds import Bounds
from rmp_mjx.robot.dynamics import dynamics
from rmp_mjx.robot.kinematics import arm_state
from rmp_mjx.robot.point_state import point_state

STEP, SPEED, RADIUS = 0.005, 0.2, 0.05
"""Control step [s], speed [m/s] and radius [m] of the spheres."""


@pytest.fixture(scope="module", autouse=True)
def _fresh_caches():
    """JAX may keep a constant in the precision of an earlier module's trace."""
    jax.clear_caches()


@pytest.fixture(scope="module")
def guard(robot):
    return StopGuard.of(robot, STEP, obstacle_speed=SPEED)


def around(seed):
    """Every kind of obstacle within reach, at rest."""
    rng = np.random.default_rng(seed)
    at = lambda k: np.array([0.25, 0.0, 0.3]) + rng.normal(scale=0.3, size=(k, 3))  # noqa: E731
    up = np.array([[0.0, 0.0, 1.0]])
    empty = Obstacles.empty(spheres=2, planes=1, capsules=1, boxes=1)
    return (
        empty.with_spheres(at(2), np.array([0.05, 0.1]))
        .with_planes(-0.1 * up, up)
        .with_capsules(at(1), at(1), 0.05)
        .with_boxes(at(1), [[0.1, 0.2, 0.05]], None, 0.02)
    )


WAYS = np.linspace(0.0, 0.3, 7)
"""Ways along a line in the joints [s]."""


def test_distances_keep_to_their_bounds_along_a_line(robot, guard):
    """To all kinds of obstacles and between the links. 1e-9: rounding of float64."""
    bounds = guard.bounds
    segment = np.array(robot.points.segment)

    def look(q, u, obstacles):
        arm = arm_state(robot, q, u)
        scene = guard._scene(robot, arm, u, jnp.eye(7), jnp.zeros(7), obstacles)
        return (
            [(d, r[0]) for d, r, *_ in scene.rows],
            scene.pairs,
            self_gaps(robot, arm)[0],
        )

    @jax.jit
    def excess(q, u, obstacles):
        size = jnp.abs(u)
        squares = jnp.outer(size, size).reshape(-1)
        bend = (squares @ bounds.bend)[segment][None]
        pair_bend = (squares @ bounds.pair_bend)[None]
        rows, (tips, (tip_rates, _)), _ = look(q, u, obstacles)
        worst = []
        for way in WAYS:
            later, _, pairs = look(q + way * u, u, obstacles)
            for (d, rate), (after, _) in zip(rows, later, strict=True):
                least = d + way * rate - 0.5 * way**2 * bend
                worst.append(jnp.max(least - after))
            least = tips + way * tip_rates - 0.5 * way**2 * pair_bend
            worst.append(jnp.max(jnp.min(least, axis=0) - pairs))
        return jnp.max(jnp.stack(worst))

    rng = np.random.default_rng(1)
    with jax.enable_x64(True):
        for seed in range(40):
            q, u = robot.q_home + rng.normal(size=7), rng.normal(size=7)
            assert excess(q, u, around(seed)) <= 1e-9


def test_float32_costs_less_than_the_guard_sets_aside(robot, guard):
    def distances(q, u):
        arm = arm_state(robot, q, u)
        obstacles = around(0)
        scene = guard._scene(robot, arm, u, jnp.eye(7), jnp.zeros(7), obstacles)
        rows = [x for d, r, *_ in scene.rows for x in (d, 0.05 * r[0])]
        return jnp.concatenate([x.ravel() for x in (*rows, scene.pairs[0])])

    rng = np.random.default_rng(2)
    q, u = robot.q_home + rng.normal(size=(200, 7)), rng.normal(size=(200, 7))
    single = jax.jit(jax.vmap(distances))(np.float32(q), np.float32(u))
    with jax.enable_x64(True):
        exact = jax.jit(jax.vmap(distances))(
            *map(np.float64, (np.float32(q), np.float32(u)))
        )
    assert np.abs(single - exact).max() < ROUNDING / 2


class Arms:
    """Many arms in MuJoCo C among spheres that chase them."""

    def __init__(self, robot, count, spheres=2):
        self.robot, self.count, self.spheres = robot, count, spheres
        self.model = build_scene(robot, STEP, spheres, RADIUS).model
        self.data = [mujoco.MjData(self.model) for _ in range(count)]
        self.hits: list[float] = []
        self.limits = 0

    def start(self, i, rng):
        """Arm i at rest near its home, spheres 30 cm away."""
        data = self.data[i]
        mujoco.mj_resetData(self.model, data)
        data.qpos[:7] = self.robot.q_home + rng.uniform(-0.3, 0.3, 7)
        way = rng.normal(size=(self.spheres, 3))
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        data.mocap_pos[:] = np.array([0.3, 0.0, 0.25]) + 0.45 * way

    def step(self, i, tau, target):
        """A step; the spheres move towards the target. Whether it touches anything."""
        data = self.data[i]
        way = target - data.mocap_pos
        far = np.linalg.norm(way, axis=1, keepdims=True)
        data.mocap_pos[:] += STEP * SPEED * way / np.maximum(far, 1e-6)
        data.ctrl[:] = tau
        before = data.qvel.copy()
        mujoco.mj_step(self.model, data)  # finds contacts where the step begins
        touching = False
        for contact in data.contact[: data.ncon]:
            if contact.dist < 0:
                touching = True
                self.hits.append(self._speed(data, contact, before))
        room = np.minimum(
            data.qpos[:7] - self.robot.q_lower, self.robot.q_upper - data.qpos[:7]
        )
        self.limits += bool(room.min() < 0.1)
        return touching

    def _speed(self, data, contact, qvel):
        """Greatest speed of the two bodies' material at the contact, before it [m/s].

        Kinematics in `data` are those of the step's beginning.
        """
        speeds = []
        for geom in contact.geom:
            J = np.zeros((3, self.model.nv))
            body = self.model.geom_bodyid[geom]
            mujoco.mj_jac(self.model, data, J, None, contact.pos, body)
            speeds.append(np.linalg.norm(J @ qvel))
        return max(speeds)


def attack(robot, guard, count, steps, seed, on=True):
    """Drive arms by torques that are held for a while, guarded or not.

    Returns:
        The arms, and sums of the guard's diagnostics before any contact.
    """
    arms, rng = Arms(robot, count), np.random.default_rng(seed)
    for i in range(count):
        arms.start(i, rng)
    up = np.array([[0.0, 0.0, 1.0]])
    empty = Obstacles.empty(spheres=arms.spheres, planes=1)
    floor = np.array([[0.0, 0.0, TABLE_HEIGHT]])
    tau_max = jnp.asarray(robot.tau_max, jnp.float32)

    @jax.jit
    @jax.vmap
    def send(q, qd, pull, centers):
        arm = arm_state(robot, q, qd)
        Mq, bias = dynamics(robot, arm)
        wanted = bias + jnp.matmul(Mq, pull - 2.0 * qd, precision="highest")
        tau = jnp.clip(wanted, -tau_max, tau_max)
        obstacles = empty.with_spheres(centers, RADIUS).with_planes(floor, up)
        sent, found = guard(robot, arm, tau, Mq, bias, obstacles)
        return sent if on else tau, found, point_state(robot, arm).x.stack(1)

    pull = np.zeros((count, 7), np.float32)
    sums = {"used": 0.0, "unproved": 0.0, "mispredicted": 0.0}
    origin = np.asarray(robot.offset[0])
    for _ in range(steps):
        again = rng.random(count) < 0.02
        pull[again] = 8.0 * rng.normal(size=(again.sum(), 7))
        q, qd, centers = (
            np.array([getattr(d, name)[:k] for d in arms.data], np.float32)
            for name, k in (("qpos", 7), ("qvel", 7), ("mocap_pos", None))
        )
        tau, found, points = jax.device_get(send(q, qd, pull, centers))
        sums["used"] += found["guard_used"].mean() / steps
        sums["unproved"] += found["guard_assumptions"].sum()
        for i in range(count):
            near = points[i] + origin
            apart = np.linalg.norm(near[None] - centers[i][:, None], axis=-1)
            target = near[apart.argmin(axis=1)]
            if arms.step(i, tau[i], target):
                arms.start(i, rng)
                continue
            error = np.abs(arms.data[i].qvel[:7] - found["guard_qd"][i]).max()
            sums["mispredicted"] += on and error > guard.tolerance
    return arms, sums


def test_a_guarded_arm_is_slow_at_every_contact(robot, guard):
    """The induction step, 24,000 times, against torques that know no obstacle."""
    arms, sums = attack(robot, guard, count=24, steps=1000, seed=0)
    assert len(arms.hits) > 10  # the spheres do get there
    assert max(arms.hits) <= guard.speed
    assert arms.limits == 0
    assert sums["unproved"] == 0
    assert sums["mispredicted"] == 0
    assert 0.05 < sums["used"] < 0.95


def test_without_the_guard_they_are_fast(robot, guard):
    arms, _ = attack(robot, guard, count=8, steps=300, seed=0, on=False)
    assert max(arms.hits) > 4 * guard.speed


@pytest.fixture(scope="module")
def one_step(robot):
    """`one_step(guard, q, qd, tau)` without obstacles, and the predicted stop."""

    @jax.jit
    def run(guard, q, qd, tau):
        arm = arm_state(robot, q, qd)
        Mq, bias = dynamics(robot, arm)
        scene = guard._scene(robot, arm, qd, Mq, 0.0 * q, Obstacles.empty())
        stop = guard._stop(scene, qd, scene.momenta[0], 0.0)
        return *guard(robot, arm, tau, Mq, bias, Obstacles.empty()), stop

    return run


def test_a_stop_takes_its_time_and_keeps_to_its_line(robot, guard, one_step):
    """Against MuJoCo C; a margin of 10 m lets nothing pass but the stop."""
    stubborn = guard.replace(margin=10.0, speed=0.0)
    rng = np.random.default_rng(3)
    model = robot.mj_model
    model.opt.timestep = STEP
    for _ in range(10):
        data = mujoco.MjData(model)
        data.qpos[:] = start = robot.q_home + rng.normal(scale=0.2, size=7)
        data.qvel[:] = qd = rng.normal(scale=0.3, size=7)
        longest, steps = 0.0, 0
        while np.abs(data.qvel).max() > 1e-3:
            state = (np.float32(x) for x in (data.qpos, data.qvel, 0 * qd))
            tau, found, (T, possible) = jax.device_get(one_step(stubborn, *state))
            longest = longest or T
            assert possible
            assert found["guard_used"] == 1.0
            data.ctrl[:] = tau
            mujoco.mj_step(model, data)
            steps += 1
        assert steps * STEP <= longest + STEP
        way = (data.qpos - start) / qd
        assert np.ptp(way) < 1e-3 * longest + 1e-5
        assert -1e-6 <= way.mean() <= longest / 2


def test_a_step_that_passes_is_the_controllers_own(robot, guard, one_step):
    """Bit for bit: at rest at home, with a torque that holds the arm."""
    q = np.float32(robot.q_home)
    tau = np.float32(
        jax.jit(lambda q: dynamics(robot, arm_state(robot, q, 0.0 * q))[1])(q)
    )
    sent, found, _ = one_step(guard, q, 0 * q, tau)
    assert np.array_equal(sent, tau)
    assert found["guard_used"] == 0.0
    assert found["guard_verified"] == 1.0


def test_a_controller_sends_what_its_guard_lets_pass(robot, guard, vices, states):
    """And its own torque, bit for bit, where that passes."""
    obstacles = Obstacles.empty(spheres=1).with_spheres([[0.3, 0.1, 0.3]], 0.05)

    @jax.jit
    @jax.vmap
    def both(q, qd, action):
        setpoint = vices.setpoint(q, vices.decode(action), 0.0)
        plain = vices(q, qd, setpoint, obstacles)
        arm = arm_state(robot, q, qd)
        sent, _ = guard(robot, arm, plain.tau, plain.Mq, plain.bias, obstacles)
        return plain, sent, vices.replace(guard=guard)(q, qd, setpoint, obstacles)

    plain, sent, out = jax.device_get(both(*map(np.float32, states(speed=0.3))))
    passed = out.diagnostics["guard_used"] == 0.0
    assert 0.1 < passed.mean() < 0.99
    np.testing.assert_allclose(out.tau, sent, atol=1e-3)  # one program, fused anew
    assert np.array_equal(out.tau[passed], plain.tau[passed])
    assert np.array_equal(out.qdd[passed], plain.qdd[passed])
    force = np.matmul(out.Mq, out.qdd[..., None])[..., 0] + out.bias
    np.testing.assert_allclose(force[~passed], out.tau[~passed], atol=1e-2)


def test_a_torque_that_is_no_number_is_not_sent(robot, guard, one_step):
    q = np.float32(robot.q_home)
    sent, found, _ = one_step(guard, q, 0 * q, np.float32(np.full(7, np.nan)))
    assert np.all(np.isfinite(sent))
    assert found["guard_used"] == 1.0


def test_a_step_went_as_predicted_if_every_joint_did(guard):
    """Within a tolerance of 1e-4 rad/s, either way."""
    kept, expected = jax.jit(guard.kept), np.linspace(-1, 1, 7, dtype="f")
    assert kept(expected, expected)
    for joint in range(7):
        for way in (-1.0, 1.0):
            off = np.float32(way * np.eye(7)[joint])
            assert kept(expected, expected + 9e-5 * off)
            assert not kept(expected, expected + 1.1e-4 * off)


def test_an_unlimited_slide_has_no_bounds(robot):
    slides = (False, *robot.hinge[1:])
    with pytest.raises(ValueError, match="sliding joint"):
        Bounds.of(robot.replace(hinge=slides))


def test_a_task_puts_it_behind_its_controller_by_an_option():
    def guard_of(**options):
        controller = envs.load("trajectory", **options).controller
        assert isinstance(controller, RMPVICES)
        return controller.guard

    found = guard_of(guard=True, obstacles=1, obstacle_speed=0.1, sim_dt=0.01)
    assert found is not None
    assert (found.obstacle_speed, found.step) == (0.1, 0.01)
    assert guard_of() is None

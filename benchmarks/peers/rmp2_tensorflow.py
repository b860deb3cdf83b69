"""RMP2's formulation in TensorFlow 2, after its authors' description.

Li et al., "RMP2: A Structured Composable Policy Class for Robot Learning" (2021): one
forward map from the joints to all leaf coordinates; velocities and curvatures by
differentiating reverse mode twice; the root's force as the gradient of the leaves'
forces dotted with the coordinates, the root's metric as the Jacobian of a gradient.

The tree is ours without self-collision and relaxed orientation: the same arm, control
points, obstacles, leaves and regulariser, so that the accelerations must agree. Inertia
and dynamics are given (`problem`). What remains is the policy itself, while ours is
timed with its dynamics and torques. Throughput is that of a graph (``tf.function``, as
in the authors' code) and of the same compiled by XLA. One state is only timed with XLA,
because the graph corrupts TensorFlow's heap (2.19 and 2.21) at a batch of one.
"""

from __future__ import annotations

import functools
import sys

import numpy as np
import tensorflow as tf

from benchmarks.peers.worker import Measure, latency, rate, serve

STATES = ("q", "qd", "p_des", "R_des", "kp_pos", "kp_ori", "regularizer")


class Policy:
    """The tree of one `problem`; all tensors have a leading batch axis."""

    def __init__(self, problem):
        """Copy the constants."""
        self.problem = problem

    def constant(self, name: str):
        """A constant of the problem."""
        return tf.constant(self.problem[name])

    def coordinates(self, q):
        """All leaf coordinates: site position, its rotation row by row, distances."""
        shift = q - self.constant("q_ref")
        c, s = tf.cos(shift), tf.sin(shift)
        p = tf.zeros_like(q[:, :3])
        R = tf.linalg.diag(tf.ones_like(p))
        offset, rotation = self.constant("offset"), self.constant("rotation")
        points, on_links = self.constant("point_offset"), []
        for j in range(q.shape[1]):
            p = p + tf.linalg.matvec(R, offset[j])
            R = R @ rotation[j]
            x, y, z = tf.unstack(R, axis=2)
            cj, sj = c[:, j, None], s[:, j, None]
            R = tf.stack([cj * x + sj * y, cj * y - sj * x, z], axis=2)
            on_link = np.flatnonzero(self.problem["point_segment"] == j)
            if on_link.size:
                local = tf.gather(points, on_link)
                on_links.append(p[:, None] + tf.einsum("bij,kj->bki", R, local))
        x = tf.concat(on_links, axis=1)
        away = x[:, None] - self.constant("center")[None, :, None]
        size = self.constant("radius")[:, None] + self.constant("point_radius")[None]
        gap = tf.norm(away, axis=3) - size
        site = p + tf.linalg.matvec(R, self.constant("site_offset"))
        turned = R @ self.constant("site_rotation")
        batch = tf.shape(q)[0]
        return site, tf.reshape(turned, [batch, 9]), tf.reshape(gap, [batch, -1])

    def barrier(self, name: str, x, xd):
        """The one-dimensional barrier: metric and force."""
        mu, eps, eta, r, margin, x_min, cap, k_out, v_out = self.problem[name]
        gap = tf.maximum(x - margin, x_min)
        near = gap < r
        gap, active = tf.where(near, gap, 1.0), tf.cast(near, x.dtype)
        v = tf.minimum(xd, 0.0)
        hold = active * tf.exp(-tf.maximum(xd, 0.0) / v_out)
        m = mu * ((1.0 - gap / r) / gap**2) ** 2 * (v * v + eps)
        m = hold * tf.minimum(m, cap)
        depth = tf.where(near, tf.maximum(margin - x, 0.0), 0.0)
        a = -eta * v + v * v / gap + k_out * depth
        return m, m * a

    def leaves(self, xs, xds, state):
        """Metric-vector products and forces of the leaves, one pair per coordinate."""
        site, turned, gap = xs
        v, turned_rate, gap_rate = xds
        kp = state["kp_pos"]
        pull = kp * (state["p_des"] - site) - 2.0 * tf.sqrt(kp) * v
        R = tf.reshape(turned, [-1, 3, 3])
        rate = tf.reshape(turned_rate, [-1, 3, 3])
        spin = rate @ tf.transpose(R, [0, 2, 1])
        omega = 0.5 * tf.stack(
            [
                spin[:, 2, 1] - spin[:, 1, 2],
                spin[:, 0, 2] - spin[:, 2, 0],
                spin[:, 1, 0] - spin[:, 0, 1],
            ],
            axis=1,
        )
        columns = zip(
            tf.unstack(R, axis=2), tf.unstack(state["R_des"], axis=2), strict=True
        )
        error = 0.5 * sum(tf.linalg.cross(a, b) for a, b in columns)
        kp = state["kp_ori"]
        torque = kp * error - 2.0 * tf.sqrt(kp) * omega

        def turn(w):
            """Rates of the rotation matrix under an angular velocity, (b, 9)."""
            cross = [tf.linalg.cross(w, column) for column in tf.unstack(R, axis=2)]
            return tf.reshape(tf.stack(cross, axis=2), [-1, 9])

        basis = tf.stack(
            [
                turn(axis + tf.zeros_like(omega))
                for axis in np.eye(3, dtype=omega.dtype.as_numpy_dtype)
            ],
            axis=2,
        )
        on_rotation = 0.25 * basis @ tf.transpose(basis, [0, 2, 1])
        m, f = self.barrier("collision", gap, gap_rate)
        metrics = (
            lambda u: u,
            lambda u: tf.linalg.matvec(on_rotation, u),
            lambda u: m * u,
        )
        return metrics, (pull, 0.5 * turn(torque), f)

    def accelerations(self, state):
        """Joint accelerations of a batch of states."""
        q, qd = state["q"], state["qd"]
        with tf.GradientTape() as outer:
            outer.watch(q)
            with tf.GradientTape() as inner:
                inner.watch(q)
                xs = self.coordinates(q)
                ones = [tf.ones_like(x) for x in xs]
                with tf.GradientTape(persistent=True) as dummy:
                    dummy.watch(ones)
                    along = dot(xs, ones)
                    first = tf.reduce_sum(qd * inner.gradient(along, q))
                    second = tf.reduce_sum(qd * outer.gradient(first, q))
        xds, curvatures = (dummy.gradient(s, ones) for s in (first, second))
        metrics, forces = self.leaves(xs, xds, state)
        corrected = [
            f - metric(c)
            for metric, f, c in zip(metrics, forces, curvatures, strict=True)
        ]
        other = tf.identity(q)
        with tf.GradientTape(persistent=True) as tape:
            tape.watch(other)
            at_other = self.coordinates(other)
            weighted = [metric(x) for metric, x in zip(metrics, at_other, strict=True)]
            with tf.GradientTape() as inner:
                inner.watch(q)
                product = dot(weighted, self.coordinates(q))
            gradient = inner.gradient(product, q)
            force = dot(corrected, at_other)
        f, M = tape.gradient(force, other), tape.batch_jacobian(gradient, other)
        rest = self.constant("posture")
        m, limit = self.limits(q, qd)
        pulled = rest[0] * (self.constant("q_home") - q) - rest[1] * qd
        inertia = state["regularizer"]
        f = f + limit + rest[2] * tf.linalg.matvec(inertia, pulled)
        M = M + tf.linalg.diag(m) + (rest[2] + rest[3]) * inertia
        return tf.linalg.solve(M, f[..., None])[..., 0]

    def limits(self, q, qd):
        """Metric and force of the joint-limit leaf."""
        lower, upper = self.constant("q_lower"), self.constant("q_upper")
        m_low, f_low = self.barrier("joint_limit", q - lower, qd)
        m_high, f_high = self.barrier("joint_limit", upper - q, -qd)
        return m_low + m_high, f_low - f_high


def dot(xs, ys):
    """Scalar product over all coordinates and the batch."""
    return tf.add_n([tf.reduce_sum(x * y) for x, y in zip(xs, ys, strict=True)])


def evaluation(problem, xla: bool, batch: int | None):
    """A call that evaluates a batch of states (all of them if None)."""
    policy = Policy(problem)
    function = tf.function(policy.accelerations, jit_compile=xla)
    state = {name: tf.constant(problem[name][:batch]) for name in STATES}
    return functools.partial(function, state)


def throughput(problem, xla: bool) -> Measure:
    """Evaluations a second of the whole batch."""
    call = evaluation(problem, xla, None)
    return rate(lambda: call().numpy(), len(problem["q"]))


def single(problem) -> Measure:
    """Median time of one state [us]."""
    call = evaluation(problem, True, 1)
    return latency(lambda: call().numpy())


def disagreement(problem) -> Measure:
    """Largest difference to our accelerations over a state's largest, in float64."""
    ours = problem["qdd"]
    theirs = evaluation(problem, False, None)().numpy()
    scale = np.abs(ours).max(axis=1)
    error = np.abs(theirs - ours).max(axis=1) / scale
    return lambda seconds: float(error.max())


if __name__ == "__main__":
    exact = dict(np.load(sys.argv[1]))
    given = {
        k: x.astype(np.float32) if x.dtype == float else x for k, x in exact.items()
    }
    serve(
        {
            "evals": lambda: throughput(given, False),
            "evals_xla": lambda: throughput(given, True),
            "latency_xla": lambda: single(given),
            "disagreement": lambda: disagreement(exact),
        },
        ("tensorflow-cpu", "numpy"),
    )

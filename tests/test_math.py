"""rmp_mjx.math against scipy, jaxlie and finite-precision bounds."""

import inspect

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rmp_mjx import math as rmath
from rmp_mjx.vec import Vec
from rmp_mjx.xla import materialize


@pytest.fixture(scope="module")
def rotations():
    """200 random rotation vectors of angle up to 3.1 rad, tiny ones included."""
    rng = np.random.default_rng(0)
    w = rng.normal(size=(200, 3))
    angle = np.concatenate([rng.uniform(0.0, 3.1, 150), np.geomspace(1e-8, 1e-1, 50)])
    return w / np.linalg.norm(w, axis=1, keepdims=True) * angle[:, None]


def test_exp_and_log_agree_with_scipy_and_jaxlie_in_float64(rotations):
    # 1e-12: float64 rounding of well-conditioned formulas; the log loses digits as the
    # angle nears pi, 3.1 rad is still two digits away from that.
    with jax.enable_x64(True):
        w = jnp.asarray(rotations)
        R = jax.jit(jax.vmap(rmath.exp_so3))(w)
        np.testing.assert_allclose(
            R, Rotation.from_rotvec(rotations).as_matrix(), atol=1e-12
        )
        log = jax.jit(jax.vmap(rmath.log_so3))(R)
        np.testing.assert_allclose(log, rotations, atol=1e-12)
        peer = jax.vmap(lambda R: jaxlie.SO3.from_matrix(R).log())(R)
        # 1e-9: jaxlie switches to its series earlier.
        np.testing.assert_allclose(log, peer, atol=1e-9)


def test_exp_and_log_are_accurate_in_float32(rotations):
    # 3e-6 rad: 25 float32 epsilons, and the factor sin/(pi - angle) near pi.
    w = jnp.asarray(rotations, jnp.float32)
    R = jax.vmap(rmath.exp_so3)(w)
    np.testing.assert_allclose(
        R, Rotation.from_rotvec(rotations).as_matrix(), atol=1e-6
    )
    np.testing.assert_allclose(jax.vmap(rmath.log_so3)(R), w, atol=3e-6)


@pytest.mark.parametrize("axis", range(3))
def test_log_at_half_turn_is_a_half_turn_about_the_axis(axis):
    w = np.pi * np.eye(3)[axis]
    R = jnp.asarray(Rotation.from_rotvec(w).as_matrix(), jnp.float32)
    log = np.asarray(rmath.log_so3(R))
    # 1e-6 rad: float32 rounding of pi.
    np.testing.assert_allclose(np.abs(log), np.abs(w), atol=1e-6)


def test_exp_and_log_have_exact_first_and_finite_second_derivatives_at_identity():
    zero = jnp.zeros(3)
    generators = jnp.stack([rmath.skew(e) for e in jnp.eye(3)], axis=-1)

    def roundtrip(w):
        return rmath.log_so3(rmath.exp_so3(w))

    @jax.jit
    def derivatives(w):
        return (
            jax.jacfwd(rmath.exp_so3)(w),
            jax.jacrev(roundtrip)(w),
            jax.jacfwd(jax.jacrev(roundtrip))(w),
        )

    first, reverse, second = derivatives(zero)
    # 1e-6: float32 rounding; the round trip is the identity, so its curvature is 0.
    np.testing.assert_allclose(first, generators, atol=1e-6)
    np.testing.assert_allclose(reverse, jnp.eye(3), atol=1e-6)
    np.testing.assert_allclose(second, 0.0, atol=1e-6)


def test_derivatives_of_exp_and_log_are_continuous_across_the_series_switch():
    # 2e-6: float32 rounding; a wrong series coefficient would show as 1e-4 or more.
    axis = jnp.asarray([0.6, 0.0, 0.8])
    jacobian = jax.jit(jax.jacfwd(lambda w: rmath.log_so3(rmath.exp_so3(w))))
    for angle in (9.9e-3, 1.01e-2, 1.9e-3, 2.1e-3):
        np.testing.assert_allclose(jacobian(angle * axis), jnp.eye(3), atol=2e-6)


def test_quaternions_are_wxyz_and_round_trip(rotations):
    reference = Rotation.from_rotvec(rotations)
    quat = reference.as_quat(canonical=True, scalar_first=True)
    R = jax.vmap(rmath.quat_to_mat)(jnp.asarray(quat, jnp.float32))
    # 1e-6: float32 rounding.
    np.testing.assert_allclose(R, reference.as_matrix(), atol=1e-6)
    back = jax.vmap(rmath.mat_to_quat)(R)
    # Near w = 0 the sign of the quaternion is a matter of rounding.
    sign = np.sign(np.sum(np.asarray(back) * quat, axis=1, keepdims=True))
    np.testing.assert_allclose(back * sign, quat, atol=1e-6)


def test_orientation_error_is_sine_times_world_axis(rotations):
    rng = np.random.default_rng(1)
    R = Rotation.from_rotvec(rng.normal(size=(200, 3)))
    R_des = Rotation.from_rotvec(rotations) * R
    with jax.enable_x64(True):
        error = jax.vmap(rmath.orientation_error)(R.as_matrix(), R_des.as_matrix())
        angle = np.linalg.norm(rotations, axis=1, keepdims=True)
        expected = np.sin(angle) * rotations / angle
        # 1e-12: float64 rounding.
        np.testing.assert_allclose(error, expected, atol=1e-12)


def test_orientation_error_feedback_converges():
    """Turning by a positive gain times the error must reduce it."""
    R_des = rmath.exp_so3(jnp.asarray([0.7, -0.5, 0.9]))

    def step(R, _):
        return rmath.exp_so3(0.2 * rmath.orientation_error(R, R_des)) @ R, None

    R, _ = jax.lax.scan(step, jnp.eye(3), length=100)
    # 1e-5: 0.8^100 is 2e-10, the rest is float32 drift of 100 products.
    np.testing.assert_allclose(R, R_des, atol=1e-5)


def test_skew_is_the_cross_product_and_unskew_inverts_it():
    a, b = jnp.asarray([1.0, 2.0, 3.0]), jnp.asarray([-0.5, 0.7, 2.0])
    np.testing.assert_allclose(rmath.skew(a) @ b, jnp.cross(a, b), atol=1e-6)
    np.testing.assert_array_equal(rmath.unskew(rmath.skew(a)), a)


def test_safe_norm_matches_numpy_and_has_zero_gradient_at_zero():
    x = np.random.default_rng(2).normal(size=(5, 3)).astype(np.float32)
    # 1e-6: float32 rounding.
    np.testing.assert_allclose(
        rmath.safe_norm(jnp.asarray(x)), np.linalg.norm(x, axis=1), rtol=1e-6
    )
    zero = jnp.zeros(3)
    assert rmath.safe_norm(zero) == 0.0
    np.testing.assert_array_equal(jax.grad(rmath.safe_norm)(zero), 0.0)
    assert np.all(np.isfinite(jax.hessian(rmath.safe_norm)(zero)))


def test_critical_damping_is_twice_the_root_with_finite_gradient_at_zero():
    assert rmath.critical_damping(25.0) == 10.0
    assert rmath.critical_damping(0.0) == 0.0
    assert jax.grad(rmath.critical_damping)(0.0) == 0.0


def test_gates_are_zero_one_and_differentiable_at_their_ends():
    assert rmath.speed_gate(jnp.zeros(()), 0.1) == 0.0
    assert rmath.speed_gate(jnp.asarray(10.0), 0.1) == 1.0
    for speed in (-1e3, 0.0, 1e3):
        assert np.isfinite(jax.grad(rmath.speed_gate)(speed, 0.1))


def test_a_ramp_goes_from_zero_at_its_far_end_to_one_at_its_near_end():
    room = jnp.asarray([jnp.inf, 5.0, 3.0, 2.0, 1.0, -4.0])
    np.testing.assert_allclose(rmath.ramp(room, 1.0, 3.0), [0, 0, 0, 0.5, 1, 1])
    slope = jax.vmap(jax.grad(rmath.ramp), (0, None, None))(room, 1.0, 3.0)
    assert np.isfinite(slope).all() and slope[3] == -0.5


def _spd(rng, condition, n=7):
    basis, _ = np.linalg.qr(rng.normal(size=(n, n)))
    A = (basis * np.geomspace(1.0, 1.0 / condition, n)) @ basis.T
    return 0.5 * (A + A.T)


@pytest.fixture(scope="module")
def batched_solve():
    """The solver vmapped over 50 systems of 7 unknowns."""
    return jax.jit(jax.vmap(rmath.psd_solve))


def test_psd_solve_matches_numpy_in_float64(batched_solve):
    rng = np.random.default_rng(3)
    A = np.stack([_spd(rng, 10.0 ** rng.uniform(0, 6)) for _ in range(50)])
    b = rng.normal(size=(50, 7))
    with jax.enable_x64(True):
        x = np.asarray(batched_solve(A, b))
    expected = np.linalg.solve(A, b[..., None])[..., 0]
    error = np.linalg.norm(x - expected, axis=1) / np.linalg.norm(expected, axis=1)
    # 1e-9: condition 1e6 times float64 epsilon, with a factor of 7 twice.
    assert error.max() < 1e-9


@settings(max_examples=50, deadline=None, derandomize=True)
@given(
    rank=st.integers(0, 6),
    spread=st.integers(0, 4),
    seed=st.integers(0, 2**32 - 1),
)
def test_psd_solve_gives_finite_numbers_whatever_the_rank(
    wide_solve, rank, spread, seed
):
    """100,000 matrices of 7 unknowns, with rows and units up to 10^(+-spread).

    And their products with the answer are finite, too.
    """
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(2000, rank, 7)) * 10.0 ** rng.uniform(
        -spread, spread, (2000, rank, 1)
    )
    rows *= 10.0 ** rng.uniform(-spread, spread, (2000, 1, 7))
    A = np.einsum("bri,brj->bij", *[rows.astype(np.float32)] * 2)
    x = np.asarray(wide_solve(A, rng.normal(size=(2000, 7)).astype(np.float32)))
    assert np.isfinite(x).all()
    assert np.isfinite(x * x).all()


@pytest.fixture(scope="module")
def wide_solve():
    """The solver vmapped over 2,000 systems of 7 unknowns."""
    return jax.jit(jax.vmap(rmath.psd_solve))


def test_psd_solve_passes_on_what_is_no_number(batched_solve):
    A = np.tile(np.eye(7, dtype=np.float32), (50, 1, 1))
    assert np.isnan(batched_solve(A, np.full((50, 7), np.nan, np.float32))).all()


def test_only_rotations_count_as_rotations(rotations):
    R = Rotation.from_rotvec(rotations).as_matrix().astype(np.float32)
    assert np.all(rmath.is_rotation(R))
    assert not np.any(rmath.is_rotation(-R)) and not np.any(rmath.is_rotation(2 * R))
    assert not np.any(rmath.is_rotation(np.nan * R))
    assert not np.any(rmath.is_rotation(R[:, :, [0, 0, 1]]))


def test_numbers_that_are_none_or_too_large_are_not_bounded():
    assert rmath.bounded(jnp.array([-1e4, 1e4]))
    for wrong in (np.nan, np.inf, -np.inf, 1.1e4):
        assert not rmath.bounded(jnp.array([0.0, wrong]))
    assert not rmath.bounded(jnp.array(-1e-3), low=0.0)
    assert rmath.bounded(jnp.zeros(0))


def test_psd_solve_error_in_float32_is_bounded_by_the_condition(batched_solve):
    rng = np.random.default_rng(4)
    for condition in (1e1, 1e3, 1e5):
        A = np.stack([_spd(rng, condition) for _ in range(50)]).astype(np.float32)
        b = rng.normal(size=(50, 7)).astype(np.float32)
        expected = np.linalg.solve(A.astype(float), b.astype(float)[..., None])[..., 0]
        x = np.asarray(batched_solve(A, b))
        error = np.linalg.norm(x - expected, axis=1) / np.linalg.norm(expected, axis=1)
        # condition times epsilon times 2: the backward error of LDL^T at n = 7 is
        # about one epsilon.
        assert error.max() < 2 * condition * np.finfo(np.float32).eps


def test_psd_solve_does_not_care_about_the_units_of_the_rows(batched_solve):
    rng = np.random.default_rng(5)
    A = np.stack([_spd(rng, 30.0) for _ in range(50)])
    b = rng.normal(size=(50, 7))
    units = 10.0 ** rng.uniform(-5, 5, size=(50, 7))
    scaled = units[:, :, None] * A * units[:, None, :]
    x = batched_solve(jnp.asarray(scaled, jnp.float32), jnp.asarray(units * b))
    expected = np.linalg.solve(A, b[..., None])[..., 0]
    error = np.linalg.norm(x * units - expected, axis=1)
    # 1e-4 relative: condition 30, not the 1e20 of the scaled matrices.
    assert (error / np.linalg.norm(expected, axis=1)).max() < 1e-4


def test_psd_solve_of_singular_and_zero_matrices_is_finite_with_finite_gradient():
    row = jnp.asarray([1.0, -2.0, 3.0])
    singular = jnp.outer(row, row)
    x = rmath.psd_solve(singular, singular @ jnp.ones(3))
    # 1e-5: the answer is one of many; it must satisfy the equations.
    np.testing.assert_allclose(singular @ x, singular @ jnp.ones(3), atol=1e-5)
    np.testing.assert_array_equal(
        rmath.psd_solve(jnp.zeros((3, 3)), jnp.zeros(3)), jnp.zeros(3)
    )
    for A in (singular, jnp.zeros((3, 3))):
        grads = jax.grad(lambda A, b: jnp.sum(rmath.psd_solve(A, b)), (0, 1))(A, row)
        assert all(np.all(np.isfinite(g)) for g in grads)


def test_psd_solve_takes_several_right_hand_sides():
    rng = np.random.default_rng(6)
    A = jnp.asarray(_spd(rng, 10.0, 4), jnp.float32)
    # 1e-5: condition 10 in float32.
    np.testing.assert_allclose(
        A @ rmath.psd_solve(A, jnp.eye(4)), jnp.eye(4), atol=1e-5
    )


def test_psd_solve_differentiates_like_the_linear_solve():
    rng = np.random.default_rng(7)
    A, b = _spd(rng, 10.0, 3), rng.normal(size=3)
    with jax.enable_x64(True):
        J = jax.jacrev(rmath.psd_solve, 1)(jnp.asarray(A), jnp.asarray(b))
        # 1e-12: float64 rounding.
        np.testing.assert_allclose(J, np.linalg.inv(A), atol=1e-12)


def test_psd_solve_names_the_shapes_that_do_not_match():
    with pytest.raises(ValueError, match=r"\(3, 3\), \(2,\)"):
        inspect.unwrap(rmath.psd_solve)(jnp.eye(3), jnp.ones(2))


def test_a_root_of_the_inverse_is_that_of_numpys_cholesky_factor_in_float64():
    # 1e-10: float64 rounding times a condition of about 1e4.
    rng = np.random.default_rng(3)
    root = rng.normal(size=(20, 7, 7))
    A = root @ root.swapaxes(1, 2) + 0.1 * np.eye(7)
    with jax.enable_x64(True):
        R = np.asarray(jax.jit(jax.vmap(rmath.inverse_root))(A))
    np.testing.assert_allclose(R, np.linalg.inv(np.linalg.cholesky(A)), atol=1e-10)
    np.testing.assert_allclose(R.swapaxes(1, 2) @ R, np.linalg.inv(A), atol=1e-10)


def test_the_root_of_an_inverse_stays_finite_where_rounding_takes_the_definiteness():
    """Rank 3 of 7 and what float32 leaves of it, some eigenvalues below zero."""
    J = np.random.default_rng(4).normal(size=(50, 3, 7)) * 300.0
    A = np.float32(J.swapaxes(1, 2) @ J)
    assert np.any(np.linalg.eigvalsh(A.astype(float)) < -1e-3)
    assert np.all(np.isfinite(jax.jit(jax.vmap(rmath.inverse_root))(A)))


def test_the_root_of_an_inverse_is_zero_where_its_pivots_multiply_up():
    A = np.zeros((7, 7), np.float32)
    assert not np.any(np.isnan(rmath.inverse_root(jnp.asarray(A))))
    huge = 1e-38 * np.ones((7, 7), np.float32)
    assert np.all(np.isfinite(rmath.inverse_root(jnp.asarray(huge))))


RNG = np.random.default_rng(0)
A, B = (RNG.normal(size=(5, 3)).astype(np.float32) for _ in range(2))


def test_a_materialised_array_is_the_same_array_with_the_same_gradient():
    np.testing.assert_array_equal(materialize(jnp.asarray(A)), A)
    gradient = jax.grad(lambda x: jnp.sum(materialize(x) * B))(jnp.asarray(A))
    np.testing.assert_array_equal(gradient, B)
    assert jax.vmap(materialize)(jnp.asarray(A)).shape == A.shape


RNG = np.random.default_rng(0)
A, B = (RNG.normal(size=(5, 3)).astype(np.float32) for _ in range(2))


def test_arithmetic_is_that_of_arrays():
    """1e-6: a few float32 roundings of numbers of order one."""
    a, b = Vec.of(A), Vec.of(B)
    for ours, expected in (
        (a + b, A + B),
        (a - b, A - B),
        (a * 2.5, A * 2.5),
        (a.cross(b), np.cross(A, B)),
        (a.map(jnp.maximum, b), np.maximum(A, B)),
    ):
        np.testing.assert_allclose(ours.stack(-1), expected, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(a @ b, np.sum(A * B, axis=1), rtol=1e-5, atol=1e-6)


def test_split_and_stack_are_inverse_along_any_axis():
    for axis in (0, 1, -1):
        x = RNG.normal(size=(3, 3))
        np.testing.assert_array_equal(Vec.of(x, axis).stack(axis), np.float32(x))


def test_columns_broadcast_over_points():
    difference = Vec.of(A[None]) - Vec.column(B[:2])
    np.testing.assert_allclose(difference.stack(-1), A[None] - B[:2, None], rtol=1e-6)


def test_stack_broadcasts_components():
    assert Vec(jnp.zeros(4), jnp.zeros(()), jnp.ones((2, 1))).stack().shape == (3, 2, 4)

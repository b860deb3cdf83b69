"""The comparison with Brax's own loop, as far as it runs without that."""

import jax
import pytest

from benchmarks.studies import parity


def test_a_summary_has_curve_interval_and_last_return():
    curves = [[(0, 0.0), (10, 1.0)], [(0, 2.0), (10, 5.0)]]
    found = parity.summary(curves)
    assert found["steps"] == [0, 10]
    assert found["return"] == [1.0, 3.0]
    assert found["low"] == [0.0, 1.0] and found["high"] == [2.0, 5.0]
    assert found["last"][0] == 3.0 and found["mean_over_training"][0] == 2.0


def test_our_loop_is_evaluated_at_equal_distances():
    size = parity.SIZES["num_envs"] * parity.SIZES["unroll_length"]
    curve = parity.train_ours(parity.Reach(), 2 * size, 3, seed=0)
    assert [steps for steps, _ in curve] == [0, size, 2 * size]
    # 50 steps of a reward in [1 - 2 sqrt 2, 1]
    assert all(-92.0 < value < 50.0 for _, value in curve)


@pytest.mark.skipif(hasattr(jax, "device_put_replicated"), reason="Brax trains here")
def test_a_jax_that_brax_cannot_use_is_refused(capsys):
    assert parity.main([]) == 2
    assert "needs jax 0.9" in capsys.readouterr().err

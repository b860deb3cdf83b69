"""The same policy steps on MJX and on the C engine."""

import jax.numpy as jnp
import numpy as np
import pytest

from tests.envs.arm_tasks import LANES


def test_both_engines_step_the_task_alike(make, close, quiet):
    """Free motion, then one lane falls onto the table.

    Before contact the observations agree to 1e-3; the impact happens in the same
    policy step, its mean force over the step agrees within 10 %, its peak within 20 %
    (float32 shifts a stiff impact by parts of a physics step).
    """
    switches = {"terminate_on_event": False, "terminate_on_success": False}
    options = {"observation": "fixed", "layout": "close", "event_penalty": 7.0}
    mjx = make("torques", physics="mjx", **switches, **options)
    action = jnp.zeros((LANES, 12)).at[0, 1].set(-25.0)
    ours, theirs = quiet, quiet
    flags = []
    for _ in range(10):
        ours, theirs = mjx.step(ours, action), close.step(theirs, action)
        flags = [np.asarray(s.metrics["collision"]) for s in (ours, theirs)]
        np.testing.assert_array_equal(flags[0], flags[1])
        if np.any(flags[1]):
            break
        np.testing.assert_allclose(ours.obs, theirs.obs, atol=1e-3)
    np.testing.assert_array_equal(flags[1], np.eye(LANES)[0])
    for name, rel in (("contact_force", 0.1), ("contact_force_peak", 0.2)):
        force = [float(s.metrics[name][0]) for s in (ours, theirs)]
        assert force[1] > 1.0
        assert force[0] == pytest.approx(force[1], rel=rel)

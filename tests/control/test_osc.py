"""OSC with a fixed impedance: VICES at one stiffness, whatever the policy says."""

import numpy as np

from rmp_mjx.control.osc import OSC


def test_it_is_vices_at_its_own_stiffness(run64, robot, vices, states, obstacles):
    """1e-9 of the torque limits: the stiffness goes through a logarithm and back."""
    q, qd, action = states(5)
    osc = OSC(robot)
    span = osc.action_range
    same = 2.0 * np.log(osc.kp / span.kp_min) / np.log(span.kp_max / span.kp_min) - 1.0
    fixed = np.concatenate([action[:, :6], np.full((len(q), 6), same)], axis=1)
    near = obstacles(5)
    ours, theirs = run64(osc, q, qd, action, near), run64(vices, q, qd, fixed, near)
    error = np.abs(ours.tau - theirs.tau) / robot.tau_max
    assert error.max() < 1e-9
    assert np.abs(ours.tau - run64(vices, q, qd, action, near).tau).max() > 1.0

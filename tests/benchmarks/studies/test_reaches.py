"""Random chains are arms like any other; what a reach counts, and where it stands."""

import numpy as np
import pytest

from benchmarks.common import Row
from benchmarks.studies import reaches
from benchmarks.studies.chains import JOINTS, random_chain
from rmp_mjx.check_robot.certificate import certify


@pytest.fixture(scope="module")
def chains():
    return [random_chain(seed) for seed in range(50)]


def test_random_chains_have_hinges_and_slides_and_every_number_of_joints(chains):
    assert {chain.n for chain in chains} == set(range(JOINTS[0], JOINTS[1] + 1))
    slides = np.concatenate([~np.array(chain.hinge) for chain in chains])
    assert 0.1 < slides.mean() < 0.3
    assert all(np.isinf(chain.q_upper[0]) for chain in chains)


def test_a_seed_names_a_chain():
    assert random_chain(7).mjcf == random_chain(7).mjcf != random_chain(8).mjcf
    assert random_chain(7, joints=5).n == 5


def agrees(chain):
    """In float64; the text has all digits. 1e-12: rounding over nine joints."""
    for terms in certify(chain).values():
        assert max(terms.values()) < 1e-12


def test_random_chains_are_what_mujoco_and_pinocchio_say(chains):
    """The longest one, with slides."""
    agrees(max(chains, key=lambda chain: (chain.n, sum(not h for h in chain.hinge))))


@pytest.mark.slow
def test_fifty_random_chains_are_what_mujoco_and_pinocchio_say(chains):
    for chain in chains:
        agrees(chain)


def test_figures_of_several_arms_are_summed_but_for_the_greatest_error():
    one = {"error/MuJoCo C": 1e-15, "reaches": 8.0, "vices/contact": 1.0}
    two = {"error/MuJoCo C": 3e-15, "reaches": 8.0, "vices/contact": 2.0}
    total = reaches.together([one, two])
    assert total == {"error/MuJoCo C": 3e-15, "reaches": 16.0, "vices/contact": 3.0}
    rows = reaches.rows_of("chains", total, 2)
    assert rows[0] == Row("chains/error/MuJoCo C", 3e-15, "", "greatest of 2")
    assert rows[1] == Row("chains/vices/contact", 3.0, "", "of 16 reaches")


def test_the_table_goes_from_vices_to_ours():
    kinds = ("reached", "contact", "joint_limit", "joint_velocity")
    found = {f"{name}/{kind}": 4.0 for name in reaches.CONTROLLERS for kind in kinds}
    found |= {"error/MuJoCo C": 2e-15, "reaches": 24.0, "rmp_vices/contact": 0.0}
    line = reaches.table(reaches.rows_of("panda", found, 1)).splitlines()[2]
    assert line.startswith("| `panda` | 24 | 4 -> **4** | 4 -> **0** |")
    assert line.endswith("| 2e-15 |")

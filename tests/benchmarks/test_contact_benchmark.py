"""Contacts of the benchmark: this package and MuJoCo compute the motion of the closed forms."""

import numpy as np
import pytest

from benchmarks.contenders.contact import CONTACTS, contact_case, mujoco_contacts, our_contacts


def largest_error(contender):
    reached = contender.prepare(0)()
    return contender.error(np.array(reached() if callable(reached) else reached))


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("name", CONTACTS)
def test_motions_are_those_of_the_closed_forms(name):
    assert min(largest_error(each) for each in our_contacts(contact_case(name), quick=True)) < 2e-13


@pytest.mark.parametrize("name", CONTACTS)
def test_bodies_move_in_mujoco_about_as_in_the_closed_forms(name):
    pytest.importorskip("mujoco", reason="extra bench")
    _, contender = mujoco_contacts(contact_case(name), quick=True)
    assert 1e-6 < largest_error(contender) < 0.06

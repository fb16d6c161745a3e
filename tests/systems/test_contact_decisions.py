"""Recorded decisions of contacts satisfy the conditions of the contact problem."""

import itertools

import numpy as np
import pytest
from contact_decisions import FORCES, IMPULSES, JUMP, decisions

pytestmark = pytest.mark.second


def test_recorded_forces_satisfy_the_conditions_of_contacts() -> None:
    recorded = list(decisions())
    solved = [decision for decision in recorded if decision.solved]
    assert {decision.kind for decision in recorded} == {FORCES, IMPULSES, JUMP}
    assert len(recorded) - len(solved) < 0.01 * len(recorded)
    assert max(decision.violation(decision.of_rows["force"]) for decision in solved) < 1e-10


def test_other_forces_violate_them() -> None:
    """Of redundant contacts, too: a change of one force changes the rate of its own row."""
    for decision in itertools.islice(decisions(), 0, None, 50):
        force = decision.of_rows["force"].copy()
        row = int(np.abs(force).argmax())
        if decision.solved and force[row] != 0:
            terms = decision.of_rows["terms" if decision.kind == FORCES else "speed"]
            force[row] *= 1 + 1e-6 * max(1.0, terms[row] / abs(force[row] * decision.W[row, row]))
            assert decision.violation(force) > 1e-9

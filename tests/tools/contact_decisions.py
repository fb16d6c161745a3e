"""Decisions of the machinery of contacts: ``corpus/contact_decisions.md`` says what the data are.

A solver of the contact problem is asked the same ones, and its answers are judged by the conditions, not by the
recorded ones: a problem may have several solutions.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

RECORDED = Path(__file__).parents[1] / "corpus" / "contact_decisions.npz"
FORCES, IMPULSES, JUMP = range(3)
"""Kinds: forces by second rates, impulses by rates, impulses without collision (Painleve's paradox)."""
HELD, CLOSED_BY_OTHERS, STUCK_BY_OTHERS = 1, 2, 4
OF_ALL = ("kind", "solved", "lifts", "step", "contacts", "rows", "test")
OF_CONTACTS = (
    *("normal", "slip", "slips", "free", "rests", "begins", "static", "given"),
    *("closed", "sticks", "held", "direction", "friction", "friction_at_rest", "restitution"),
)
OF_ROWS = ("b", "terms", "start", "force", "rate", "speed")


@dataclass(frozen=True)
class Decision:
    """One decision: fields of the data, of this decision."""

    name: str
    kind: int
    solved: bool
    lifts: bool
    step: float
    of_contacts: dict[str, NDArray[np.generic]]
    of_rows: dict[str, NDArray[np.float64]]
    W: NDArray[np.float64]

    def limit(self, k: int, force: NDArray[np.float64], *, at_rest: bool) -> float:
        """Largest friction of a contact: by its normal force, or as it is without a gap."""
        friction = self.of_contacts["friction_at_rest" if at_rest else "friction"][k]
        normal = int(self.of_contacts["normal"][k])
        return float(friction * (force[normal] if normal >= 0 else 1.0))

    def violation(self, force: NDArray[np.float64]) -> float:
        """Largest violation of a condition by forces in the recorded modes, in rates relative to their terms.

        Normal forces and rates are not negative, and one of them is 0; friction is within its limit, at the limit of
        sliding against the slip, and what sticks has no slip.
        """
        at = self.of_contacts
        rate = self.of_rows["b"] + self.W @ force
        size = np.maximum(np.abs(self.of_rows["b"]), self.of_rows["terms" if self.kind == FORCES else "speed"])
        of_own = np.sqrt(np.diag(self.W))
        size = size + of_own * (of_own @ np.abs(force))
        largest = 0.0
        for k in map(int, np.flatnonzero(~np.asarray(at["free"], dtype=bool))):
            n, first, count = (int(at[name][k]) for name in ("normal", "slip", "slips"))
            closed, sticks = bool(at["closed"][k]), int(at["sticks"][k]) or int(at["held"][k]) & STUCK_BY_OTHERS
            rows = slice(first, first + count)
            of_contact = size[[*range(first, first + count), *([n] if n >= 0 else [])]].max()
            violated = []
            if n >= 0:
                violated += [abs(rate[n]) if closed else -rate[n], -force[n] * self.W[n, n]]
            if n >= 0 and not closed:
                violated += [abs(force[n]) * self.W[n, n]]
            if count and closed:
                friction, slip = force[rows], rate[rows]
                is_held = bool(int(at["held"][k]) & HELD)
                within = self.limit(k, force, at_rest=bool(sticks or is_held) and bool(at["static"][k]))
                violated += [(np.linalg.norm(friction) - within) * self.W[first, first]]
                if sticks:
                    violated += [np.linalg.norm(slip)]
                elif (at["rests"][k] or at["begins"][k]) and not is_held and within > 0:
                    opposed = friction * np.linalg.norm(slip) + within * slip
                    violated += [np.abs(opposed).max() / within]
                if not sticks:
                    excess = friction + self.limit(k, force, at_rest=False) * np.asarray(at["direction"][k])[:count]
                    violated += [np.abs(excess).max() * self.W[first, first]]
            largest = max([largest, *(float(value / of_contact) for value in violated if value > 0)])
        return largest


def decisions() -> Iterator[Decision]:
    """Return all recorded decisions, one after another."""
    with np.load(RECORDED) as data:
        whole = {name: data[name] for name in (*OF_ALL, *OF_CONTACTS, *OF_ROWS, "W", "names")}
    contact = row = entry = 0
    for i, (count, rows) in enumerate(zip(whole["contacts"].astype(int), whole["rows"].astype(int), strict=True)):
        W = np.zeros((rows, rows))
        W[np.tril_indices(rows)] = whole["W"][entry : entry + rows * (rows + 1) // 2]
        yield Decision(
            name=str(whole["names"][whole["test"][i]]),
            kind=int(whole["kind"][i]),
            solved=bool(whole["solved"][i]),
            lifts=bool(whole["lifts"][i]),
            step=float(whole["step"][i]),
            of_contacts={name: whole[name][contact : contact + count] for name in OF_CONTACTS},
            of_rows={name: whole[name][row : row + rows] for name in OF_ROWS},
            W=W + np.tril(W, -1).T,
        )
        contact, row, entry = contact + count, row + rows, entry + rows * (rows + 1) // 2

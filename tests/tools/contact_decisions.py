"""Decisions of the machinery of contacts: ``corpus/contact_decisions.md`` says what the data are.

A solver of the contact problem is asked the same ones, and its answers are judged by the conditions, not by the
recorded ones: a problem may have several solutions.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
from contact_problem import Problem
from numpy.typing import NDArray

RECORDED = Path(__file__).parents[1] / "corpus" / "contact_decisions.npz"
FORCES, IMPULSES, JUMP = range(3)
"""Kinds: forces by second rates, impulses by rates, impulses without collision (Painleve's paradox)."""
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

    @property
    def problem(self) -> Problem:
        """The problem, in which impulses and impulses without collision have sliding friction at rest."""
        at = self.of_contacts
        takes_part, has_slip = ~np.asarray(at["free"], dtype=bool), np.asarray(at["slips"]) > 0
        rests = np.asarray(at["rests"], dtype=bool) & takes_part
        moves = has_slip & ~(rests | np.asarray(at["begins"], dtype=bool)) & (self.kind == FORCES)
        places = [tuple(map(int, of)) for of in zip(at["normal"], at["slip"], at["slips"], strict=True)]
        return Problem(
            self.W,
            self.of_rows["b"],
            self.of_rows["terms" if self.kind == FORCES else "speed"],
            cast("list[tuple[int, int, int]]", places),
            ~takes_part,
            np.asarray(at["static"], dtype=bool) & rests & (np.asarray(at["begins"]) == 0),
            np.asarray(at["friction"], dtype=float),
            np.asarray(at["friction_at_rest"], dtype=float),
            np.where(moves[:, None], at["given"], 0.0),
        )


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

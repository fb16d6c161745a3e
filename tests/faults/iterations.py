"""Faults of what leads to a step: guesses, factors of masses, matrices in a band; none changes the step it leads to."""

from certified_cases import case
from faults import text

ITERATIONS = (
    text(
        "guesses from one step by the table for two",
        case("cart/svi"),
        r"\{LAST_ALONE, LAST, BEFORE\}",
        "{LAST, LAST, BEFORE}",
    ),
    text(
        "guesses from two steps exchanged",
        case("tangle/svi"),
        r"\{LAST_ALONE, LAST, BEFORE\}",
        "{LAST_ALONE, BEFORE, LAST}",
    ),
    text(
        "a mass wrong from three coordinates on",
        case("tangle/svi"),
        r"for \(int k = j \+ 1; k < i;",
        "for (int k = j + 2; k < i;",
    ),
    text("factors of the mass not subtracted", case("tangle/scvi"), r"mass\[i \* M \+ k\] -= [^;]*;", ";"),
    text(
        "a band without room for exchanges",
        case("chain/svi-4"),
        r"k - 2 \* shape->reach, 0\), k, column",
        "k - shape->reach, 0), k, column",
    ),
    text("a band one too narrow", case("chain/svi-4"), r"\(BAND \+ 1\) \* blocks - 1", "BAND * blocks"),
)

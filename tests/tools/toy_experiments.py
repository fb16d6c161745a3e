"""A small catalogue for the tests of the runner and of the report: everything a result can hold, and all that fails."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping

import numpy as np

from scvi_codegen.common.display.tables import TableBlock
from scvi_codegen.extras.paper.experiment import (
    Comparison,
    Experiment,
    Panel,
    Picture,
    Result,
    Series,
    Verdict,
    judged,
    largest_in_bins,
)

LONG_LINE = "double energy = 0.5*(v[0]*v[0] + v[1]*v[1]) - mu/sqrt(q[0]*q[0] + q[1]*q[1]);  /* kept on one line */"


def picture(t: np.ndarray, svi: np.ndarray, sc: np.ndarray) -> Picture:
    errors = [
        Series(x=largest_in_bins(t, e)[0], y=largest_in_bins(t, e)[1], scheme=s, label=s)
        for e, s in ((svi, "SVI"), (sc, "SC"))
    ]
    circle = Series(x=np.cos(t), y=np.sin(t), scheme="exact")
    line = Series(x=[0.01, 1.0], y=[1e-6, 1.0], scheme="exact", end="$h^3$", line=":", marker="o")
    return Picture(
        panels=(
            Panel(title="energy error", series=tuple(errors), xlabel="t", log="y", floor=1e-12),
            Panel(title="orbit", series=(circle,), xlabel="$q_1$", ylabel="$q_2$", equal=True, window=(-2.0, 2.0)),
            Panel(title="order", series=(line,), log="xy"),
        ),
        columns=2,
    )


def figure_4(results: Mapping[str, Result]) -> Result:
    t = np.linspace(0.0, 50.0, 2000)
    svi, sc = 1e-9 * (1.1 + np.sin(t)), 1e-9 * np.exp(0.3 * t)
    largest = float(svi.max()), float(sc.max())
    return Result(
        name="figure-4",
        title="Energy errors of <SVI> & SC",
        setting=(
            "Harmonic oscillator, h = 1e-1, T = 50.",
            "The caption does not say how many Gauss points; s were taken.",
        ),
        checks=(
            Comparison(
                claim="SVI keeps the energy better than SC.",
                measured=f"The largest errors are {largest[0]:.2e} and {largest[1]:.2e}, that is h^2 < 1 & -1 > -2.",
                verdict=judged(largest[0] < largest[1]),
                bears_on=("accuracy",),
            ),
            Comparison(claim="SC is stable.", measured="It is not.", verdict=Verdict.FAILS),
        ),
        tables=(
            TableBlock(
                columns=("method", "largest error", "steps"), rows=(("SVI", largest[0], 500), ("SC", largest[1], None))
            ),
            TableBlock(
                name="series", columns=("t", "SVI"), rows=tuple(zip(t.tolist(), svi.tolist(), strict=True)), shown=False
            ),
        ),
        picture=picture(t, svi, sc),
    )


def section(results: Mapping[str, Result]) -> Result:
    rows = (("<left> & right", 0.25), (LONG_LINE, None))
    return Result(
        name="section-3.1",
        title="The equations of one step",
        tables=(TableBlock(columns=("They are solved for Q^1 and Q^2 <the positions>.", "size"), rows=rows),),
    )


def table_8(results: Mapping[str, Result]) -> Result:
    columns = tuple(
        f"{name} of {method}" for method in ("SVI", "SC", "SRK") for name in ("iterations", "error", "time")
    )
    row = (8, 1.25e-11, 0.5, None, None, None, 1520, 0.25, 1e-3)
    verdict = results["figure-4"].verdict
    return Result(
        name="table-8",
        title="Iterations",
        setting=("One setting.",),
        checks=(Comparison(claim="As in Fig. 4.", measured="See figure-4, not figure-40.", verdict=verdict),),
        tables=(TableBlock(columns=columns, rows=(row, row), formats={"time of SVI": ".2f"}),),
    )


def shown(results: Mapping[str, Result]) -> Result:
    return Result(name="table-9", title="Numbers alone", setting=("None.",))


def broken(results: Mapping[str, Result]) -> Result:
    raise ValueError("no such\nluck")


def crash(results: Mapping[str, Result]) -> Result:
    os._exit(7)


def unportable(results: Mapping[str, Result]) -> Result:
    return Result(name="unportable", title="", setting=(), tables=(TableBlock(columns=(), rows=(lambda: None,)),))


def slow(results: Mapping[str, Result]) -> Result:
    time.sleep(600.0)
    raise AssertionError("it was not interrupted")


_ALL = (
    Experiment(name="section-3.1", title="Section 3.1", run=section),
    Experiment(name="figure-4", title="Energy errors", run=figure_4),
    Experiment(name="table-8", title="Iterations", run=table_8, needs=("figure-4",)),
    Experiment(name="table-9", title="Numbers alone", run=shown),
    Experiment(name="broken", title="Fails", run=broken),
    Experiment(name="after-broken", title="Cannot run", run=shown, needs=("figure-4", "broken")),
    Experiment(name="last", title="Cannot run either", run=shown, needs=("after-broken",)),
    Experiment(name="crash", title="Ends its process", run=crash),
    Experiment(name="unportable", title="Cannot travel", run=unportable),
    Experiment(name="slow", title="Takes a minute", run=slow),
)
EXPERIMENTS = {experiment.name: experiment for experiment in _ALL}
GOOD = ("section-3.1", "figure-4", "table-8", "table-9")

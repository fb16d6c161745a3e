"""Tables 6 and 7: time and accuracy of SRK, SVI and SC at the paper's settings."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.compiler import compile_stepper
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.methods import Gauss, SpectralCollocation
from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.methods.method import Method
from scvi_codegen.models.systems import duffing, planar_pendulum
from scvi_codegen.reproduce.laboratory.experiment import (
    Comparison,
    Result,
    TableBlock,
    Verdict,
    experiment,
    holds,
    judged,
)
from scvi_codegen.reproduce.laboratory.running import ROUNDOFF, SECTION_3, steps_in
from scvi_codegen.runtime.core.stepper import Stepper

ROUNDS = 15
"""Number of timed runs of each scheme, in turn with the others."""

SAME = 0.05
"""Relative difference below which times count as equal."""

REFERENCE, FINER = SVI(12), 4
"""Reference method for the final position, and the number of its steps per step."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CostSetting:
    """Setting of a table.

    Attributes:
        number: number of the table.
        problem: description.
        system, q, velocity, h, span: initial value problem and step size.
        methods: methods by scheme, SRK first.
        seconds: printed CPU times by scheme.
    """

    number: int
    problem: str
    system: LagrangianSystem
    q: tuple[float, ...]
    velocity: tuple[float, ...]
    h: float
    span: float
    methods: Mapping[str, Method]
    seconds: Mapping[str, float]

    @property
    def steps(self) -> int:
        """Number of steps that fill the span."""
        return steps_in(self.span, self.h)


SETTINGS: Mapping[int, CostSetting] = {
    6: CostSetting(
        number=6,
        problem="planar pendulum",
        system=planar_pendulum(),
        q=(0.5,),
        velocity=(0.0,),
        h=0.5,
        span=1000.0,
        methods={"SRK": Gauss(2), "SVI": SVI(3), "SC": SpectralCollocation(3)},
        seconds={"SRK": 13.73, "SVI": 4.94, "SC": 1.85},
    ),
    7: CostSetting(
        number=7,
        problem="Duffing oscillator",
        system=duffing(),
        q=(0.0,),
        velocity=(1.0,),
        h=0.6,
        span=2000.0,
        methods={"SRK": Gauss(3), "SVI": SVI(5), "SC": SpectralCollocation(5)},
        seconds={"SRK": 86.98, "SVI": 39.18, "SC": 4.35},
    ),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """Median seconds, largest relative energy error, and final position error over the largest |q|, of one scheme."""

    seconds: float
    energy: float
    position: float

    @property
    def seconds_a_digit(self) -> float:
        """Time per correct digit of the final position, infinite if there is none."""
        digits = -math.log10(self.position)
        return self.seconds / digits if digits > 0.0 else math.inf


@lru_cache(maxsize=2)
def costs(number: int) -> Mapping[str, Cost]:
    """Return time and errors by scheme."""
    setting = SETTINGS[number]
    steppers = {scheme: compile_stepper(setting.system, method) for scheme, method in setting.methods.items()}
    timed: dict[str, list[float]] = {scheme: [] for scheme in steppers}
    for _ in range(ROUNDS + 1):
        for scheme, stepper in steppers.items():
            timed[scheme].append(_seconds(stepper, setting))
    end = _reference(setting, FINER)
    return {
        scheme: Cost(seconds=statistics.median(timed[scheme][1:]), **_errors(stepper, setting, end))
        for scheme, stepper in steppers.items()
    }


def _seconds(stepper: Stepper, setting: CostSetting) -> float:
    run = stepper.start(setting.q, stepper.momentum(setting.q, setting.velocity), h=setting.h, options=SECTION_3)
    began = time.process_time()
    run.record(setting.steps, save_every=setting.steps)
    return time.process_time() - began


def _errors(stepper: Stepper, setting: CostSetting, end: NDArray[np.float64]) -> dict[str, float]:
    p = stepper.momentum(setting.q, setting.velocity)
    run = stepper.integrate(setting.q, p, h=setting.h, steps=setting.steps, options=SECTION_3)
    energy = run.energy()
    return {
        "energy": float(np.abs(energy / energy[0] - 1.0).max()),
        "position": float(np.abs(run.q[-1] - end).max() / np.abs(run.q).max()),
    }


def _reference(setting: CostSetting, finer: int) -> NDArray[np.float64]:
    """Return the position at the end of the last step."""
    stepper = compile_stepper(setting.system, REFERENCE)
    p, steps = stepper.momentum(setting.q, setting.velocity), setting.steps * finer
    end: NDArray[np.float64] = stepper.integrate(
        setting.q, p, h=setting.h / finer, steps=steps, save_every=steps, options=ROUNDOFF
    ).q[-1]
    return end


def _result(setting: CostSetting, _: Mapping[str, Result]) -> Result:
    result = costs(setting.number)
    names = {scheme: method.name for scheme, method in setting.methods.items()}
    doubt = float(np.abs(_reference(setting, FINER) - _reference(setting, 2 * FINER)).max())
    return Result(
        setting=(
            f"{setting.problem.capitalize()}, h = {setting.h}, T = {setting.span:g} ({setting.steps} steps), "
            "iteration ended by the paper's rule, TOL = 1e-14: "
            f"SRK is {names['SRK']}, SVI is {names['SVI']}, SC is {names['SC']}.",
            "The paper names neither the quadrature of SVI, here as many Gauss points as the degree, which makes it "
            "the Gauss method with its number of stages, nor the machine; ratios of times are compared.",
            f"Processor time of one trajectory in compiled C, solver 'auto': medians of {ROUNDS} runs, the three "
            "schemes in turn.",
            f"The final position is compared with SVI of degree {REFERENCE.degree} at h/{FINER}, which differs from "
            f"that at h/{2 * FINER} by {doubt:.0e}; its error is given relative to the largest |q| of the run.",
        ),
        checks=tuple(_checks(setting, result)),
        tables=(_table(setting, result),),
    )


def _table(setting: CostSetting, result: Mapping[str, Cost]) -> TableBlock:
    return TableBlock(
        columns=(
            "scheme",
            "method",
            "ms",
            "over SRK",
            "s (paper)",
            "over SRK (paper)",
            "energy error",
            "position error",
            "ms a digit",
        ),
        rows=tuple(
            (
                scheme,
                setting.methods[scheme].name,
                1e3 * cost.seconds,
                cost.seconds / result["SRK"].seconds,
                setting.seconds[scheme],
                setting.seconds[scheme] / setting.seconds["SRK"],
                cost.energy,
                cost.position,
                1e3 * cost.seconds_a_digit if cost.position < 1.0 else None,
            )
            for scheme, cost in result.items()
        ),
        formats={"over SRK": ".2f", "s (paper)": ".2f", "over SRK (paper)": ".2f"}
        | {"energy error": ".1e", "position error": ".1e"},
    )


def _checks(setting: CostSetting, result: Mapping[str, Cost]) -> Sequence[Comparison]:
    srk, svi, sc = (result[scheme] for scheme in ("SRK", "SVI", "SC"))
    ratio, printed = svi.seconds / srk.seconds, setting.seconds["SVI"] / setting.seconds["SRK"]
    share = svi.seconds_a_digit / srk.seconds_a_digit
    by_sc = svi.seconds / sc.seconds
    return (
        Comparison(
            claim=f"SVI takes less time than SRK at the same step ({printed:.2f} of it).",
            measured=f"SVI takes {ratio:.2f} of the time of SRK ({1e3 * svi.seconds:.2f} and "
            f"{1e3 * srk.seconds:.2f} ms).",
            verdict=_cheaper(ratio),
            bears_on=("svi-cheaper", "efficiency"),
        ),
        Comparison(
            claim="SVI is more accurate than SRK at the same step.",
            measured=f"Energy error {svi.energy:.1e}, that of SRK {srk.energy:.1e}; error of the final position "
            f"{svi.position:.1e}, that of SRK {srk.position:.1e}.",
            verdict=judged(svi.energy < srk.energy, svi.position < srk.position),
            bears_on=("svi-cheaper", "efficiency"),
        ),
        Comparison(
            claim="SVI reaches higher accuracy at a lower cost than SRK.",
            measured=f"A correct digit of the final position takes {_of_a_digit(svi)} with SVI and "
            f"{_of_a_digit(srk)} with SRK{f', a ratio of {share:.2f}' if share > 0.0 else ''}.",
            verdict=_cheaper(share),
            bears_on=("svi-cheaper", "efficiency"),
        ),
        Comparison(
            claim=f"SVI costs more than SC ({setting.seconds['SVI'] / setting.seconds['SC']:.1f} times).",
            measured=f"SVI takes {by_sc:.2f} of the time of SC.",
            verdict=_cheaper(1.0 / by_sc),
        ),
        Comparison(
            claim="SVI is much more accurate than SC over the long run.",
            measured=f"Energy error {svi.energy:.1e}, that of SC {sc.energy:.1e}; error of the final position "
            f"{svi.position:.1e}, that of SC {sc.position:.1e}.",
            verdict=judged(svi.energy < sc.energy / 10.0, svi.position < sc.position / 10.0),
            bears_on=("accuracy", "efficiency"),
        ),
    )


def _of_a_digit(cost: Cost) -> str:
    milliseconds = 1e3 * cost.seconds_a_digit
    return f"{milliseconds:.2f} ms" if math.isfinite(milliseconds) else "no time at all (there is none)"


def _cheaper(ratio: float) -> Verdict:
    """Return the verdict for a ratio of times; in part if the times are equal."""
    return Verdict.PARTLY if abs(ratio - 1.0) <= SAME else holds(ratio < 1.0)


for setting in SETTINGS.values():
    title = f"Computational cost, {setting.problem}"
    experiment(f"table-{setting.number}", title)(partial(_result, setting))

"""The benchmark: this project and other integrators side by side, at equal error.

    cases       problems, eight initial states each, accelerations solved for by hand
    references  where they end, in extended precision; independent of the project's steppers
    ours        this project's steppers on a ladder of steps
    peers       heyoka, REBOUND, CyRK, JiTCODE, SciPy at several tolerances
    measuring   all of them timed in turn, in one process
    curves      time at equal error, by interpolation
    report      table, JSON;  picture: the work-precision plot
    drift       the energy over ten million steps

The rules: medians of alternating rounds; stepping time only, compile time apart; every peer with the best options and
the best formulation we know of, which are named; no step or tolerance chosen with the answer known, but whole curves.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from scvi_codegen.benchmark.cases import CASES, Case, case
from scvi_codegen.benchmark.contenders import Contender
from scvi_codegen.benchmark.drift import drift_table, measure_drift
from scvi_codegen.benchmark.machine import machine
from scvi_codegen.benchmark.measuring import measure
from scvi_codegen.benchmark.ours import RUNGS, Advice, our_contenders
from scvi_codegen.benchmark.peers import PEERS, missing_module, peer_contenders
from scvi_codegen.benchmark.references import Reference, reference
from scvi_codegen.benchmark.report import CaseResult, as_json, table
from scvi_codegen.errors import StateError
from scvi_codegen.methods.method import Method

__all__ = ["CASES", "PEERS", "Plan", "benchmark", "run_case"]

QUICK_SHARE = 0.05
QUICK_RUNGS = 4
QUICK_REPEATS = 2
PEER_ERRORS = (ArithmeticError, AttributeError, ImportError, OSError, RuntimeError, TypeError, ValueError)
"""What a peer of an unknown version, or without its compiler, may raise; it is skipped by name."""

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """How to measure.

    Attributes:
        peers: names of the peers.
        repeats: timed rounds.
        quick: a twentieth of the span, few settings: to see that everything works.
        methods: of this project; by default SVI(8).
        advice: chooses a step without knowing the answer, for one more setting of this project.
    """

    peers: tuple[str, ...] = tuple(PEERS)
    repeats: int = 5
    quick: bool = False
    methods: tuple[Method, ...] = ()
    advice: Advice | None = None

    def __post_init__(self) -> None:
        for name in self.peers:
            if name not in PEERS:
                raise StateError(f"there is no peer '{name}'; known: {', '.join(PEERS)}")
        if self.repeats < 1:
            raise StateError(f"repeats must be at least 1, not {self.repeats}")


def run_case(chosen: Case, plan: Plan, say: Say = lambda text: None) -> CaseResult:
    """Compile everything for one case, then time it in turn."""
    if plan.quick:
        chosen = replace(chosen, span=chosen.span * QUICK_SHARE)
    say(f"{chosen.name}: reference")
    exact = reference(chosen)
    skipped: dict[str, str] = {}
    contenders = our_contenders(
        chosen, methods=plan.methods or None, rungs=QUICK_RUNGS if plan.quick else RUNGS, advice=plan.advice
    )
    contenders += _peer_contenders(chosen, plan, skipped, say)
    say(f"{chosen.name}: {len(contenders)} settings")

    def reference_of(contender: Contender) -> Reference:
        return exact if contender.momenta is None else reference(chosen, contender.momenta)

    found = measure(contenders, reference_of, repeats=QUICK_REPEATS if plan.quick else plan.repeats)
    return CaseResult(
        name=chosen.name,
        span=chosen.span,
        dimension=chosen.dimension,
        accuracy=exact.accuracy,
        measurements=tuple(found),
        skipped=skipped,
    )


def _peer_contenders(chosen: Case, plan: Plan, skipped: dict[str, str], say: Say) -> Iterator[Contender]:
    for name in plan.peers:
        missing = missing_module(PEERS[name])
        if missing is not None:
            skipped[name] = f"{missing} is not installed (pip install 'scvi-codegen[bench]')"
        elif not PEERS[name].suits(chosen):
            skipped[name] = "not for problems of this kind"
        else:
            say(f"{chosen.name}: compiling {name}")
            try:
                yield from peer_contenders(name, chosen, quick=plan.quick)
            except PEER_ERRORS as error:
                skipped[name] = f"{type(error).__name__}: {error}"


def benchmark(
    names: Sequence[str] = (),
    plan: Plan | None = None,
    *,
    json_path: str | None = None,
    plot_path: str | None = None,
    drift_steps: int = 0,
    say: Say = lambda text: None,
) -> str:
    """Measure cases and write what was asked for.

    Args:
        names: of the cases, by default all; with ``drift_steps`` none.
        plan: how to measure.
        json_path, plot_path: files to write.
        drift_steps: if positive, also run Kepler's problem for so many steps.
        say: told what is being done.

    Returns:
        The tables as text.
    """
    if plot_path is not None:
        from scvi_codegen.plotting import check_plot_path

        check_plot_path(plot_path)
    chosen = [case(name) for name in names or (() if drift_steps else CASES)]
    description = machine()
    results = [run_case(one, plan or Plan(), say) for one in chosen]
    drifts = measure_drift(drift_steps, say) if drift_steps else []
    if json_path is not None:
        data: dict[str, Any] = as_json(results, description) | {"drift": [asdict(row) for row in drifts]}
        Path(json_path).write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    if plot_path is not None and results:
        from scvi_codegen.benchmark.picture import plot_curves

        plot_curves(results, plot_path)
    text = [table(results, description)] if results else []
    return "\n\n".join([*text, *([drift_table(drifts)] if drifts else [])])

"""Certificates of array systems: correct integrators pass, faults in their loops are detected."""

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from commands import output_of
from either_system import either_system

import scvi_codegen as sc
from scvi_codegen.codegen import pipeline
from scvi_codegen.codegen.ir.equations import Control
from scvi_codegen.codegen.ir.program import ArrayProgram
from scvi_codegen.codegen.rendering.program_source import render_arrays
from scvi_codegen.codegen.rendering.source import Source
from scvi_codegen.extras.verification.arrays import small_start
from scvi_codegen.extras.verification.arrays.whole import WholeStart
from scvi_codegen.runs import compiler
from scvi_codegen.runs.products import Products
from scvi_codegen.runs.stepping.array_interface import read_arrays

RANDOM = np.random.default_rng(3)
BOND = "(r[bonds[b, 0], a] - r[bonds[b, 1], a])"
SYSTEMS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "ring": (
        {
            "coordinates": ["q[N]"],
            "parameters": {"k": 1.5},
            "lagrangian": "sum(i in N, q_dot[i]**2/2)"
            "- k*sum(i in N periodic, (q[i+1] - q[i])**2/2 + (q[i-1] - q[i])**4)",
        },
        {"q": 0.5 * np.sin(2 * np.pi * np.arange(700) / 700), "velocity": 0.1 * RANDOM.normal(size=700), "h": 0.1},
    ),
    "net": (
        {
            "coordinates": ["r[N, 2]"],
            "parameters": {"m[N]": 1, "k[B]": 3, "g": 0.5},
            "tables": ["bonds[B, 2]"],
            "lagrangian": "sum(i in N, m[i]*sum(a in 2, r_dot[i, a]**2)/2)"
            f"- sum(b in B, k[b]*sum(a in 2, {BOND}**2 + {BOND}**4)) + g*sum(i < j in N, r[i, 0]*r[j, 0])/40",
        },
        {
            "q": RANDOM.normal(size=(40, 2)),
            "velocity": np.zeros((40, 2)),
            "h": 0.02,
            "tables": {"bonds": [[k, (7 * k + 3) % 40] for k in range(40)]},
            "parameters": {"m": 1 + RANDOM.uniform(size=40)},
        },
    ),
    "waves": (
        {
            "coordinates": ["q[N]"],
            "momenta": ["p[N]"],
            "parameters": {"g": 1},
            "hamiltonian": "sum(i in N periodic, ((q[i+1] - q[i])**2 + (p[i+1] - p[i])**2)/2"
            "- g/4*(q[i]**2 + p[i]**2)**2)",
        },
        {"q": 0.3 * RANDOM.normal(size=50), "p": 0.3 * RANDOM.normal(size=50), "h": 0.05},
    ),
    "damped": (
        {
            "coordinates": ["q[N]"],
            "parameters": {"c": 0.2, "m[N]": 1},
            "lagrangian": "sum(i in N, m[i]*q_dot[i]**2/2) - sum(i in 0..N-2, (q[i+1] - q[i])**2)",
            "forces": {"q[i]": "-c*q_dot[i]**3", "q[N-1]": "cos(t)"},
        },
        {"q": RANDOM.normal(size=300), "velocity": RANDOM.normal(size=300), "h": 0.05, "parameters": {"m": 2.0}},
    ),
}


def certificate(name: str, method: str) -> sc.Certificate:
    """Return the certificate of one of the systems."""
    given, start = SYSTEMS[name]
    system = either_system(name=name, **given)
    return sc.verify(system, method, **start)


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "method"),
    [("ring", "svi:3"), ("net", "svi:2"), ("net", "composition:8"), ("waves", "gauss:2"), ("damped", "svi:2")],
)
def test_correct_integrators_pass(name: str, method: str) -> None:
    """Every property is measured except velocities of a Hamiltonian."""
    found = certificate(name, method)
    assert found.passed, found.to_text()
    assert {check.name for check in found.checks} >= {
        "unrolled system",
        "stage equations",
        "rates",
        "energies",
        "reversal at full size",
    }
    assert [check.name for check in found.not_measured] == ["Legendre transform"] * (name == "waves")


FAULTS = {
    "a ring that closes one place off": ("ring", "svi:2", r"place - size;", "place - size + 1;"),
    "a part of a ring one too long": ("ring", "svi:2", r"\*end = change;", "*end = change + 1;"),
    "a force of the other sign": ("net", "svi:2", r"(F\[start_r [^;]*?) \+= ", r"\1 -= "),
    "the other end of a bond": ("net", "svi:2", r"bonds\[index_b \* 2 \+ 0\]", "bonds[index_b * 2 + 1]"),
    "friction by velocities at the start": (
        "damped",
        "svi:2",
        r"step->p0\[i\] \+ kick\)",
        "step->p0[i] + 0.999 * kick)",
    ),
    "energy without masses": ("net", "svi:2", r"0\.5 \* inverse_mass\[i\] \* ", "0.5 * "),
    "positions off at the end": (
        "ring",
        "svi:2",
        r"number kick = data->inverse_mass\[i\] \* ",
        "number kick = 1.00000001 * data->inverse_mass[i] * ",
    ),
    "what rounding cuts off is lost": ("ring", "svi:2", r"\*low = rest - \(rounded - sum\);", "*low = 0.0;"),
    "positions by the rates of momenta": ("waves", "gauss:2", r"X, past\.now \+ n, ", "X, past.now, "),
    "a kick too long": ("net", "stoermer-verlet", r"h \* KICK\[last\]", "1.000000001 * h * KICK[last]"),
    "a long loop without its second part": (
        "ring",
        "stoermer-verlet",
        r"(add_force_0\([\s\S]*?begin < here->of.end; begin = )end",
        r"\1here->of.end",
    ),
}
QUICK = ("a ring that closes one place off",)


@pytest.mark.parametrize(("name", "method"), sorted({fault[:2] for fault in FAULTS.values()}))
def test_planted_faults_find_their_source_lines(name: str, method: str) -> None:
    """Rewritten source would otherwise disable its planted faults, noticed only by the full tier."""
    system = either_system(name=name, **SYSTEMS[name][0])
    code = pipeline.ArraySources(system, sc.as_method(method)).integrator()[0].amalgamated().code
    here = {what: fault[2] for what, fault in FAULTS.items() if fault[:2] == (name, method)}
    assert [what for what, pattern in here.items() if not re.search(pattern, code)] == []


@pytest.mark.rotated
@pytest.mark.parametrize(
    "fault", [pytest.param(name, marks=() if name in QUICK else pytest.mark.full) for name in FAULTS]
)
def test_planted_faults_are_detected(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """One at a time, in the text of the loops."""
    name, method, pattern, replacement = FAULTS[fault]
    edits = 0

    def rendered(program: ArrayProgram, control: Control | None) -> Source:
        nonlocal edits
        source = render_arrays(program, control).amalgamated()
        code, made = re.subn(pattern, replacement, source.code, count=1)
        edits += made
        return replace(source, code=code)

    monkeypatch.setattr(pipeline, "render_arrays", rendered)
    monkeypatch.setattr(compiler, "cached_source", lambda key, derive: derive())
    found = certificate(name, method)
    assert edits > 0
    assert found.violated, found.to_text()


@pytest.mark.rotated
def test_model_file_is_verified_and_run(tmp_path: Path) -> None:
    """Beside it lies the certificate; the exit status is 0. Plain sums differ by their rounding errors."""
    path = tmp_path / "oscillators.toml"
    path.write_text(
        """
        [system]
        name = "oscillators"
        coordinates = ["q[N]"]
        lagrangian = "sum(i in N, q_dot[i]**2/2 - q[i]**2/2)"
        [initial]
        q = [0.5, -0.3]
        q_dot = [0.1, 0.2]
        [method]
        method = "stoermer-verlet"
        [run]
        step = 0.1
        steps = 10
        """
    )
    assert "all measured properties are satisfied" in output_of("verify", path)
    assert json.loads((tmp_path / "oscillators.certificate.json").read_text())["passed"]
    ends = [
        json.loads(output_of("run", path, "--json", *sums))["final"]["q"]["q"] for sums in ((), ("--sums", "plain"))
    ]
    assert np.abs(np.subtract(*ends)).max() < 1e-14


@pytest.mark.parametrize("place", [0, 20, 49])
def test_small_systems_are_cut_out_where_the_motion_is_largest(place: int) -> None:
    """By positions and by momenta, and at both ends of an array."""
    system = either_system(name="ring", **SYSTEMS["ring"][0])
    interface = pipeline.ArraySources(system, sc.as_method("svi:2")).integrator()[1]
    still, moving = np.full(50, 0.1), np.where(np.arange(50) == place, -3.0, 0.1)
    for q, p in ((moving, still), (still, moving)):
        start = WholeStart(
            system=system,
            method=sc.as_method("svi:2"),
            stepper=SimpleNamespace(interface=interface, products=Products(Mock(interface=interface))),
            arrays=read_arrays(interface, {"q": q}, None, None),
            p={"q": p},
            h=0.1,
            t=0.0,
        )
        small = small_start(start)
        assert len(small.p["q"]) < 10
        assert -3.0 in (*small.arrays.state["q"], *small.p["q"])

"""Invalid input of any kind raises the package's own errors.

Each case damages one thing (a file, an argument, a variable of the environment) and may be refused or accepted; an
exception must be a :class:`~scvi_codegen.common.errors.ScviCodegenError`.
"""

import os
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from notation import lagrange
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen.codegen.native import building, compilers
from scvi_codegen.codegen.rendering.source import Source

ODD: list[Any] = [
    None, True, "x", "", b"x", 1j, [], {}, (), [[]], [[1.0]], [None], ["1"], [1.0, [2.0]], float("nan"), float("inf"),
    -1, 0, 10**400, 2**63, 1e300, -1e300, object(), {"q": 1}, {1: 2}, {None: 1.0}, range(3), np.zeros((0, 1)),
    np.array("x"), np.ma.masked, lambda: None, np.datetime64("2020"), type, ...,
]  # fmt: skip
"""Values that are wrong in most places."""


def refused(act: Callable[[], Any]) -> sc.ScviCodegenError | None:
    """The error of the package, if there is one; every other exception is one of the test."""
    with warnings.catch_warnings(action="ignore"):
        try:
            act()
        except sc.ScviCodegenError as error:
            return error
    return None


@cache
def system() -> sc.LagrangianSystem:
    return lagrange("swing", "q", "q_dot**2/2 - w*q**2/2 + u*q", w=1.0, inputs="u")


@cache
def stepper() -> sc.Stepper:
    return sc.compile_stepper(system(), "svi:2", flags=QUICK_FLAGS)


@cache
def arrays() -> sc.Stepper:
    found = sc.LagrangianSystem.from_text(
        name="net",
        coordinates=["q[N]"],
        tables=["bonds[B, 2]"],
        parameters={"k[B]": 1.0, "c": 1.0},
        lagrangian="sum(i in N, q_dot[i]**2/2) - c*sum(b in B, k[b]*(q[bonds[b, 0]] - q[bonds[b, 1]])**2/2)",
    )
    return sc.compile_stepper(found, "svi:2", flags=QUICK_FLAGS)


INPUT = {"u_0": 0.0}
STEP = {"h": 0.1, "steps": 2, "parameters": INPUT}
TABLE = {"h": 0.1, "steps": 2, "tables": {"bonds": [[0, 1]]}}
CALLS: dict[str, Callable[[Any], Any]] = {
    "q": lambda x: stepper().integrate(x, [0.0], **STEP),
    "p": lambda x: stepper().integrate([1.0], x, **STEP),
    "velocity": lambda x: stepper().integrate([1.0], velocity=x, **STEP),
    "h": lambda x: stepper().integrate([1.0], [0.0], h=x, steps=2, parameters=INPUT),
    "steps": lambda x: stepper().integrate([1.0], [0.0], h=0.1, steps=2 if _is_huge(x) else x, parameters=INPUT),
    "save_every": lambda x: stepper().integrate([1.0], [0.0], save_every=x, **STEP),
    "t": lambda x: stepper().integrate([1.0], [0.0], t=x, **STEP),
    "t_end": lambda x: stepper().integrate([1.0], [0.0], t_end=2 if _is_huge(x) else x, parameters=INPUT),
    "t_eval": lambda x: stepper().integrate([1.0], [0.0], t_end=2.0, t_eval=x, parameters=INPUT),
    "tolerance": lambda x: stepper().integrate([1.0], [0.0], t_end=2.0, tolerance=x, parameters=INPUT),
    "parameters": lambda x: stepper().integrate([1.0], [0.0], h=0.1, steps=2, parameters=x),
    "a parameter": lambda x: stepper().integrate([1.0], [0.0], h=0.1, steps=2, parameters={"w": x, **INPUT}),
    "options": lambda x: stepper().integrate([1.0], [0.0], options=x, **STEP),
    "events": lambda x: stepper().integrate([1.0], [0.0], events=x, **STEP),
    "progress": lambda x: stepper().integrate([1.0], [0.0], progress=None if callable(x) else x, **STEP),
    "inputs": lambda x: stepper().integrate([1.0], [0.0], inputs=x, h=0.1, steps=2),
    "an input": lambda x: stepper().integrate([1.0], [0.0], inputs={"u": x}, h=0.1, steps=2),
    "times of an input": lambda x: stepper().integrate([1.0], [0.0], inputs={"u": (x, [0.0, 1.0])}, h=0.1, steps=2),
    "ensemble": lambda x: stepper().integrate_ensemble(x, [[0.0]], **STEP),
    "ensemble parameters": lambda x: stepper().integrate_ensemble([[1.0]], [[0.0]], h=0.1, steps=2, parameters=x),
    "threads": lambda x: stepper().integrate_ensemble([[1.0]], [[0.0]], threads=1 if _is_huge(x) else x, **STEP),
    "restore": lambda x: stepper().from_checkpoint(x),
    "jacobian": lambda x: stepper().jacobian(x, [0.0], 0.1, parameters=INPUT),
    "energy": lambda x: stepper().energy([1.0], x, parameters=INPUT),
    "array q": lambda x: arrays().integrate(x, **TABLE),
    "array p": lambda x: arrays().integrate([1.0, 2.0], x, **TABLE),
    "array h": lambda x: arrays().integrate([1.0, 2.0], **{**TABLE, "h": x}),
    "tables": lambda x: arrays().integrate([1.0, 2.0], **{**TABLE, "tables": x}),
    "a table": lambda x: arrays().integrate([1.0, 2.0], **{**TABLE, "tables": {"bonds": x}}),
    "array parameters": lambda x: arrays().integrate([1.0, 2.0], parameters=x, **TABLE),
    "a field": lambda x: arrays().integrate([1.0, 2.0], parameters={"k": x}, **TABLE),
    "array events": lambda x: arrays().integrate([1.0, 2.0], events=x, **TABLE),
    "array threads": lambda x: arrays().integrate([1.0, 2.0], threads=1 if _is_huge(x) else x, **TABLE),
    "array restore": lambda x: arrays().from_checkpoint(x),
    "coordinates": lambda x: sc.LagrangianSystem.from_text(name="a", coordinates=x, lagrangian="q_dot**2"),
    "lagrangian": lambda x: sc.LagrangianSystem.from_text(name="a", coordinates=["q"], lagrangian=x),
    "defaults": lambda x: lagrange("a", "q", "q_dot**2", parameters=x),
    "forces": lambda x: sc.LagrangianSystem.from_text(name="a", coordinates=["q"], lagrangian="q_dot**2", forces=x),
    "method": lambda x: sc.compile_stepper(system(), x, flags=QUICK_FLAGS),
    "load_run": sc.load_run,
    "load_model": sc.load_model,
}  # fmt: skip


def _is_huge(x: Any) -> bool:
    """Return whether a number is valid but would cause excessive work."""
    return isinstance(x, int | float) and not isinstance(x, bool) and abs(x) > 1e6


@pytest.mark.tiers(3, 18)
@pytest.mark.parametrize("name", CALLS)
def test_special_values_are_rejected_or_handled(name: str, here: Path) -> None:
    failed = []
    for value in ODD:
        try:
            refused(lambda value=value: CALLS[name](value))
        except Exception as error:  # noqa: BLE001  (all of them are shown together)
            failed.append(f"{value!r:.40}: {error!r:.200}")
    assert failed == []


ENVIRONMENT = [
    ("CC", "gcc 'x"), ("CC", "true"), ("CC", "false"), ("CC", "/tmp"), ("CC", "/etc/passwd"), ("CC", "no-such-program"),
    ("CC", "' '"), ("CC", "cc -nonsense"), ("SCVI_CODEGEN_CFLAGS", "-O0 'x"), ("SCVI_CODEGEN_CFLAGS", "-nonsense"),
    ("SCVI_CODEGEN_CACHE", "/proc/none"), ("SCVI_CODEGEN_CACHE", "/dev/null"), ("SCVI_CODEGEN_CACHE", "x" * 5000),
    ("SCVI_CODEGEN_CACHE_SIZE", "huge"), ("SCVI_CODEGEN_CACHE_SIZE", "-1"), ("TMPDIR", "/no/such/folder"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "value"), ENVIRONMENT, ids=lambda text: text[:20])
def test_invalid_environment_variables_are_rejected(
    name: str, value: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = "double answer(void);\n"
    code = '#include "tiny.h"\ndouble answer(void) { return 1.0; }\n'
    tiny = Source(prefix="tiny", header=text, code=code, declarations=text)
    monkeypatch.setenv("SCVI_CODEGEN_CACHE", str(tmp_path))
    monkeypatch.setattr(building, "_loaded", {})
    monkeypatch.setenv(name, value)
    compilers.compiler_version.cache_clear()
    error = refused(lambda: building.load(tiny, flags=("-O0",)))
    assert error is None or isinstance(error, sc.BuildError)
    assert os.environ[name] == value

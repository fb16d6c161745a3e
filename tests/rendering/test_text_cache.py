"""Generated texts are made once, and again whenever anything they depend on is another."""

from __future__ import annotations

import copy
import os
import pickle
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
import sympy

import scvi_codegen as sc
from scvi_codegen import compiler
from scvi_codegen.formulas.subexpressions import key_of
from scvi_codegen.methods import as_method
from scvi_codegen.models.problems import problem
from scvi_codegen.native import building, fingerprint
from scvi_codegen.rendering import source_cache


@pytest.fixture
def made(tmp_path, monkeypatch) -> list[str]:
    """The methods derived from here on, with an empty cache."""
    monkeypatch.setenv(building.CACHE_VARIABLE, str(tmp_path))
    names: list[str] = []
    derive = compiler.program_of

    def counted(system, method, **options):
        names.append(method.name)
        return derive(system, method, **options)

    monkeypatch.setattr(compiler, "program_of", counted)
    return names


def spring(stiffness: float = 1.0) -> sc.LagrangianSystem:
    return sc.LagrangianSystem.from_text(
        name="spring", coordinates=["q"], lagrangian="q_dot**2/2 - k*q**2/2", parameters={"k": stiffness}
    )


def test_cached_derivations_are_not_repeated(made):
    first, second = (sc.compile_stepper(spring(), sc.SVI(2)) for _ in range(2))
    assert len(made) == 1
    assert (first.source, first.interface, first.ensemble) == (second.source, second.interface, second.ensemble)


def test_ensemble_source_is_generated_on_demand_and_cached(made, tmp_path, monkeypatch):
    written: list[str] = []
    render = compiler.render_ensemble
    monkeypatch.setattr(compiler, "render_ensemble", lambda program: written.append(program.prefix) or render(program))
    stepper = sc.compile_stepper(spring(), sc.SVI(2))
    stepper.integrate([1.0], [0.0], h=0.1, steps=3)
    assert (len(written), len(list((tmp_path / "texts").iterdir()))) == (0, 1)
    saved = pickle.loads(pickle.dumps(stepper))  # makes also those of controlled steps, fallback and derivatives
    assert saved.ensemble == stepper.ensemble == sc.compile_stepper(spring(), sc.SVI(2)).ensemble
    assert (len(written), len(list((tmp_path / "texts").iterdir()))) == (1, 5)
    assert len(made) == 2  # with the fallback and without


@pytest.mark.parametrize(
    "other",
    [
        lambda: sc.compile_stepper(spring(2.0), sc.SVI(2)),
        lambda: sc.compile_stepper(spring(), sc.SVI(2, "gauss-legendre:3")),
        lambda: sc.compile_stepper(spring(), sc.SVI(2), solver="newton"),
        lambda: sc.compile_stepper(spring(), sc.SVI(2), prefix="other"),
    ],
    ids=["parameter", "method", "solver", "prefix"],
)
def test_different_arguments_are_derived_again(made, other):
    sc.compile_stepper(spring(), sc.SVI(2))
    other()
    assert len(made) == 2


def keys(change: dict, **options) -> tuple[str, ...]:
    """Return the parts of a cache key."""
    given = {
        "name": "pair",
        "coordinates": ["q", "r"],
        "lagrangian": "q_dot**2/2 + r_dot**2/2 - a*q**2/2 - b*r**2*q",
        "parameters": {"a": 1.0, "b": 2.0},
        "forces": {"q": "-a*q_dot"},
        "inputs": ["u", "w"],
    }
    system = sc.LagrangianSystem.from_text(**{**given, **change})
    found = compiler._Sources(
        system,
        **{
            "method": sc.SVI(2),
            "solver": "auto",
            "prefix": None,
            "symmetries": (),
            "g": None,
            **options,
        },
    )
    return found.key


def test_cache_key_contains_everything_the_source_depends_on():
    changes = [
        {"name": "another"},
        {"coordinates": ["r", "q"]},
        {"lagrangian": "q_dot**2/2 + r_dot**2/2 - a*q**2/2 - b*r**2"},
        {"parameters": {"b": 2.0, "a": 1.0}},
        {"parameters": {"a": 1.0, "b": 2.0 + 2.0**-51}},
        {"parameters": {"a": 1.0, "b": 2.0, "c": 3.0}},
        {"forces": {"r": "-a*q_dot"}},
        {"forces": {"q": "-b*q_dot"}},
        {"forces": {}},
        {"inputs": ["w", "u"]},
        {"inputs": ["u"]},
        {"constraints": ["q - r"]},
        {"constraints": ["q_dot - r"]},
    ]
    turning, *_ = sc.symmetries(problem("kepler").system)
    options = [
        {"method": sc.SVI(3)},
        {"method": sc.SVI(2, "gauss-lobatto:3")},
        {"solver": "newton"},
        {"prefix": "other"},
        {"symmetries": (turning,)},
        {"symmetries": (replace(turning, name="spinning"),)},
        {"symmetries": (replace(turning, gauge=turning.gauge + 1),)},
        {"g": "frequency"},
        {"g": "distance"},
    ]
    found = [keys({}), *map(keys, changes), *(keys({}, **option) for option in options)]
    assert len(set(found)) == len(found)
    assert keys({}) == found[0]


def test_cache_key_contains_every_generator_file(tmp_path, monkeypatch):
    package, templates = tmp_path / "package", tmp_path / "templates"
    files = [
        package / "compiler.py",
        package / "ir/kernel.py",
        templates / "stepper.c.jinja",
        templates / "support/a.h",
    ]
    for path in files:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("one")
    monkeypatch.setattr(source_cache, "PACKAGE", package)
    monkeypatch.setattr(source_cache, "template_folder", lambda: templates)
    found = [source_cache._generator.__wrapped__()]
    for k, path in enumerate(files):
        path.write_text("two")  # as long as before
        os.utime(path, ns=(k, 10**9 + k))
        found.append(source_cache._generator.__wrapped__())
    monkeypatch.setattr(source_cache.sympy, "__version__", "0.0")
    found.append(source_cache._generator.__wrapped__())
    assert len(set(found)) == len(found)


def test_different_generator_regenerates_the_source(made, monkeypatch):
    sc.compile_stepper(spring(), sc.SVI(2))
    monkeypatch.setattr(source_cache, "_generator", lambda: "the next version")
    sc.compile_stepper(spring(), sc.SVI(2))
    assert len(made) == 2


@pytest.mark.parametrize("damage", [b"", b"{", b'{"source": {}}', b"\xff\xfe"])
def test_damaged_entry_is_regenerated(made, tmp_path, damage):
    sc.compile_stepper(spring(), sc.SVI(2))
    (entry,) = (tmp_path / "texts").glob("*.json")
    entry.write_bytes(damage)
    sc.compile_stepper(spring(), sc.SVI(2))
    assert len(made) == 2
    assert len(entry.read_bytes()) > 1000


def test_unwritable_cache_is_not_an_error(made, tmp_path):
    (tmp_path / "texts").write_text("a file where the folder should be")
    sc.compile_stepper(spring(), sc.SVI(2))
    sc.compile_stepper(spring(), sc.SVI(2))
    assert len(made) == 2


def mutations(value):
    """Other values in place of one: of a dataclass, one for each field, however deep."""
    if is_dataclass(value):
        for field in fields(value):
            for other in mutations(getattr(value, field.name)):
                changed = copy.copy(value)
                object.__setattr__(changed, field.name, other)
                yield f"{type(value).__name__}.{field.name}", changed
    elif isinstance(value, tuple):
        yield "shorter", value[:-1]
        yield "longer", (*value, sympy.Integer(7))
        for k, each in enumerate(value):
            for name, other in mutations(each):
                yield name, (*value[:k], other, *value[k + 1 :])
    else:
        yield from others(value)


def others(value):
    """Other values in place of one without parts."""
    if isinstance(value, sympy.Basic):
        yield "expression", value + sympy.Symbol("other", real=True)
        yield "number", sympy.Float(value) if value.is_Integer else sympy.Symbol(str(value))
    elif hasattr(value, "_mpf_"):
        yield "last digit", value * (1 + value.context.mpf(2) ** -190) + value.context.mpf(2) ** -190
    elif isinstance(value, bool) or value is None:
        yield "other", "None" if value is None else not value
    elif isinstance(value, int | float):
        yield "next", value + 1 if isinstance(value, int) else float(np.nextafter(value, np.inf))
    else:
        yield "text", f"{value}2"


def driven() -> sc.LagrangianSystem:
    return sc.LagrangianSystem.from_text(
        name="all",
        coordinates=["x", "y"],
        lagrangian="m*(x_dot**2 + y_dot**2)/2 - x**2*y**2/2",
        parameters={"m": 1.5, "c": 0.25},
        forces={"x": "u"},
        damping="c",
        constraints=["x - 2*y"],
        inputs=["u"],
    )


def described() -> list:
    """One of each kind of what texts are made from, with all fields in use."""
    lattice = sc.LagrangianSystem.from_text(
        name="ring",
        coordinates=["q[N]"],
        lagrangian="sum(a in N, m[a]*q_dot[a]**2/2 - k*q[a]**2/2) - sum(b in B, q[bonds[b, 0]]*q[bonds[b, 1]])",
        parameters={"k": 2.0, "m[N]": 1.5},
        tables=["bonds[B, 2]"],
        forces={"q[a]": "u"},
        inputs=["u"],
    )
    turned = sc.reparametrise(problem("kepler").system, "distance")
    vortices, methods = problem("point-vortices").system, ("svi:2", "scvi:2", "gauss:2", "stoermer-verlet")
    own = [as_method(name, driven()) for name in methods]
    return [driven(), lattice, turned, vortices, sc.symmetries(turned)[0], *own]


@pytest.mark.parametrize("number", range(9))
def test_every_field_of_a_source_description_changes_its_key(number):
    given = described()[number]
    key, found = key_of(given), list(mutations(given))
    assert key == key_of(described()[number])
    assert len(found) >= len(fields(given))
    unseen = [name for name, other in found if key_of(other) == key]
    assert unseen == []
    keys = {key_of(other) for _, other in found}
    assert len(keys) > 0.9 * len(found)
    if hasattr(given, "key"):
        assert given.key() == (key,)


def test_keys_distinguish_values_that_are_equal_or_print_equally():
    a, b = sympy.symbols("x x", real=True), sympy.Symbol("x")
    same = [(1, 2), ("1, 2",), (1, (2,)), (1.0, 2), (True, 2), ("None",), (None,), (sympy.Integer(1), 2), (a[0],), (b,)]
    assert len({key_of(each) for each in same}) == len(same)
    with pytest.raises(TypeError, match="cannot be made from a object"):
        key_of(object())
    assert keys({}, prefix="None") != keys({})
    assert keys({}, g="None") != keys({})


def test_library_name_depends_on_compiler_flags_and_commands(monkeypatch):
    source = sc.compile_stepper(spring(), sc.SVI(1)).source
    found = [building.fingerprint(source, flags=flags) for flags in (("-O1", "-g"), ("-O1 -g",), ("-g", "-O1"))]
    for field in fields(source):
        other = copy.copy(source)
        value = getattr(source, field.name)
        changed = source if value is None else f"{value}2" if isinstance(value, str) else (*value, ("support/a.h", ""))
        object.__setattr__(other, field.name, changed)
        found.append(building.fingerprint(other, flags=("-O1", "-g")))
    monkeypatch.setattr(fingerprint, "compiler_version", lambda command: "another")
    found.append(building.fingerprint(source, flags=("-O1", "-g")))
    monkeypatch.setattr(fingerprint, "_commands", lambda: "another")
    found.append(building.fingerprint(source, flags=("-O1", "-g")))
    assert len(set(found)) == len(found) == 11

"""Generated texts are made once, and again whenever anything they depend on is another."""

import copy
import inspect
import os
import pickle
import subprocess
import sys
from dataclasses import fields, is_dataclass, replace
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest
import sympy
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen import as_method, problem
from scvi_codegen.codegen import pipeline
from scvi_codegen.codegen.native import building
from scvi_codegen.common import cache
from scvi_codegen.common.cache import key_of
from scvi_codegen.runs import compiler
from scvi_codegen.systems.system import _text_of


@pytest.fixture
def made(tmp_path, monkeypatch) -> list[str]:
    """The methods derived from here on, with an empty cache."""
    monkeypatch.setenv(building.CACHE_VARIABLE, str(tmp_path))
    names: list[str] = []
    derive = pipeline.program_of

    def counted(system, method, **options):
        names.append(method.name)
        return derive(system, method, **options)

    monkeypatch.setattr(pipeline, "program_of", counted)
    return names


def spring(stiffness: float = 1.0) -> sc.LagrangianSystem:
    return lagrange("spring", "q", "q_dot**2/2 - k*q**2/2", k=stiffness)


@pytest.mark.second
def test_cached_derivations_are_not_repeated(made):
    first, second = (sc.compile_stepper(spring(), sc.SVI(2)) for _ in range(2))
    assert len(made) == 1
    assert (first.source, first.interface, first.ensemble) == (second.source, second.interface, second.ensemble)


def test_ensemble_source_is_generated_on_demand_and_cached(made, tmp_path, monkeypatch):
    written: list[str] = []
    render = pipeline.render_ensemble
    monkeypatch.setattr(
        pipeline,
        "render_ensemble",
        lambda program, **options: written.append(program.prefix) or render(program, **options),
    )
    stepper = sc.compile_stepper(spring(), sc.SVI(2))
    stepper.integrate([1.0], [0.0], h=0.1, steps=3)
    assert (len(written), len(list((tmp_path / "texts").iterdir()))) == (0, 2)
    saved = pickle.loads(pickle.dumps(stepper))  # makes also those of fallback and derivatives
    assert saved.ensemble == stepper.ensemble == sc.compile_stepper(spring(), sc.SVI(2)).ensemble
    assert (len(written), len(list((tmp_path / "texts").iterdir()))) == (1, 5)
    assert len(made) == 2  # with the fallback and without


def keys(**options) -> tuple[str, ...]:
    """Return the parts of a cache key."""
    system = sc.LagrangianSystem.from_text(**TEXT)
    choices = {"solver": "auto", "prefix": None, "symmetries": (), "g": None, "controller": None, "precision": "double"}
    method, *others = ({"method": sc.SVI(2)} | choices | options).values()
    return compiler.CachedSources(system, method, *others).key


ARGUMENTS = {
    "name": ["another", "pair "],
    "coordinates": [["r", "q"], ["q", "r", "s"]],
    "lagrangian": ["q_dot**2/2 + r_dot**2/2 - a*q**2/2 - b*r**2"],
    "parameters": [
        {"b": 2.0, "a": 1.0},
        {"a": 1.0, "b": 2.0 + 2.0**-51},
        {"a": -0.0, "b": 2.0},
        {"a": 0.0, "b": 2.0},
        {"a": 1.0, "b": 2.0, "c": 3.0},
    ],
    "rotations": [{"R": "omega"}],
    "directions": [["n"]],
    "forces": [{"r": "-a*q_dot"}, {"q": "-b*q_dot"}, {}],
    "torques": [{"R": ["0", "0", "1"]}],
    "torques_space": [{"R": ["0", "0", "1"]}],
    "point_forces": [[{"body": "R", "point": ["1", "0", "0"], "force": ["0", "0", "1"]}]],
    "dissipation": ["q_dot**2", "r_dot**2"],
    "damping": ["a", "1", 1.5],
    "constraints": [["q - r"], ["q_dot - r"], ["q", "r"]],
    "inputs": [["w", "u"], ["u"]],
    "tables": [["bonds[B, 2]"], ["bonds[B, 3]"]],
    "neighbours": [{"near": {"of": "q", "cutoff": 1.0}}],
    "contacts": [[{"gap": "q"}]],
    "functions": [{"F": sc.Table([0, 1], [0, 1])}],
    "temperature": ["a", "b"],
    "noise": [{"q": "a"}, {"r": "a"}],
}
TEXT = {
    "name": "pair",
    "coordinates": ["q", "r"],
    "lagrangian": "q_dot**2/2 + r_dot**2/2 - a*q**2/2 - b*r**2*q",
    "parameters": {"a": 1.0, "b": 2.0},
    "rotations": None,
    "directions": [],
    "forces": {"q": "-a*q_dot"},
    "torques": None,
    "torques_space": None,
    "point_forces": [],
    "dissipation": None,
    "damping": None,
    "constraints": [],
    "inputs": ["u", "w"],
    "tables": [],
    "neighbours": None,
    "contacts": (),
    "functions": None,
    "temperature": None,
    "noise": None,
}


def test_every_argument_of_from_text_changes_the_key_of_the_text():
    assert ARGUMENTS.keys() == TEXT.keys() == inspect.signature(sc.LagrangianSystem.from_text).parameters.keys()
    changed = [TEXT | {name: value} for name, values in ARGUMENTS.items() for value in values]
    texts = [
        _text_of(sc.LagrangianSystem, each) for each in (TEXT, *changed) if not (each["tables"] or each["functions"])
    ]
    assert None not in texts
    assert len(set(texts)) == len(texts)
    assert _text_of(sc.HamiltonianSystem, TEXT) not in texts
    assert _text_of(type("Own", (sc.LagrangianSystem,), {"__module__": "own"}), TEXT) is None
    assert _text_of(sc.LagrangianSystem, TEXT | {"coordinates": ["q[3]"]}) is None
    assert _text_of(sc.LagrangianSystem, TEXT | {"parameters": {"a": Fraction(1, 3), "b": 2.0}}) is None


def test_unread_system_equals_one_that_is_read(made):
    first = spring()
    sc.compile_stepper(first, sc.SVI(2))
    unread, other = spring(), spring(2.0)
    assert unread.key() == first.key() == (key_of(first),) != other.key()
    assert unread._key is not None
    assert other._key is None
    for name in ("coordinates", "lagrangian", "defaults"):  # slots without a value
        with pytest.raises(AttributeError):
            object.__getattribute__(unread, name)
    assert not unread.constrained_at_nodes
    again = pickle.loads(pickle.dumps(unread))
    assert unread == first == again == copy.copy(unread) == replace(unread)
    assert hash(unread) == hash(first)
    assert (key_of(unread), repr(unread), unread.to_text()) == (key_of(first), repr(first), first.to_text())
    assert replace(unread, name="other").key() != first.key()
    with pytest.raises(AttributeError, match="no attribute 'momenta'"):
        _ = unread.momenta


def test_source_is_derived_again_if_only_the_key_of_the_system_is_left(made, tmp_path):
    first = sc.compile_stepper(spring(), sc.SVI(2))
    source = max((tmp_path / "texts").iterdir(), key=lambda each: each.stat().st_size)
    source.unlink()
    unread = spring()
    assert unread._key is not None
    assert sc.compile_stepper(unread, sc.SVI(2)).source == first.source
    assert len(made) == 2
    assert source.exists()


@pytest.mark.second
def test_text_with_warnings_is_always_read(made):
    for _ in range(2):
        with pytest.warns(sc.SystemDefinitionWarning, match="parameter 'c' does not occur"):
            system = sc.LagrangianSystem.from_text("spring", ["q"], "q_dot**2/2 - q**2/2", parameters={"c": 1.0})
        sc.compile_stepper(system, "svi:2")


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(
    "make",
    [
        "sc.LagrangianSystem.from_text('spring', ['q'], 'q_dot**2/2 - k*q**2/2', parameters={'k': 1.0})",
        "sc.HamiltonianSystem.from_text('spring', ['q'], 'p_q**2/2 + k*q**2/2', parameters={'k': 1.0})",
        "sc.LagrangianSystem.from_text('rod', ['x', 'y'], '(x_dot**2 + y_dot**2)/2', constraints=['x**2 + y**2 = 1'])",
    ],
    ids=["Lagrangian", "Hamiltonian", "constraints"],
)
def test_warm_start_imports_no_symbolic_library(make, tmp_path):
    script = f"""
import sys
import scvi_codegen as sc
system = {make}
n = 2 if "rod" in {make!r} else 1
run = sc.compile_stepper(system, "svi:4").integrate([1.0, 0.0][:n], [0.0, 0.1][:n], h=0.1, steps=10)
print(run.q[-1].tobytes().hex(), *sorted({{"sympy", "scipy", "jinja2", "pycparser"}} & sys.modules.keys()))
"""
    environment = os.environ | {building.CACHE_VARIABLE: str(tmp_path)}
    command = [sys.executable, "-c", script]
    lines = [subprocess.run(command, env=environment, capture_output=True, check=True).stdout.split() for _ in range(2)]
    assert b"sympy" in lines[0]
    assert lines[1] == lines[0][:1]


def test_cache_key_contains_every_generator_file(tmp_path, monkeypatch):
    package, templates = tmp_path / "package", tmp_path / "templates"
    files = [
        package / "compiler.py",
        package / "codegen/ir/kernel.py",
        templates / "stepper.c.jinja",
        templates / "support/a.h",
    ]
    for path in files:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("one")
    monkeypatch.setattr(cache, "PACKAGE", package)
    monkeypatch.setattr(cache, "template_folder", lambda: templates)
    found = [cache._generator.__wrapped__()]
    for k, path in enumerate(files):
        path.write_text("two")  # as long as before
        os.utime(path, ns=(k, 10**9 + k))
        found.append(cache._generator.__wrapped__())
    release = tmp_path / "sympy" / "release.py"
    release.parent.mkdir()
    release.write_text('__version__ = "0.0"')
    monkeypatch.setattr(cache, "find_spec", lambda name: SimpleNamespace(origin=str(release)))
    found.append(cache._generator.__wrapped__())
    assert len(set(found)) == len(found)


def test_different_generator_regenerates_the_source(made, monkeypatch):
    sc.compile_stepper(spring(), sc.SVI(2))
    monkeypatch.setattr(cache, "_generator", lambda: "the next version")
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
    text = "m*(x_dot**2 + y_dot**2)/2 - x**2*y**2/2"
    return lagrange(
        "all", "x y", text, forces={"x": "u"}, damping="c", constraints=["x - 2*y"], inputs="u", m=1.5, c=0.25
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


@pytest.mark.tiers(1, 1)
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
    assert keys(prefix="None") != keys()
    assert keys(g="None") != keys()

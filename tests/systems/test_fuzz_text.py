"""Hostile text: formulas, model files, names. Each is read or refused with a message, quickly; no code runs.

The default tier tries a few thousand inputs, the full one a million. A failing input is found again by its number.
"""

import importlib
import re
import warnings
from contextlib import suppress
from dataclasses import replace
from random import Random
from typing import Any

import pytest
from fuzzing import FUNCTIONS, NAMES, NUMBERS, POISON, formula, guarded, mutated, quietly, seeds
from hypothesis import given, settings
from hypothesis import strategies as st
from sympy import Symbol

import scvi_codegen as sc
from scvi_codegen.interfaces.models.model_files.ensemble_file import load_ensemble
from scvi_codegen.interfaces.models.model_files.model_file import dump_model, parse_model
from scvi_codegen.methods import ARGUMENTS, METHODS, SCVI, SVI, Gauss, method_from_specification
from scvi_codegen.methods.tables.nodes import nodes_by_name
from scvi_codegen.methods.tables.quadrature import quadrature_by_name
from scvi_codegen.methods.tables.spaces import space_by_name
from scvi_codegen.methods.tables.tableau import tableau_by_name
from scvi_codegen.systems.formulas.grammar import parse_expression
from scvi_codegen.systems.formulas.symbols import IDENTIFIER
from scvi_codegen.systems.formulas.translation import format_expression

SYMBOLS = {name: Symbol(name, real=True) for name in ("x", "y", "z", "t", "q", "q_dot", "p", "m")}


@pytest.fixture(scope="module", autouse=True)
def warmed() -> None:
    """Import what is loaded lazily, so that it is not attributed to an input."""
    importlib.import_module("scipy.sparse.csgraph")  # of singular kinetic energies, which no seed has
    for text in seeds("models"):
        try:
            parse_model(text)
        except sc.ModelFileError:
            continue
    for text in seeds("formulas.txt"):
        try:
            parse_expression(text, SYMBOLS)
        except sc.ExpressionError:
            continue


# Formulas.


def try_formula(number: int) -> bool:
    """Return whether a text is a formula; check its round trip."""
    random = Random(number)
    known = seeds("formulas.txt")
    text = formula(random) if number % 2 else mutated(random, random.choice(known), known)
    found = quietly(parse_expression, text, SYMBOLS, expected=sc.ExpressionError)
    if found is None:
        return False
    with guarded():
        assert parse_expression(format_expression(found), SYMBOLS) == found, text
    return True


@pytest.mark.rotated
def test_formulas_are_read_or_rejected():
    assert sum(map(try_formula, range(1000))) > 100


@pytest.mark.full
def test_seven_hundred_thousand_random_formulas():
    assert sum(map(try_formula, range(10_000, 710_000))) > 70_000


@pytest.mark.rotated
@given(
    st.one_of(st.text(max_size=200), st.lists(st.sampled_from([*NAMES, *FUNCTIONS, *NUMBERS, *POISON])).map("".join))
)
@settings(max_examples=150, deadline=None)
def test_any_text_is_a_formula_or_an_error(text):
    with guarded(), suppress(sc.ExpressionError):
        parse_expression(text, SYMBOLS)


# Systems.


def try_system(number: int) -> bool:
    """Return whether a random formula gives a system that is lowered to C."""
    random = Random(number)
    text = formula(random)
    common: dict[str, Any] = {"name": "s", "coordinates": ["q", "x"], "parameters": {"y": 1.0, "z": -2.0, "m": 0.5}}
    if number % 2:
        kinetic, common["parameters"]["p"] = "q_dot**2/2 + x_dot**2/2", 1.0
        common["lagrangian"] = f"{kinetic} + {text}" if number % 3 else text
        build = sc.LagrangianSystem.from_text
    else:
        common |= {"momenta": ["p", "px"], "hamiltonian": f"p**2/2 + px**2/2 + {text}" if number % 3 else text}
        build = sc.HamiltonianSystem.from_text

    def compiled() -> None:
        method = random.choice((SVI(2), SCVI(2), Gauss(2), SVI(3, "gauss-lobatto:4")))
        source, _ = sc.generate_source(build(**common), method)
        assert not re.search(
            r"[^\w](?:nan|inf|zoo|oo|I)[^\w(]", re.sub(r"/\*.*?\*/", "", source.amalgamated().code, flags=re.DOTALL)
        )

    try:
        with guarded(may_compile=True), warnings.catch_warnings(action="ignore"):
            compiled()
    except sc.ScviCodegenError:
        return False
    return True


@pytest.mark.full
def test_ten_thousand_systems_compile_or_are_rejected():
    assert sum(map(try_system, range(10_000))) > 1_000


# Model files.

VALUES = [
    *('""', '" "', "[]", "{}", "[[[1]]]", "-1", "true", "inf", "nan", "1e400", "[0.1,0.1]", '["q","q"]', "{q=1}"),
    *('"../../etc/x"', "[" + "1," * 200 + "]", "99999999", "9" * 5000, "0x" + "f" * 5000, "[" * 3000, '"\\u0000"'),
    *("1979-05-27", "07:32:00"),
]


def with_a_value_changed(random: Random, text: str) -> str:
    """The text with something else behind one of its equal signs."""
    lines = text.split("\n")
    place = random.randrange(len(lines))
    new = formula(random)
    written = (new, f'"{new}"', f'"""{new}"""', random.choice(NUMBERS), f'"{random.choice(seeds("names.txt"))}"')
    lines[place] = f"{lines[place].partition('=')[0]} = {random.choice((*written, *random.choices(VALUES, k=5)))}"
    return "\n".join(lines)


def try_model(number: int) -> bool:
    """Return whether a text is a model; check its round trip or the named error."""
    random = Random(number)
    known = seeds("models")
    text = random.choice(known)
    text = with_a_value_changed(random, text) if number % 2 else mutated(random, text, known)
    with warnings.catch_warnings(action="ignore"):
        model = quietly(parse_model, text, expected=sc.ModelFileError)
        if model is None:
            return False
        written = quietly(dump_model, model, expected=sc.ModelFileError)
        assert written is None or parse_model(written) == model
    return True


@pytest.mark.rotated
def test_model_files_are_read_or_rejected():
    assert sum(map(try_model, range(1000))) > 20


@pytest.mark.full
def test_two_hundred_thousand_random_model_files():
    assert sum(map(try_model, range(10_000, 210_000))) > 5_000


@pytest.mark.second
def test_grids_are_read_or_rejected(tmp_path):
    model, random = sc.Model.from_problem(sc.problem("kepler")), Random(1)
    grid = next(text for text in seeds("models") if "[grid]" in text)
    path = tmp_path / "grid.toml"
    for _ in range(300):
        text = with_a_value_changed(random, grid) if random.random() < 0.5 else mutated(random, grid, seeds("models"))
        path.write_bytes(text.encode("utf-8", "replace") + random.choice((b"", b"\xff")))
        quietly(load_ensemble, path, model, expected=sc.ModelFileError)


@pytest.mark.tiers(8)
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a = " + "[" * 100_000, "too deeply"),
        ("a = " + "{b=" * 100_000, "too deeply"),
        ("a = " + "9" * 5_000, "too long"),
        ("a = 0x" + "f" * 5_000, "20000 bits"),
        (".".join(["a"] * 100_000) + " = 1", "between dots"),
        (".".join(['"a b"'] * 100_000) + " = 1", "between dots"),
        ("[" + " . ".join(["a"] * 100_000) + "]", "between dots"),
        ("a = 1\n" * 500_000, "limit"),
        ("\n".join(f"[a{k}]" for k in range(50_000)), "unknown section"),
        ("'" * 200_000, "not TOML"),
        ('"a' * 200_000, "not TOML"),
        ("a" * 900_000, "not TOML"),
    ],
    ids=range(12),
)
def test_files_that_attack_the_parser_are_rejected_fast(text, message):
    with guarded(), pytest.raises(sc.ModelFileError, match=message):
        parse_model(text)


# Names of methods, quadratures, nodes and spaces.

COUNTS = (-1, 0, 1, 2, 3, 4, 5, 8, 33, 64, 65, 128, 129, 1000, 10**5, 10**9, 10**30)
OTHERS = (True, False, 0.5, "3", None, float("nan"), [1], "inf", {}, b"1")
ABSCISSAE = (
    [0.1, 0.5],
    [0, 1],
    [0.5, 0.1],
    [k / 1000 for k in range(1000)],
    [1e300],
    [],
    ["x"],
    [float("nan")],
    "gauss",
    3,
)


def try_name(number: int) -> bool:
    """Return whether a name denotes a rule, space, nodes or tableau, or plain data a method."""
    random = Random(number)
    known = seeds("names.txt")
    name = mutated(random, random.choice(known), known) if number % 4 else random.choice(known)
    with warnings.catch_warnings(action="ignore"):
        if number % 2:
            read = random.choice((quadrature_by_name, space_by_name, tableau_by_name))
            found = quietly(read, name, expected=sc.MethodError)
            if found is not None and read is not tableau_by_name:
                assert read(found.name) == found
            return found is not None
        return quietly(method_from_specification, specification(random, name), expected=sc.MethodError) is not None


def specification(random: Random, name: str) -> dict[str, Any]:
    """Plain data of a method, or nearly."""
    method = random.choice(list(METHODS))
    choices = {
        "form": lambda: random.choice(("position", "phase-space", "x", None, 1)),
        "variational": lambda: random.choice((True, False, 1, None)),
        "abscissae": lambda: random.choice((*ABSCISSAE, name)),
        **dict.fromkeys(("degree", "stages", "order"), lambda: random.choice(COUNTS[:8] * 4 + COUNTS + OTHERS)),
    }
    given = {key: choices.get(key, lambda: name)() for key in ARGUMENTS[method] if random.random() < 0.6}
    return {"method": random.choice((method, method, method, method, name)), **given}


def test_names_are_read_or_rejected():
    assert sum(map(try_name, range(600, 720))) > 5


@pytest.mark.full
def test_ninety_thousand_random_names():
    assert sum(map(try_name, range(10_000, 100_000))) > 5_000


@pytest.mark.parametrize("count", [10**5, 10**9, 10**30, int("9" * 4000)])
def test_absurd_counts_are_rejected_immediately(count):
    for family in ("gauss-legendre", "gauss-lobatto", "gauss-radau-left", "clenshaw-curtis", "fejer", "hermite-3"):
        with guarded(1000), pytest.raises(sc.MethodError):
            quadrature_by_name(f"{family}:{count}")
    for nodes in ("chebyshev-lobatto", "legendre-lobatto", "equispaced"):
        with guarded(1000), pytest.raises(sc.MethodError):
            nodes_by_name(nodes, count)
    for data in (
        *({"method": name, "degree": count} for name in ("svi", "scvi", "sc")),
        *(
            {"method": name, "stages": count}
            for name in ("gauss", "radau-ia", "radau-iia", "lobatto-iiia", "chebyshev-gauss")
        ),
        {"method": "svi", "degree": 4, "space": f"splines:{count}"},
        {"method": "svi", "degree": 4, "space": f"trigonometric:0.5:{count}"},
        {"method": "svi", "degree": 4, "space": "trigonometric:1e300"},
    ):
        with guarded(1000), pytest.raises(sc.MethodError):
            method_from_specification(data)


@pytest.mark.rotated
def test_splines_of_too_many_velocities_are_rejected():
    with guarded(3_000_000), pytest.raises(sc.MethodError):
        method_from_specification({"method": "svi", "degree": 64, "space": "splines:64"})


# Names of systems, coordinates, folders: what of them reaches C, Makefiles, Python and paths.

TITLES = [
    *("*/ #error x /*", "x\n#error x", "../../up", "/etc/passwd", "$(touch x)", "`touch x`", "%s%n", "{{ 7*7 }}"),
    *("{% raw %}", "\\", "\\\n", '"); system("x"); //', "'''\nimport os\n'''", "\x00", "\x1b[2J", "\u202e", "??/"),
    *("$prefix", "a" * 5000, "\ud800"),
]
PLAIN = ("Makefile", "__init__.py", "main.c")


def hostile_model(title: str) -> sc.Model:
    model = sc.Model.from_problem(sc.problem("planar-pendulum"))
    return replace(model, method=SVI(1), system=replace(model.system, name=title))


def code_of(text: str) -> str:
    """C text without its comments."""
    return re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("title", TITLES, ids=lambda title: repr(title)[:20])
def test_system_name_occurs_only_in_comments_and_prose(title, tmp_path):
    plain = sc.generate_package(hostile_model("plain"), tmp_path / "a" / "pendulum")
    try:
        folder = sc.generate_package(hostile_model(title), tmp_path / "b" / "pendulum")
    except sc.ScviCodegenError:
        assert not (tmp_path / "b").exists() or not list((tmp_path / "b").iterdir())
        return
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b"]
    assert sorted(path.name for path in folder.parent.iterdir()) == ["pendulum"]
    names = sorted(path.name for path in folder.iterdir())
    assert set(names) - {"model.toml"} == {path.name for path in plain.iterdir()} - {"model.toml"}
    for name in PLAIN:
        assert (folder / name).read_bytes() == (plain / name).read_bytes()
    for name in ("pendulum.c", "pendulum.h"):
        assert code_of((folder / name).read_text()) == code_of((plain / name).read_text())


@pytest.mark.tiers(21)
@pytest.mark.parametrize(
    "name", [*TITLES, "", ".", "..", "-rf", "a b", "A", "a.b", "main", "os", "int", "é", "a/..", "~"]
)
def test_folder_names_are_valid_or_rejected(name, tmp_path):
    model = hostile_model("plain")
    inside = tmp_path / "inside"
    inside.mkdir()
    try:
        folder = sc.generate_package(model, f"{inside}/{name}")
    except sc.PackageError:
        return
    assert IDENTIFIER.fullmatch(folder.resolve().name)


def try_identifier(random: Random) -> None:
    """A name of a coordinate, momentum or parameter is an identifier, or refused."""
    known = ("q", "theta_1", "q_dot", "int", "sin", "t", "pi", *TITLES, *NAMES)
    name = mutated(random, random.choice(known), known) if random.random() < 0.7 else random.choice(known)
    role = random.choice(("coordinates", "momenta", "parameters"))
    data: dict[str, Any] = {"coordinates": ["x"], "momenta": ["y"], "parameters": {}, "name": "s"}
    data[role] = {name: 1.0} if role == "parameters" else [name]
    system = quietly(lambda: sc.HamiltonianSystem.from_text(hamiltonian="1", **data), expected=sc.SystemDefinitionError)
    if system is not None:
        names = (*system.coordinates, *system.momenta, *system.parameters)
        assert all(IDENTIFIER.fullmatch(symbol.name) for symbol in names)
        code = code_of(sc.generate_source(system, SVI(1, "gauss-legendre:1"), solver="newton")[0].amalgamated().code)
        assert name not in re.findall(r"\w+", code) or len(name) < 9


@pytest.mark.rotated
def test_names_of_variables_are_identifiers():
    random = Random(1)
    for _ in range(150):
        try_identifier(random)

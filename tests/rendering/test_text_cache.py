"""Generated texts are made once, and again whenever anything they depend on is another."""

from __future__ import annotations

import pickle

import pytest

import scvi_codegen as sc
from scvi_codegen import compiler
from scvi_codegen.native import building
from scvi_codegen.rendering import text_cache


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


def test_what_was_derived_is_not_derived_again(made):
    first, second = (sc.compile_stepper(spring(), sc.SVI(2)) for _ in range(2))
    assert len(made) == 1
    assert (first.source, first.interface, first.ensemble) == (second.source, second.interface, second.ensemble)


def test_the_text_of_an_ensemble_is_made_when_it_is_asked_for_and_then_kept(made, tmp_path, monkeypatch):
    written: list[str] = []
    render = compiler.render_ensemble
    monkeypatch.setattr(compiler, "render_ensemble", lambda program: written.append(program.prefix) or render(program))
    stepper = sc.compile_stepper(spring(), sc.SVI(2))
    stepper.integrate([1.0], [0.0], h=0.1, steps=3)
    assert (len(written), len(list((tmp_path / "texts").iterdir()))) == (0, 1)
    kept = pickle.loads(pickle.dumps(stepper))  # makes also those of controlled steps, fallback and derivatives
    assert kept.ensemble == stepper.ensemble == sc.compile_stepper(spring(), sc.SVI(2)).ensemble
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
def test_anything_else_is(made, other):
    sc.compile_stepper(spring(), sc.SVI(2))
    other()
    assert len(made) == 2


def test_another_generator_makes_it_anew(made, monkeypatch):
    sc.compile_stepper(spring(), sc.SVI(2))
    monkeypatch.setattr(text_cache, "_generator", lambda: "the next version")
    sc.compile_stepper(spring(), sc.SVI(2))
    assert len(made) == 2


@pytest.mark.parametrize("damage", [b"", b"{", b'{"source": {}}', b"\xff\xfe"])
def test_a_damaged_entry_is_made_anew(made, tmp_path, damage):
    sc.compile_stepper(spring(), sc.SVI(2))
    (entry,) = (tmp_path / "texts").glob("*.json")
    entry.write_bytes(damage)
    sc.compile_stepper(spring(), sc.SVI(2))
    assert len(made) == 2
    assert len(entry.read_bytes()) > 1000


def test_a_cache_that_cannot_be_written_is_no_error(made, tmp_path):
    (tmp_path / "texts").write_text("a file where the folder should be")
    sc.compile_stepper(spring(), sc.SVI(2))
    sc.compile_stepper(spring(), sc.SVI(2))
    assert len(made) == 2

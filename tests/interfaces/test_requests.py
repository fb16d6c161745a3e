"""The table of ``docs/command_line.md``, which command serves which kind of model: each cell is tried."""

import re
from pathlib import Path

import pytest
from click.testing import Result
from commands import invoke
from pages import ROOT

from scvi_codegen.codegen.native import building
from scvi_codegen.common.errors import BuildError
from scvi_codegen.extras.pages import webassembly

START = "[initial]\nq = [1.0]\nq_dot = [0.0]\n"
SWING = '[system]\nname = "swing"\ncoordinates = ["q"]\nlagrangian = "q_dot**2/2 + cos(q)"\n'
MODELS = {
    "Lagrangian": SWING + START,
    "Hamiltonian": '[system]\nname = "swing"\ncoordinates = ["q"]\nmomenta = ["p"]\nhamiltonian = "p**2/2 - cos(q)"\n'
    "[initial]\nq = [1.0]\np = [0.0]\n",
    "forces, damping": SWING + '[forces]\nq = "-q_dot/10"\n' + START,
    "constraints": '[system]\nname = "rod"\ncoordinates = ["q", "y"]\nlagrangian = "(q_dot**2 + y_dot**2)/2 - y"\n'
    'constraints = ["q**2 + y**2 - 1"]\n[initial]\nq = [0.6, -0.8]\nq_dot = [0.0, 0.0]\n',
    "inputs": SWING
    + 'inputs = ["u"]\n[forces]\nq = "u"\n[inputs]\nu = { t = [0.0, 0.5, 1.0], values = [0.0, 1.0, 0.0] }\n'
    + START,
    "array systems": '[system]\nname = "ring"\ncoordinates = ["q[N]"]\n'
    'lagrangian = "sum(i in N, q_dot[i]**2/2) - sum(i in N periodic, (q[i+1] - q[i])**2/2)"\n'
    '[sizes]\nN = 8\n[initial]\nq = "sin(i)"\nq_dot = "0"\n',
}
REST = '[method]\nmethod = "svi"\ndegree = 4\n[run]\nspan = 1.0\n'
WORDS = {"H": "0.1", "X": "1e-2", "G": "2+cos(q)", "FILE": "many.csv", "NAME": "made", "FOLDER": "made"}
"""Values of the placeholders in capitals of the table."""
BUILT = "here the compiler would be called"
NO_COMPILER = "a page requires a compiler to WebAssembly: pip install 'scvi-codegen[compiler]'"
"""Message of a page that was accepted where the extra is not installed."""


def cells() -> list[tuple[str, str, bool]]:
    """Command, kind of model, and whether it is served."""
    page = (ROOT / "docs" / "command_line.md").read_text(encoding="utf-8")
    lines = page.partition("## Which command serves which model")[2].strip().split("\n\n")[0].splitlines()
    head, _, *rows = ([cell.strip() for cell in line.strip("|").split("|")] for line in lines)
    assert set(head[1:]) == MODELS.keys()
    found = [(row[0].strip("`"), kind, cell) for row in rows for kind, cell in zip(head[1:], row[1:], strict=True)]
    assert {cell for *_, cell in found} == {"yes", "no"}
    return [(command, kind, cell == "yes") for command, kind, cell in found]


CELLS = cells()
each_cell = pytest.mark.parametrize(("command", "kind", "served"), CELLS, ids=lambda part: str(part))


def tried(command: str, kind: str, status: int | None = None) -> Result:
    """The command on a model of that kind, in the present folder."""
    Path("model.toml").write_text(MODELS[kind] + REST)
    q = "q_0" if kind == "array systems" else "q"
    Path("many.csv").write_text("q,y\n0.6,-0.8\n0.8,-0.6\n" if kind == "constraints" else f"{q}\n0.1\n0.2\n")
    name, *options = [re.sub(r"^[A-Z]+", lambda found: WORDS[found[0]], word) for word in command.split()]
    options = [option.replace("(q)", f"({q})") for option in options]
    lengths = [] if {"--step", "--tolerance", "--advise"} & {*options} or name == "derive" else ["--step", "0.1"]
    return invoke(name, "model.toml", *options, *lengths, status=status)


@pytest.mark.tiers(6, 10)
@each_cell
def test_allowed_requests_are_compiled_and_others_rejected(command, kind, served, here, monkeypatch):
    def unbuilt(*_, **__):
        raise BuildError(BUILT)

    monkeypatch.setattr(building, "_load_or_build", unbuilt)
    for module in (webassembly, building):  # the first is imported above, or it would keep the replacement
        monkeypatch.setattr(module, "run_compiler", unbuilt)
    result = tried(command, kind)
    if served:
        reached = BUILT in result.stderr or (command.startswith("page ") and NO_COMPILER in result.stderr)
        assert result.exit_code == 0 or (result.exit_code == 1 and reached), result.output
    else:
        assert result.exit_code == 2, result.output
        assert not [path for path in here.iterdir() if path.name.startswith("made")]


@pytest.mark.full
@each_cell
def test_allowed_requests_are_executed(command, kind, served, here):
    tried(command, kind, 0 if served else 2)

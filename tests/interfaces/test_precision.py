"""Option --precision of ``run`` and key of model files: digits of the final state, both words, refusals."""

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from commands import error_of, invoke, json_of, output_of
from mpmath import mp

import scvi_codegen as sc

TEXT = """
[system]
name = "spring"
coordinates = ["q"]
lagrangian = "q_dot**2/2 - q**2/2"
[initial]
q = [0.5]
q_dot = [0.25]
[method]
method = "svi:10"
[run]
step = 0.125
steps = 16
precision = "double-double"
"""


@pytest.fixture
def spring(here: Path) -> Path:
    """Return a model file in the working folder."""
    path = here / "spring.toml"
    path.write_text(TEXT)
    return path


@pytest.mark.rotated
def test_final_state_is_exact_to_thirty_digits(spring: Path) -> None:
    """The text, the document and the file agree with the solution q = cos(t)/2 + sin(t)/4."""
    shown = output_of("run", spring, "-o", "states.npz")
    document = json_of("run", spring)
    spring.write_text(TEXT.replace("steps = 16\n", "span = 1.3\n"))
    shorter = json_of("run", spring)["final"]
    spring.write_text(TEXT)
    with mp.workdps(40), np.load("states.npz") as saved:
        exact = mp.cos(2) / 2 + mp.sin(2) / 4
        last = next(line for line in shown.splitlines() if line.startswith("  q = "))
        words = [document["final"][name]["q"] for name in ("q", "q_low")]
        numbers = mp.mpf(last.split()[2]), sum(map(mp.mpf, words)), mp.mpf(saved["q"][-1, 0]) + saved["q_low"][-1, 0]
        assert max(abs(number - exact) for number in numbers) < 1e-30
        end = mp.mpf(shorter["q"]["q"]) + shorter["q_low"]["q"]
        assert abs(end - mp.cos(1.3) / 2 - mp.sin(1.3) / 4) < 1e-30
        momentum = mp.mpf(saved["p"][-1, 0]) + saved["p_low"][-1, 0]
        assert abs(momentum - (mp.cos(2) / 4 - mp.sin(2) / 2)) < 1e-30
    assert document["run"]["precision"] == "double-double"
    assert 0.0 < document["energy_change"] < 1e-31
    model = sc.load_model(spring)
    sc.save_model(model, "again.toml")
    assert sc.load_model("again.toml") == model


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["run", "--ensemble", "a.toml", "-o", "a.csv"], "-o a.csv (write a file NAME.npz) is not available"),
        (["generate", "-o", "spring_svi"], "a generated program or FMU is not available"),
        (["generate", "--fmu", "-o", "spring.fmu"], "a generated program or FMU is not available"),
        (["verify"], "a certificate is not available"),
        (["page", "-o", "a.html"], "a page is not available"),
    ],
)
def test_other_options_and_commands_are_refused(spring: Path, words: list[str], message: str) -> None:
    """Nothing is computed in double without a word."""
    assert message in " ".join(error_of(words[0], spring, *words[1:]).split())
    assert sorted(path.name for path in spring.parent.iterdir()) == ["spring.toml"]


@pytest.mark.rotated
def test_precision_of_error(spring: Path) -> None:
    """With "auto" a bound that double does not confirm is that of a run in two words; others are in double."""
    text = TEXT.replace("step = 0.125\nsteps = 16\n", "error = 3e-15\nspan = 200.0\n")
    for precision, error, expected in (("double-double", "3e-15", 2), ("auto", "3e-15", 2), ("auto", "1e-9", 1)):
        spring.write_text(text.replace("double-double", precision).replace("3e-15", error))
        document = json_of("run", spring, "-o", "states.npz")
        assert document["global_error"]["precision"] == ("double", "double-double")[expected - 1]
        assert ("q_low" in document["final"]) == (expected == 2)
        with np.load("states.npz") as saved:
            assert saved["q"][-1, 0] == document["final"]["q"]["q"]
            assert ("q_low" in saved) == (expected == 2)
        model = sc.load_model(spring)
        run, started = model.integrate(), model.start()
        assert (run.confirmation.precision == "double-double") == (expected == 2)
        started._run_to_target()
        assert started.q == run.q[-1]
        assert run.q[-1, 0] == document["final"]["q"]["q"]
    spring.write_text(text.replace("double-double", "auto"))
    refused = " ".join(error_of("run", spring, "-o", "states.csv").split())
    assert "-o states.csv (write a file NAME.npz) is not available" in refused


EXACT = {"q": "[0.1]", "q_dot": '["1/3"]', "w": "0.3"}


@pytest.mark.rotated
@pytest.mark.parametrize("words", [[], ["--q", "1/10", "--velocity", "1/3", "--parameter", "w=3/10"]])
def test_decimals_and_fractions_are_exact(spring: Path, words: list[str]) -> None:
    """Numbers of a file and of flags are exact decimals and fractions; in double they are the nearest doubles."""
    text = TEXT.replace("- q**2/2", "- w*q**2/2").replace("[0.5]", EXACT["q"] if not words else "[7.0]")
    text = text.replace("[0.25]", EXACT["q_dot"] if not words else "[7.0]")
    spring.write_text(text.replace("[initial]", f"[parameters]\nw = {EXACT['w'] if not words else 7.0}\n[initial]"))
    invoke("run", spring, *words, "-o", "states.npz")
    with mp.workdps(40), np.load("states.npz") as saved:
        rate = mp.sqrt(mp.mpf(3) / 10)
        exact = mp.cos(2 * rate) / 10 + mp.sin(2 * rate) / rate / 3
        assert abs(mp.mpf(saved["q"][-1, 0]) + saved["q_low"][-1, 0] - exact) < 1e-31
    if not words:
        model = sc.load_model(spring)
        sc.save_model(model, "again.toml")
        again = sc.load_model("again.toml")
        numbers = [(*each.q, *each.velocity, *each.parameters.values()) for each in (model, again)]
        lows = [[x.low for x in each] for each in numbers]
        assert lows[0] == lows[1]
        assert all(lows[0])
    else:
        double = json_of("run", spring, *words, "--precision", "double")
        assert abs(double["final"]["q"]["q"] - float(exact)) < 1e-14
        for wrong in ("1/0", "1/x", "1/2/3"):
            assert "give numbers separated by commas" in " ".join(error_of("run", spring, "--q", wrong).split())


@pytest.mark.rotated
def test_precision_is_read_and_replaced(spring: Path) -> None:
    """The flag replaces the value of the file; unknown values are refused."""
    assert not sc.load_model(spring, {"run": {"precision": "double"}}).in_double_double
    with pytest.raises(sc.ModelFileError, match="unknown precision 'quad': use 'double' or 'double-double'"):
        sc.load_model(spring, {"run": {"precision": "quad"}})
    for choices in ({"step": 0.125, "steps": None, "span": 1.3}, {"step": None, "steps": None, "span": 1.3}):
        run = sc.load_model(spring, {"run": choices}).integrate()
        with mp.workdps(40):
            assert abs(run.mp("q")[-1, 0] - mp.cos(1.3) / 2 - mp.sin(1.3) / 4) < 1e-30


@pytest.mark.rotated
@pytest.mark.parametrize(
    ("file", "text", "starts"),
    [
        ("grid.toml", '[grid]\nq = ["1/3", 0.1]\nw = {from = 0.1, to = 0.4, count = 4}\n', "1/3 0.1"),
        ("table.csv", "q,p_q,w\n0.1,0.2,0.3\n0.7,0.2,0.1\n", "0.1 0.7"),
    ],
)
def test_ensembles_are_exact(spring: Path, file: str, text: str, starts: str) -> None:
    """Numbers of grids and tables are exact decimals and fractions, and all final states have 30 digits."""
    spring.write_text(TEXT.replace("- q**2/2", "- w*q**2/2").replace("[initial]", "[parameters]\nw = 0.3\n[initial]"))
    Path(file).write_text(text)
    invoke("run", spring, "--ensemble", file, "-o", "ends.npz")
    with mp.workdps(40), np.load("ends.npz") as saved:
        tenths = [1, 2, 3, 4] if file == "grid.toml" else [3, 1]
        q0 = [mp.mpf(Fraction(each).numerator) / Fraction(each).denominator for each in starts.split()]
        states = [(q, w) for q in q0 for w in tenths] if file == "grid.toml" else list(zip(q0, tenths, strict=True))
        v = mp.mpf(1) / (4 if file == "grid.toml" else 5)
        assert len(states) == len(saved["status"])
        for j, (q, w) in enumerate(states):
            rate = mp.sqrt(mp.mpf(w) / 10)
            exact = q * mp.cos(2 * rate) + v * mp.sin(2 * rate) / rate
            assert abs(mp.mpf(saved["q"][-1, j, 0]) + saved["q_low"][-1, j, 0] - exact) < 1e-30

"""The commands with a model of an array system."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
from commands import error_of, invoke, json_of

RING = """
[system]
name = "ring"
coordinates = ["q[N]"]
lagrangian = "sum(i in N, q_dot[i]**2/2) - k*sum(i in N periodic, (q[i+1] - q[i])**2/2)"

[sizes]
N = 8

[parameters]
k = 1.0

[initial]
q = "sin(2*pi*i/N)"
q_dot = "cos(2*pi*i/N) + 1/10"

[method]
method = "svi:4"

[run]
step = 0.1
steps = 20
save_every = 5
"""

NEWTON = ("--solver", "newton")


@pytest.fixture
def ring(here: Path) -> str:
    """A model file in the present folder."""
    Path("ring.toml").write_text(RING)
    return "ring.toml"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("run", "--size", "N=4000", "--advise", "1e-9"), "--advise compiles an array model with its sizes"),
        (("run", "-o", "ring.txt"), "a trajectory is written as .npz, .csv"),
        (("run", "--size", "N=1.5"), "--size N must be a whole number, not 1.5"),
        (("run", "--parameter", "x=1"), "has no parameter 'x'"),
        (("generate", "-o", "folder", "--method", "scvi:4"), "not supported for array systems"),
        (("run", "--solver", "explicit"), "unknown solver 'explicit' of an array system"),
        (("generate", "-o", "folder", "--method", "stoermer-verlet", *NEWTON), "leave out solver='newton'"),
    ],
)
def test_unsupported_options_of_array_systems_are_rejected(ring: str, words: tuple[str, ...], message: str) -> None:
    """Exit status 2 and the reason."""
    assert message in error_of(words[0], ring, *words[1:])
    assert "belongs to coordinates that are arrays" in error_of("run", "kepler", "--size", "N=1")


@pytest.mark.rotated
def test_options_that_compile_the_model_with_its_sizes(ring: str) -> None:
    """Every other option unrolls the arrays; final states agree with those of the code for any sizes."""
    expected = json_of("run", ring)["final"]["q"]["q"]
    invoke("run", ring, "-o", "ring.csv")
    last = np.loadtxt("ring.csv", delimiter=",", skiprows=1)[-1]
    assert last[1:9] == pytest.approx(expected, abs=1e-14)
    invoke("run", ring, "-o", "ring.run")
    resumed = json_of("run", "--resume", "ring.run", "--steps", "20")
    assert list(resumed["final"]["q"].values()) == pytest.approx(expected, abs=1e-14)
    Path("grid.toml").write_text("[grid]\nk = [0.5, 1.0]\n")
    invoke("run", ring, "--ensemble", "grid.toml", "-o", "both.npz")
    with np.load("both.npz") as saved:
        assert saved["q"][-1, 1] == pytest.approx(expected, abs=1e-14)
    advised = json_of("run", ring, "--advise", "1e-6")
    assert list(advised["final"]["q"].values()) == pytest.approx(expected, abs=1e-5)
    assert list(
        json_of("run", ring, "--time-transformation", "1/(1 + q_0**2)", "--step", "0.1", "--span", "2")["final"][
            "q"
        ].values()
    ) == pytest.approx(expected, abs=1e-6)
    for words in (("derive", ring, "--html", "page.html"), ("generate", ring, "-o", "small", "--embedded", "double")):
        invoke(*words)
    printed = subprocess.run(["make", "-s", "run"], cwd="small", check=True, capture_output=True, text=True).stdout
    assert [float(word) for word in printed.splitlines()[-1].split()[1:9]] == pytest.approx(expected, abs=1e-12)
    invoke("generate", ring, "-o", "ring.fmu", "--fmu")
    invoke("generate", ring, "-o", "one", "--single-file")
    assert not Path("one/support").exists()

"""The commands with a model of an array system."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
from commands import error_of, invoke, json_of, output_of

from scvi_codegen import StateError
from scvi_codegen.analysis import verification
from scvi_codegen.codegen.native.compilers import find_compiler
from scvi_codegen.methods.method import Method
from scvi_codegen.systems.system import MechanicalSystem

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


@pytest.mark.rotated
def test_adaptive_run_of_an_array_system(ring: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The tolerance replaces the step of the file; verify and generate compile the sizes."""
    found = json_of("run", ring, "--tolerance", "1e-9", "--span", "7")
    assert (found["h"], found["tolerance"], found["final"]["t"], found["failure"]) == (None, 1e-9, 7.0, None)
    assert found["step_error"] < 1.1e-9  # the tolerance, and rounding errors of the state
    assert found["energy_change"] < 1e-7
    assert "rejected) from t = 0 to t = 2;" in output_of("run", ring, "--tolerance", "1e-9")
    Path("own.toml").write_text(RING.replace("step = 0.1\nsteps = 20", "tolerance = 1e-9\nspan = 2.0"))
    verified = list[tuple[int, float]]()

    def verify(system: MechanicalSystem, method: Method, *, tolerance: float, **others: object) -> None:
        verified.append((system.dimension, tolerance))
        raise StateError("not measured here")

    monkeypatch.setattr(verification, "verify", verify)
    assert "not measured here" in error_of("verify", "own.toml", "--size", "N=3")
    assert verified == [(3, 1e-9)]
    invoke("generate", "own.toml", "-o", "own_svi")
    printed = subprocess.run(["make", "-s", "run"], cwd="own_svi", check=True, capture_output=True, text=True).stdout
    last = [float(word) for word in printed.splitlines()[-2].split()]
    assert last[0] == 2.0
    expected = json_of("run", ring)["final"]["q"]["q"]
    assert last[1:9] == pytest.approx(expected, abs=1e-7)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("run", "--size", "N=4000", "--advise", "1e-9"), "--advise compiles an array model with its sizes"),
        (("run", "-o", "ring.txt"), "a trajectory is written as .npz, .csv"),
        (("run", "--size", "N=1.5"), "must be an integer, not 1.5"),
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


@pytest.mark.rotated
def test_generate_for_an_array_system(ring: str) -> None:
    """A folder whose program gives the states of the command, to round-off."""
    document = json_of("run", ring)
    invoke("generate", ring, "-o", "ring_svi")
    flags = ["-O1", "-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wno-psabi", "-Werror"]
    command = [*find_compiler(), *flags, "main.c", "ring_svi.c", "-lm", "-o", "main"]
    subprocess.run(command, cwd="ring_svi", check=True)
    printed = subprocess.run(["./main"], cwd="ring_svi", check=True, capture_output=True, text=True).stdout
    assert printed.count("energy =") == 5
    end = np.loadtxt("ring_svi/end.txt")
    assert end[:8] == pytest.approx(document["final"]["q"]["q"], abs=1e-14)
    assert end[8:] == pytest.approx(document["final"]["p"]["q"], abs=1e-14)
    without = Path("ring_svi/end.txt").read_text()
    subprocess.run(["make", "-s", "ring_svi_main"], cwd="ring_svi", check=True)
    ends = set()
    for threads in ("1", "3"):
        subprocess.run(["./ring_svi_main", threads], cwd="ring_svi", check=True, capture_output=True)
        ends.add(Path("ring_svi/end.txt").read_text())
    assert len(ends) == 1
    subprocess.run(["make", "-s", "-B", "THREADS=", "ring_svi_main"], cwd="ring_svi", check=True)
    subprocess.run(["./ring_svi_main", "3"], cwd="ring_svi", check=True, capture_output=True)
    assert ends == {Path("ring_svi/end.txt").read_text()}
    assert np.fromstring(without, sep=" ") == pytest.approx(np.fromstring(ends.pop(), sep=" "), abs=1e-14)
    Path("ring_svi/main.c").write_text("mine")
    assert "was edited" in error_of("generate", ring, "-o", "ring_svi")
    invoke("generate", ring, "-o", "ring_svi", "--force")

"""Command line: output, files and error messages."""

import errno
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import takewhile
from pathlib import Path

import numpy as np
import pytest
from click.shell_completion import ShellComplete
from commands import error_of, invoke, output_of
from programs import script

from scvi_codegen import Model, compile_stepper, problem
from scvi_codegen.interfaces.cli import ABOUT, main
from scvi_codegen.interfaces.cli.model_options import read_model
from scvi_codegen.interfaces.models.model_files.model_file import load_model, save_model
from scvi_codegen.methods import METHODS, SCVI, SVI, CollocationRK, Gauss, SpectralCollocation, StoermerVerlet

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("here")]

COMMAND = shutil.which("scvi-codegen", path=str(Path(sys.executable).parent))


def arrays(path: str) -> dict[str, np.ndarray]:
    with np.load(path) as file:
        return dict(file)


def chosen(name: str = "kepler", **choices: object) -> Model:
    return read_model(name, choices)


TESTED_ELSEWHERE = ("verify", "path", "doctor")


class TestHelp:
    @pytest.mark.parametrize("long", ["read", pytest.param("run", marks=pytest.mark.full)])
    @pytest.mark.rotated
    def test_every_example_of_the_help_is_accepted(self, long):
        """Commands with tests of their own, which take long, are only parsed; in the full tier all but pages run."""
        texts = [output_of("--help"), *(output_of(command, "--help") for command in ABOUT)]
        Path("mine.toml").write_text(output_of("systems", "kepler"))
        shutil.copy(Path(__file__).parents[2] / "examples/fput_ring.toml", "ring.toml")
        found = [match[1] for text in texts for match in re.finditer(r"^ +scvi-codegen (\w.*)$", text, re.MULTILINE)]
        lines = dict.fromkeys(re.split(r" {2,}", line)[0] for line in found)  # in order: some need others' files
        assert len(lines) >= 9
        for line in lines:
            words = list(takewhile(lambda word: word != ">", shlex.split(line)))
            if "--steps" not in words and words[0] == "run":
                words += ["--span", "10"] if "--span" not in words else []
            words += ["--list"] if words[0] == "reproduce" else []  # running it takes minutes
            if words[0] == "page" or (long == "read" and words[0] in TESTED_ELSEWHERE):
                context = main.make_context("scvi-codegen", words)
                main.resolve_command(context, words)[1].make_context(words[0], words[1:], parent=context)
            else:
                output_of(*words)

    @pytest.mark.parametrize(("word", "printed"), [("", "Begin with"), ("--help", "Usage"), ("--version", "version")])
    def test_the_overview_does_not_wait_for_sympy_or_numpy(self, word, printed):
        script = (
            "import sys; sys.modules['sympy'] = sys.modules['numpy'] = sys.modules['mpmath'] = None\n"
            f"from scvi_codegen.interfaces.cli import main; main('{word}'.split())"
        )
        result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
        assert printed in result.stdout

    @pytest.mark.parametrize(
        ("typed", "offered"),
        [
            (["run", "out"], {"outer-solar-system"}),
            (["run", "kepler", "--method", "sv"], {"svi"}),
            (["generate", "kepler", "--method", "svi:1"], {"svi:1", *(f"svi:{degree}" for degree in range(10, 17))}),
            (["run", "kepler", "--method", "explicit-euler:"], set()),
            (["verify", "kepler", "--method", "radau"], {"radau-ia", "radau-iia"}),
            (["derive", "planar"], {"planar-pendulum"}),
            (["systems", "hen"], {"henon-heiles"}),
            (["run", "kepler", "--solver", "new"], {"newton"}),
        ],
    )
    def test_a_shell_completes_models_and_methods(self, typed, offered):
        completion = ShellComplete(main, {}, "scvi-codegen", "_SCVI_CODEGEN_COMPLETE")
        found = completion.get_completions(typed[:-1], typed[-1])
        assert {item.value for item in found if item.type == "plain"} == offered


class TestChoices:
    def test_missing_selection_lists_the_catalogue(self):
        assert chosen() == Model.from_problem(problem("kepler"))
        assert chosen("fput-chain:5").system.dimension == 5

    def test_a_file_is_read_by_suffix_folder_or_existence(self, tmp_path):
        model = Model.from_problem(problem("kepler"))
        for name in ("a.toml", "plain"):
            save_model(model, name)
            assert chosen(name) == model
            assert chosen(str(tmp_path / name)) == model

    @pytest.mark.parametrize(
        ("choices", "method"),
        [
            ({"degree": 5}, SVI(5)),
            ({"quadrature": "gauss-lobatto:9"}, SVI(8, "gauss-lobatto:9")),
            ({"nodes": "equispaced"}, SVI(8, nodes="equispaced")),
            ({"method": "scvi"}, SCVI(8)),
            ({"method": "scvi", "degree": 3, "variational": False}, SCVI(3, variational=False)),
            ({"method": "sc", "form": "phase-space"}, SpectralCollocation(8, form="phase-space")),
            ({"method": "svi:6"}, SVI(6)),
            ({"method": "scvi:3", "variational": False}, SCVI(3, variational=False)),
            ({"method": "gauss"}, Gauss(8)),
            ({"method": "gauss", "stages": 3}, Gauss(3)),
            ({"method": "gauss", "stages": 3, "form": "position"}, Gauss(3, form="position")),
            ({"method": "collocation", "abscissae": (0.25, 1.0)}, CollocationRK((0.25, 1.0))),
            ({"method": "stoermer-verlet"}, StoermerVerlet()),
            ({"method": "scvi", "degree": 3, "abscissae": "gauss"}, SCVI(3, abscissae="gauss")),
            ({"degree": 4, "space": "splines:2"}, SVI(4, space="splines:2")),
            ({"degree": 3, "quadrature": "hermite:3"}, SVI(3, "hermite:3")),
        ],
    )
    def test_methods_are_selected_by_name(self, choices, method):
        assert chosen(**choices).method == method

    def test_options_supply_what_a_file_lacks(self):
        text = output_of("systems", "kepler")
        Path("bare.toml").write_text(text[: text.index("[initial]")])
        missing = "no q in [initial], no p or q_dot in [initial], no span or steps in [run]"
        assert missing in error_of("run", "bare.toml")
        model = chosen("bare.toml", q=(1.0, 0.0), velocity=(0.0, 1.0), step=0.1, steps=2)
        assert (model.method, model.h, model.steps, model.p) == (SVI(8), 0.1, 2, None)

    def test_selected_quadrature_is_retained_for_another_degree(self):
        save_model(replace(chosen(), method=SVI(3, "clenshaw-curtis:7")), "a.toml")
        assert chosen("a.toml", degree=4).method == SVI(4, "clenshaw-curtis:7")

    @pytest.mark.tiers(14, 35)
    @pytest.mark.parametrize(
        ("words", "message"),
        [
            ("keplr", "did you mean 'kepler'?"),
            ("keplr", "There is no model file 'keplr' either."),
            ("fput-chain:0", "a chain must have 1 to 1024 masses, not 0\n"),
            ("nowhere.toml", "nowhere.toml cannot be read: No such file or directory"),
            ("kepler --p 0,1 --velocity 0,1", "--p and --velocity exclude each other"),
            ("kepler --span 1 --steps 1", "--span and --steps exclude each other"),
            ("kepler --method gaus", "did you mean 'gauss'?"),
            ("kepler --method svi:6 --degree 4", "--method = svi:6 and --degree = 4 contradict each other"),
            ("kepler --method gauss:3 --stages 2", "--method = gauss:3 and --stages = 2 contradict each other"),
            (
                "kepler --method gauss:3 --degree 4",
                "--degree is not for the method gauss, which takes --stages, --form: omit it",
            ),
            (
                "kepler --method svi:x",
                "'svi:x' is not a method: the colon must be followed by a number, its degree, as in svi:8",
            ),
            ("kepler --method gauss:", "the colon must be followed by a number, its stages, as in gauss:8"),
            ("kepler --method collocation:2", "collocation does not take a number; its arguments are abscissae, form"),
            ("kepler --method gaus:2", "did you mean 'gauss'?"),
            ("kepler --span -10", "a run backward in time has --step = -0.25 and --span = 10"),
            ("kepler --event q3", "unknown name 'q3'. Known here: q1, q2"),
            ("kepler --event q1;z=3", "'z' is not a coordinate, a momentum, a velocity or a parameter"),
            ("kepler --event q1;p_q1", "'p_q1' in the event 'q1;p_q1' is not of the form NAME=VALUE"),
            (
                "kepler --stages 3",
                "--stages is not for the method svi, which takes --degree, --quadrature, --nodes, --space",
            ),
            ("kepler --printed", "--variational/--printed is not for the method svi, which takes --degree, "),
            (
                "kepler --method gauss:2 --printed",
                "--variational/--printed is not for the method gauss, which takes --stages",
            ),
            (
                "kepler --controller predictive --first-step 0.1",
                "--first-step requires adaptive steps: give --span without --step",
            ),
            ("kepler --quadrature gauss-legendre", "lacks its number of points"),
            ("kepler --degree x", "'x' is not a valid integer"),
            ("kepler --q 1,a", "could not convert string to float: 'a'"),
            ("kepler --q 1", "q must have 2 numbers for (q1, q2), not 1"),
            ("kepler --q nan,0", "--q, q1, is nan"),
            ("kepler --parameter mu", "'mu' is not of the form NAME=VALUE"),
            ("kepler --parameter mu=nan", "--parameter mu is nan: it must be finite"),
            ("kepler --parameter nu=1", "has no parameter 'nu'"),
            ("kepler --steps -1", "steps must be at least 0"),
            ("kepler --save-every 0", "--save-every must be at least 1"),
            ("kepler --span 1e15", "GB of memory: save fewer (--save-every "),
            ("kepler --span 1e15", "or record the run in a folder (-o NAME.run)"),
            ("kepler --seed 3", "--seed requires a heat bath"),
            ("kepler -o orbit.txt", "as .npz, .csv, .h5, .hdf5, .nc, .zarr or into a folder .run, not as 'orbit.txt'"),
            ("kepler -o no/orbit.npz", "there is no folder 'no'"),
            ("kepler --plot orbit.jpg", "saved as .png, .svg, .pdf, .gif, .html or .mp4"),
            ("relativistic-particle --velocity 2", "q = "),
            ("kepler --tolerance 1e-6 --advise 1e-6", "--tolerance and --advise exclude each other"),
            ("kepler --advise 1e-6 --step 0.1", "--step and --advise exclude each other"),
            (
                "kepler --advise 1e-6 --time-transformation distance --step 0.1",
                "--step and --advise exclude each other",
            ),
            (
                "kepler --advise 1e-6 --time-transformation distance",
                "--advise is not available with a time transformation",
            ),
            ("kepler --checkpoint 5", "--checkpoint requires a run recorded in a folder (-o NAME.run)"),
            (
                "kepler --time-transformation distance --step 0.1 --span 1 -o orbit.run",
                "a recorded run in transformed time needs a number of steps",
            ),
            ("kepler -o orbit.run --plot orbit.png", "--plot is not available for a run recorded in a folder"),
            ("kepler --ensemble states.csv --error 1e-6", "--error is not available with --ensemble"),
            (
                "kepler --ensemble states.csv --time-transformation distance --step 0.1",
                "each trajectory has its own times",
            ),
        ],
    )
    def test_mistakes_are_usage_errors(self, words, message):
        assert message in error_of(f"run {words}")

    @pytest.mark.second
    def test_warnings_are_one_line_each(self):
        result = invoke("run", "harmonic-oscillator", "--degree", "3", "--quadrature", "gauss-legendre:2")
        assert result.stderr.count("Warning: 2 quadrature points do not determine a curve of degree 3") == 1
        assert "MethodWarning" not in result.output


class TestRun:
    @pytest.mark.rotated
    def test_a_run_ends_at_its_span_with_a_shorter_last_step(self):
        """The last states of single runs, ensembles and array systems are those of Python's t_end."""
        Path("s.csv").write_text("q1,q2,q1_dot,q2_dot\n1.0,0.0,0.0,1.0\n")
        words = ("--step", "0.3", "--span", "1", "--save-every", "2")
        stepper = compile_stepper(problem("kepler").system, SVI(8))
        expected = stepper.integrate([1.0, 0.0], velocity=[0.0, 1.0], h=0.3, t_end=1.0)
        for more in (("--q", "1,0", "--velocity", "0,1"), ("--ensemble", "s.csv")):
            document = json.loads(output_of("run", "kepler", *words, *more, "-o", "a.npz", "--json"))
            assert document.get("h", 0.3) == 0.3
            assert document["steps"] in (4, {"least": 4, "most": 4})
            with np.load("a.npz") as saved:
                assert saved["t"] == pytest.approx([0.0, 0.6, 1.0], abs=1e-15)
                assert saved["q"][-1].ravel() == pytest.approx(expected.q[-1], abs=1e-15)
        path = Path(__file__).parents[2] / "examples/fput_ring.toml"
        text = output_of("run", str(path), *words, "-o", "r.npz")
        assert "4 steps of 0.3 from t = 0 to t = 1; 3 states saved" in text
        model = load_model(path, {"run": {"step": 0.3, "span": 1.0}})
        whole = model.stepper().integrate(model.q, velocity=model.velocity, h=0.3, t_end=1.0)
        with np.load("r.npz") as saved:
            assert saved["q"][-1] == pytest.approx(whole.q["q"][-1], abs=1e-15)
        assert model.integrate().t[-1] == 1.0

    @pytest.mark.rotated
    def test_equal_steps_of_recorded_runs_and_programs_end_elsewhere_with_a_warning(self):
        for words in (("run", "kepler", "-o", "a.run"), ("generate", "kepler", "-o", "program")):
            found = invoke(*words, "--step", "0.3", "--span", "1")
            assert "Warning: span 1 is not a whole number of steps of 0.3" in found.stderr
            assert "3 steps end at t = 0.9, not 1" in found.stderr
        assert "steps end at t = 2.1, not 2;" in invoke("run", "--resume", "a.run", "--span", "2", "--json").stderr
        for words in ("--step 0.25 --span 1", "--step 0.3 --steps 3", "--tolerance 1e-9 --span 1"):
            assert "whole number" not in output_of(f"run kepler {words}", "-o", "b.run")
            shutil.rmtree("b.run")

    @pytest.mark.second
    def test_energy_drift_is_detected(self):
        text = output_of("run", "kepler", "--method", "explicit-euler", "--step", "0.001", "--span", "10")
        assert float(re.search(r"drift (\S+) over", text)[1]) > 1e-3
        change, note = re.search(r"relative error of angular momentum: (\S+) at most(.*)", text).groups()
        assert float(change) > 1e-3
        assert note == " (not guaranteed by this method): hardly conserved"
        assert "NOT conserved" in output_of(
            "run", "kepler", "--method", "explicit-euler", "--step", "0.1", "--span", "10"
        )

    @pytest.mark.second
    def test_fewer_steps_than_save_every_and_no_steps(self):
        assert "3 steps of 0.25 from t = 0 to t = 0.75; 1 state saved" in output_of(
            "run", "kepler", "--steps", "3", "--save-every", "5", "-o", "a.npz"
        )
        assert "0 steps of 0.25" in output_of("run", "kepler", "--steps", "0", "-o", "a.npz")
        assert len(arrays("a.npz")["t"]) == 1

    @pytest.mark.rotated
    @pytest.mark.parametrize("inputs", ["", "inputs = ['u']\n[forces]\nx = 'u'\n[inputs]\nu = {file = 'u.csv'}\n"])
    def test_adaptive_run_that_fills_the_memory_writes_its_states(self, inputs, monkeypatch):
        monkeypatch.setattr("scvi_codegen.codegen.native.capacity.usable_memory", lambda: 30_000.0)
        text = f"[system]\nname = 'o'\ncoordinates = ['x']\nlagrangian = 'x_dot**2/2-x**2/2'\n{inputs}"
        Path("o.toml").write_text(f"{text}[initial]\nq = [1.0]\np = [0.0]\n", encoding="utf-8")
        Path("u.csv").write_text("t,value\n" + "".join(f"{t},{t % 2}\n" for t in range(1001)), encoding="utf-8")
        words = "run", "o.toml", "--method", "svi:4", "--tolerance", "1e-9", "--span", "1000", "-o", "o.npz"
        message = error_of(*words, status=1)
        t = arrays("o.npz")["t"]
        assert f"the {len(t)} states of the run up to t = {t[-1]:g} fill the memory" in message
        assert f"the {len(t)} states computed before were written: o.npz" in message

    @pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
    def test_interrupted_run_saves_computed_states(self, number, monkeypatch):
        @contextmanager
        def third_chunk(steps: int) -> Iterator[Callable[[int], None]]:
            done = []
            yield lambda count: signal.raise_signal(number) if done.append(count) or len(done) == 3 else None

        monkeypatch.setattr("scvi_codegen.interfaces.cli.running.progress_bar", third_chunk)
        result = invoke("run", "kepler", "--steps", "1000000", "-o", "orbit.npz", status=130)
        assert "Error: interrupted at t = " in result.stderr
        t = arrays("orbit.npz")["t"]
        assert f"the {len(t)} states computed before were written: orbit.npz" in result.stderr
        assert 3 < len(t) < 1000
        assert np.allclose(np.diff(t), 0.25)
        assert "relative energy error" in result.stdout

    @pytest.mark.second
    def test_failing_step_saves_computed_states(self):
        # Falls into the centre of attraction along a line that a step of Newton's method cannot pass.
        words = "--method gauss --stages 1 --velocity 0,0 --step 0.01 --max-iterations 3 -o fall.npz"
        result = invoke(f"run kepler {words}", status=1)
        step = int(
            re.search(r"Error: step (\d+) at t = \S+ with h = 0.01 failed: .* did not converge", result.stderr)[1]
        )
        assert step > 5
        assert f"the {step + 1} states computed before were written: fall.npz" in result.stderr
        assert f"{step} steps of 0.01" in result.stdout
        written = arrays("fall.npz")
        assert np.array_equal(written["t"], 0.01 * np.arange(step + 1))
        assert np.isfinite(written["q"]).all()

    def test_unwritable_folders_are_found_before_the_run(self, tmp_path, monkeypatch):
        monkeypatch.setattr(os, "access", lambda path, mode: False)
        assert "is not writable" in error_of("run", "kepler", "-o", str(tmp_path / "a.npz"))

    def test_missing_matplotlib_is_found_before_the_run(self, monkeypatch):
        monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
        assert "pip install 'scvi-codegen[plot]'" in error_of("run", "kepler", "--plot", "a.png")


@pytest.mark.rotated
@pytest.mark.skipif(COMMAND is None, reason="the command is not installed beside this Python")
class TestInstalledCommand:
    def test_ctrl_c_while_it_compiles_is_one_line(self, tmp_path, monkeypatch):
        compiler = script(tmp_path / "slow-cc", "#!/bin/sh\ntouch started\nexec sleep 3600\n")
        monkeypatch.setenv("CC", f"{compiler} {tmp_path}")  # two words: its file is not its version
        monkeypatch.setenv("SCVI_CODEGEN_CACHE", str(tmp_path / "cache"))
        process = subprocess.Popen(
            [COMMAND, "verify", "kepler", "--degree", "2"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        while not (tmp_path / "started").exists() and not list(tmp_path.rglob(".building-*/**/started")):
            assert process.poll() is None, process.communicate()
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGINT)
        assert process.communicate(timeout=300) == ("", "Error: interrupted\n")
        assert process.returncode == 130

    def test_closed_pipe_is_not_an_error(self):
        result = subprocess.run(f"{COMMAND} systems | head -1", shell=True, capture_output=True, text=True, check=False)
        assert result.stderr == ""


class TestListings:
    def test_methods_lists_names_arguments_and_properties(self):
        text = output_of("methods")
        for name in METHODS:
            assert re.search(rf"^{name}(\[:(degree|stages|order)\])? ", text, re.MULTILINE)
        assert re.search(r"^svi\[:degree\] +degree, quadrature, nodes, space +svi:4 +8 +yes +yes$", text, re.MULTILINE)
        assert re.search(r"^ +scvi:4 --printed +none claimed +no +no$", text, re.MULTILINE)

    def test_tableaux_in_radicals_and_in_decimals(self):
        assert "1/2 - sqrt(3)/6 |" in output_of("methods", "--tableau", "gauss:2")
        assert "37/225 - 169*sqrt(6)/1800" in output_of("methods", "--tableau", "radau-iia:3")
        assert "\nb_1 = 1/4 - sqrt(30)/72\n" in output_of("methods", "--tableau", "gauss:4")
        text = output_of("methods", "--tableau", "gauss:5")
        assert "order 10, symplectic, symmetric, A-stable" in text
        assert len(text.splitlines()) == 8
        assert "gauss" in error_of("methods", "--tableau", "gaus:3")


@pytest.mark.rotated
@pytest.mark.parametrize("stream", ["1", "2"])
def test_a_run_with_a_closed_stream_writes_its_file(stream, tmp_path):
    """A closed stream, as in ``2>&-`` of a shell, loses only what is printed there."""
    command = f"{shlex.quote(sys.executable)} -m scvi_codegen run kepler --step 0.1 --steps 5 -o a.npz {stream}>&-"
    ended = subprocess.run(["sh", "-c", command], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ended.returncode == 0
    assert (tmp_path / "a.npz").exists()
    assert ("q1 =" in ended.stdout) == (stream == "2")


@pytest.mark.rotated
def test_unwritable_package_is_a_failure(tmp_path, monkeypatch):
    """Exit status 1, as for every file that cannot be written."""

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("scvi_codegen.interfaces.models.packages.package.write_text", full)
    assert "cannot be written: No space left" in error_of("generate", "kepler", "-o", tmp_path / "kepler_svi", status=1)

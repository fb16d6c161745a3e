"""Ensembles on an emulated GPU: bits, failures, inputs, arrays of other libraries, and the cache.

The driver runs end to end, but no launch or copy of CUDA is tested here: that requires a device.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import invoke
from emulated_gpu import ArrayOfLibrary, EmulatedGpu
from pages import ROOT, runnable
from samples import ensemble_runs, pushed_pendulum, sample_named

import scvi_codegen as sc
from scvi_codegen.codegen.native import cuda
from scvi_codegen.codegen.native.building import PORTABLE_FLAGS
from scvi_codegen.methods import Method
from scvi_codegen.runs.ensembles.device import DeviceEnsemble

pytestmark = pytest.mark.rotated

CASES = {
    "kepler": "svi:8",
    "double-pendulum": "svi:3",
    "driven-duffing": "gauss:3",
    "pumped-cart-pole": "svi:3",
    "charged-particle": "radau-iia:2",
    "henon-heiles": "sc:3",
    "planar-pendulum": "composition:8",
    "relativistic-particle": "lobatto-iiia:3",
}
"""A method for each kind of step: explicit; iterations with constant and variable masses, momenta, explicit time."""
COUNT, PLAN = 5, {"h": 0.05, "steps": 23, "save_every": 4}


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> EmulatedGpu:
    """Return an emulated GPU, on which ``device="cuda"`` runs."""
    emulated = EmulatedGpu(tmp_path)
    monkeypatch.setattr(cuda, "cuda_core", lambda: emulated)
    monkeypatch.setattr(cuda, "compiler_version", lambda: emulated.version)
    return emulated


def compiled(system: str, method: Method | str) -> sc.Stepper:
    """Return a stepper whose code has no fused multiply-add, as that of the emulated GPU."""
    return sc.compile_stepper(sample_named(system).system, method, flags=PORTABLE_FLAGS)


def states(system: str) -> tuple[np.ndarray, np.ndarray]:
    """Return (COUNT, m) positions and momenta about the generic state of a system."""
    factors = 1.0 + 0.1 * np.random.default_rng(7).uniform(-1, 1, (COUNT, 1))
    q, p = sample_named(system).state
    return factors * q, factors * p


def check_bits(stepper: sc.Stepper, q: np.ndarray, p: np.ndarray, **plan: object) -> DeviceEnsemble:
    """Compare trajectories of the GPU with each alone in a block of SIMD lanes."""
    runs = stepper.integrate_ensemble(q, p, device="cuda", **plan)
    host = runs.to_host()
    for j in range(len(q)):
        own = {name: each[j : j + 1] for name, each in plan.get("parameters", {}).items()}  # type: ignore[attr-defined]
        alone = stepper.integrate_ensemble(q[[j]], p[[j]], **plan | ({"parameters": own} if own else {}))
        assert np.array_equal(host.q[:, j], alone.q[:, 0], equal_nan=True)
        assert np.array_equal(host.p[:, j], alone.p[:, 0], equal_nan=True)
        assert (host.status[j], host.steps[j]) == (alone.status[0], alone.steps[0])
    assert np.array_equal(host.t, alone.t)
    return runs


def test_a_thread_equals_a_trajectory_alone_bit_by_bit(gpu: EmulatedGpu) -> None:
    stepper, (q, p) = compiled("kepler", sc.SVI(4)), states("kepler")
    runs = check_bits(stepper, q, p, **PLAN, parameters={"mu": np.linspace(0.8, 1.2, COUNT)})
    assert repr(runs).startswith("<DeviceEnsemble of ")
    assert np.from_dlpack(runs.q).shape == (6, COUNT, 2)
    assert (len(runs), runs.ok.all(), runs.h, runs.t[-1]) == (COUNT, True, 0.05, runs.to_host().t[-1])
    on_device = ArrayOfLibrary(q), ArrayOfLibrary(p)
    again = stepper.integrate_ensemble(*on_device, device="cuda", **PLAN, parameters={"mu": ArrayOfLibrary(q[:, 0])})
    assert np.array_equal(again.to_host().parameters[:, 0], q[:, 0])
    assert gpu.launches == [("advance", 64)] * 2
    still = stepper.integrate_ensemble(q, p, device="cuda", h=0.1, steps=0)
    assert np.array_equal(still.to_host().q[0], q)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("system", CASES)
def test_systems_and_methods_with_lanes_have_the_same_bits(gpu: EmulatedGpu, system: str) -> None:
    check_bits(compiled(system, CASES[system]), *states(system), **PLAN | {"t": 0.3})


@pytest.mark.parametrize(
    "plan", [{"h": 0.1, "t_end": 2.3, "save_every": 3}, {"h": -0.1, "t": 2.55, "t_end": 0.02}], ids=["on", "back"]
)
def test_inputs_change_parameters_and_step_sizes_between_launches(gpu: EmulatedGpu, plan: dict) -> None:
    stepper = sc.compile_stepper(pushed_pendulum(), sc.SVI(3), flags=PORTABLE_FLAGS)
    knots, generator = np.array([0.0, 0.37, 0.9, 1.41, 2.05, 2.6]), np.random.default_rng(1)
    values, start = generator.uniform(-1, 1, (COUNT, 6)), generator.uniform(-1, 1, (2, COUNT, 1))
    host = stepper.integrate_ensemble(*start, inputs={"u": (knots, values), "w": 0.1}, device="cuda", **plan).to_host()
    for j in range(COUNT):
        inputs = {"u": (knots, values[[j]]), "w": 0.1}
        alone = stepper.integrate_ensemble(*(x[[j]] for x in start), inputs=inputs, **plan)
        assert np.array_equal(host.q[:, j], alone.q[:, 0])
    assert np.array_equal(host.t, alone.t)
    assert np.isfinite(host.energy()).all()


@pytest.mark.filterwarnings("ignore::scvi_codegen.common.errors.AccuracyWarning")
def test_trajectories_that_stop_are_continued_by_the_processor(gpu: EmulatedGpu) -> None:
    e = np.array([0.1, 0.97, 0.98, 0.99, 0.5])
    q, p = np.stack([1 - e, 0 * e], axis=1), np.stack([0 * e, np.sqrt((1 + e) / (1 - e))], axis=1)
    runs = check_bits(compiled("kepler", sc.SVI(4)), q, p, h=0.1, steps=100, save_every=7)
    assert runs.ok.tolist() != [True] * 5
    assert ("replace", 64) in gpu.launches
    assert np.isnan(np.from_dlpack(runs.p)).any()
    runaway = compiled("runaway", sc.SVI(4))  # to infinity
    lost = check_bits(runaway, np.array([[-1.0], [1.0]]), np.array([[-0.5], [1.0]]), h=0.05, steps=50)
    assert lost.ok.tolist() == [True, False]


OBSERVED = {"energy": "kepler", "extremes": "double-pendulum", "events": "planar-pendulum"}


def check_observed(stepper: sc.Stepper, start: tuple[np.ndarray, np.ndarray], observe: str) -> None:
    """Compare what is observed on the GPU and on the processor with states after all steps."""
    plan = {"h": 0.05, "steps": 150}
    runs = [stepper.integrate_ensemble(*start, **plan, device=each, observe=observe) for each in ("cuda", None)]
    on_device, on_processor, (q, p) = runs[0].observed, runs[1].observed, (runs[1].q, runs[1].p)
    assert np.array_equal(runs[0].to_host().observed, on_device)
    assert np.abs(on_device - on_processor).max() < 1e-13
    if observe == "events":
        expected = [np.count_nonzero((x[:-1] < 0) & (x[1:] >= 0), axis=0) for x in (q[:, :, 0], p[:, :, 0])]
        expected[1] += np.count_nonzero((p[:-1, :, 0] > 0) & (p[1:, :, 0] <= 0), axis=0)
        assert np.array_equal(on_processor, np.stack(expected, axis=1))
        assert (on_processor > 0).all()
    else:
        values = runs[1].energy() if observe == "energy" else np.concatenate([q, p], axis=2)
        assert np.abs(on_processor - [np.nanmin(values, axis=0), np.nanmax(values, axis=0)]).max() < 1e-13


@pytest.mark.filterwarnings("ignore::scvi_codegen.common.errors.AccuracyWarning")
@pytest.mark.parametrize("observe", ["energy", "events", pytest.param("extremes", marks=pytest.mark.full)])
def test_values_at_all_steps_are_observed_without_saving_them(gpu: EmulatedGpu, observe: str) -> None:
    system = OBSERVED[observe]
    stepper = compiled(system, sc.SVI(4)).with_events(
        [sc.Event("q", direction=1), "q_dot"] if observe == "events" else ()
    )
    check_observed(stepper, states(system), observe)


def test_interrupted_runs_have_the_states_so_far(gpu: EmulatedGpu) -> None:
    stepper, (q, p) = compiled("kepler", sc.SVI(4)), states("kepler")
    work = ensemble_runs(stepper, q, p, h=0.05, steps=200, device="cuda")

    def stop(done: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work.run(progress=stop)
    runs, part = work.result(), stepper.integrate_ensemble(q, p, h=0.05, steps=64)
    assert set(runs.status) == {"interrupted"}
    assert runs.steps.tolist() == [64] * COUNT
    assert np.abs(runs.q[:65] - part.q).max() < 1e-13
    assert np.isnan(runs.q[65:]).all()


def test_binaries_are_cached_by_architecture(gpu: EmulatedGpu, tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    stepper, (q, p) = compiled("kepler", sc.SVI(4)), states("kepler")
    monkeypatch.setenv("SCVI_CODEGEN_CACHE", str(tmp_path / "cache"))
    for _ in range(2):
        stepper.integrate_ensemble(q, p, h=0.05, steps=1, device="cuda")
    assert gpu.compiled == ["sm_90"]
    cuda.compiled_kernel(cuda.kernel_text(stepper.ensemble), "sm_80")
    cuda.compiled_kernel(cuda.kernel_text(stepper.ensemble), "sm_80", fma=False)
    assert gpu.compiled == ["sm_90", "sm_80", "sm_80"]


def test_unavailable_arguments_are_refused(gpu: EmulatedGpu) -> None:
    stepper, start = compiled("kepler", sc.SVI(4)), states("kepler")

    def refused(message: str, kind: type[Exception] = sc.StateError, of: sc.Stepper = stepper, **arguments) -> None:
        with pytest.raises(kind, match=message):
            of.integrate_ensemble(*start, **{"device": "cuda", "h": 0.1, "steps": 5} | arguments)

    refused("device is 'gpu': it must be 'cuda', or omitted", device="gpu")
    refused("adaptive step size .* not available with device: give h and steps", h=None, steps=None, t_end=1.0)
    refused("not available with t_eval: give h, steps and save_every", h=None, steps=None, t_end=1.0, t_eval=[1.0])
    refused("not available with error: give h and steps", h=None, steps=None, t_end=1.0, error=1e-6)
    for device in (None, "cuda"):
        refused(
            "ensembles have no observer 'energies'.* Known: extremes, energy, events", device=device, observe="energies"
        )
        refused("which has none: use with_events", sc.EventError, device=device, observe="events")
        refused("requires a fixed step size", h=None, steps=None, t_end=1.0, device=None, observe="energy")
    lobatto = compiled("kepler", sc.SCVI(2))
    refused(
        "not available without trajectories in SIMD lanes", sc.MethodError, of=lobatto, device=None, observe="energy"
    )
    refused("not available without trajectories in SIMD lanes", sc.MethodError, of=lobatto)
    gpu.memory = 1000
    refused("cannot allocate .* for states of shape .*: raise save_every, or split", sc.BuildError, steps=50)


def test_command_line_and_model_files_choose_the_device(gpu: EmulatedGpu, tmp_path) -> None:
    (tmp_path / "angles.csv").write_text("q\n0.1\n0.7\n2.0\n")
    words = ["run", "planar-pendulum", "--step", "0.1", "--steps", "20"]
    ensemble = ["--ensemble", str(tmp_path / "angles.csv"), "-o", str(tmp_path / "a.npz")]

    def run(*arguments: str) -> str:
        return invoke(*arguments, status=None).output

    assert " s on a GPU, " in run(*words, *ensemble, "--device", "cuda")
    assert len(gpu.launches) == 1
    found = np.load(tmp_path / "a.npz")["q"]
    run(*words, *ensemble)
    assert np.abs(np.load(tmp_path / "a.npz")["q"] - found).max() < 1e-13
    seen = run(*words, *ensemble, "--observe", "extremes")
    assert "  q: " in seen
    observed, whole = np.load(tmp_path / "a.npz")["observed"], found[:, :, 0]
    assert np.abs(observed[:, :, 0] - [whole.min(axis=0), whole.max(axis=0)]).max() < 1e-13
    assert "is for ensembles only: give --ensemble FILE, or omit device" in run(*words, "--device", "cuda")
    assert "at most over all steps, of trajectory" in run(*words, *ensemble, "--observe", "energy")
    system = sc.problem("planar-pendulum").system
    model = sc.Model(system=system, method="svi:4", q=(0.5,), p=(0.0,), h=0.1, steps=20, device="cuda")
    sc.save_model(model, tmp_path / "model.toml")
    assert sc.load_model(tmp_path / "model.toml").device == "cuda"
    with pytest.raises(sc.ModelFileError, match="is for ensembles only"):
        model.integrate()
    with pytest.raises(sc.ModelFileError, match="unknown device 'gpu': use 'cuda'"):
        replace(model, device="gpu")


@pytest.mark.second
def test_code_of_the_page_runs(gpu: EmulatedGpu, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    page = (ROOT / "docs" / "gpu.md").read_text(encoding="utf-8")
    monkeypatch.setitem(sys.modules, "cupy", np)
    exec("\n".join(part.text for part in runnable(page) if part.kind == "python"), {})
    assert capsys.readouterr().out == "True (10,)\nTrue\n"


@pytest.mark.quick
def test_without_a_gpu_the_error_names_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    class WithoutDriver:
        @staticmethod
        def Device() -> None:
            raise RuntimeError("no driver")

    monkeypatch.setattr(cuda, "cuda_core", lambda: WithoutDriver)
    with pytest.raises(sc.BuildError, match=r"requires an NVIDIA GPU with its driver.*omit device"):
        compiled("kepler", sc.SVI(4)).integrate_ensemble([1.0, 0.0], [0.0, 1.0], h=0.1, steps=5, device="cuda")


def test_inverse_roots_begin_with_the_estimates_of_a_device(gpu: EmulatedGpu) -> None:
    stepper, start = compiled("kepler", sc.SVI(4)), states("kepler")
    gpu.estimates = True
    runs = stepper.integrate_ensemble(*start, **PLAN, device="cuda").to_host()
    assert np.abs(runs.q[-1] - stepper.integrate_ensemble(*start, **PLAN).ends[1]).max() < 1e-13

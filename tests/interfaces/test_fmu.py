"""FMUs: what describes them, and what they compute through FMI's functions, bit for bit what the stepper computes."""

import importlib.util
import subprocess
import zipfile
from ctypes import byref, c_bool, c_double, c_size_t, c_uint32, c_void_p
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from commands import error_of
from fmu import DISCARD, ERROR, OK, Fmu, Slave
from notation import lagrange
from numpy.testing import assert_allclose
from style import check_style

import scvi_codegen as sc
from scvi_codegen.codegen.native.building import PORTABLE_FLAGS, TARGETS
from scvi_codegen.interfaces.models.packages import fmu as fmu_module

H = 0.1
STRICT = "-std=c99 -O1 -Wall -Wextra -Wpedantic -Wshadow -Wconversion -Wno-psabi -Werror -c".split()  # noqa: SIM905
NEVER_CALLED = (
    "EnterEventMode",
    "GetContinuousStates",
    "GetDirectionalDerivative",
    "SetClock",
    "ActivateModelPartition",
)


def pushed(**given):
    """A pushed pendulum with friction, some of whose mass is data, too."""
    text = "(m + w)*q_dot**2/2 + cos(q)"
    system = lagrange(
        'pushed pendulum <&> "friends"', "q", text, forces={"q": "u - c*q_dot"}, inputs="w u", c=0.2, m=1.5
    )
    return sc.Model(system=system, method=sc.SVI(4), q=(0.3,), h=H, t=0.5, span=2.3, **(given or {"velocity": (0.5,)}))


def rod():
    """A mass on a rod, in Cartesian coordinates."""
    system = lagrange("rod", "x y", "(x_dot**2 + y_dot**2)/2 - y", constraints=["x**2 + y**2 = 1"])
    return sc.Model(
        system=system, method=sc.SVI(2, "gauss-lobatto:3"), q=(1.0, 0.0), velocity=(0.0, 0.2), h=H, steps=10
    )


@pytest.fixture(scope="module")
def fmu(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fmu")
    return Fmu(sc.generate_fmu(pushed(), folder / "pushed.fmu"), folder / "unpacked")


def stepper_of(model):
    return sc.compile_stepper(model.system, model.method, flags=PORTABLE_FLAGS)


MODELS = {
    "velocities": lambda: replace(sc.Model.from_problem(sc.problem("kepler"), sc.SVI(4)), t=-3.0),
    "momenta": lambda: sc.Model.from_problem(sc.problem("point-vortices"), sc.Gauss(2)),
    "explicit": lambda: sc.Model.from_problem(sc.problem("henon-heiles"), sc.StoermerVerlet()),
    "constraints": rod,
}


@pytest.mark.rotated
@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", MODELS)
def test_states_equal_those_of_the_stepper_bitwise(name, tmp_path):
    model = MODELS[name]()
    one, h = Slave(Fmu(sc.generate_fmu(model, tmp_path / "one.fmu"), tmp_path / "unpacked")), model.h
    assert one.start(model.t) == OK, one.log
    stepper = stepper_of(model)
    run = stepper.integrate(model.q, model.momenta(stepper), h=h, steps=30, t=model.t)
    names = ["t", *stepper.coordinates, *(f"{name}_dot" for name in stepper.coordinates), *stepper.interface.momenta]
    found = [one.get(*names, "energy")]
    for k in range(10):
        assert one.step(model.t + 3 * k * h, 3 * h) == OK
        found.append(one.get(*names, "energy"))
        assert one.last == found[-1][0]
    expected = np.column_stack([run.t, run.q, run.velocity, run.p, run.energy()])[::3]
    assert_allclose(np.array(found), expected, rtol=0, atol=0)


def check_event_mode(fmu, model, run):
    """Steps end at changes of the state, which appear when the discrete states are updated in event mode."""
    assert fmu.description.find("CoSimulation").get("hasEventMode") == "true"
    names, wanted = ("t", "x", "y", "p_x", "p_y"), np.sort(np.concatenate([each.t for each in run.events]))
    one = Slave(fmu, events=True, early=True)
    assert one.start() == OK
    assert one.call("DoStep", c_double(0.0), c_double(H), c_bool(True), *[None] * 4) == ERROR
    assert one.update_discrete_states() == (False, False)
    assert one.call("EnterStepMode") == OK
    met, t = [], 0.0
    while t < 7.0:
        if len(met) == 2:
            saved = one.saved_state()
            assert one.do_step(t, 1.0)[0] == OK
            assert one.call("SetFMUState", saved) == OK
        end = np.floor(t + 1.0 + 1e-9)
        status, event, terminate, early = one.do_step(t, end - t)
        assert (status, terminate, early) == (OK, False, one.last < end - 1e-9)
        t = one.last
        if event:
            (crossings,) = [each for each in run.events if (abs(each.t - t) < 1e-12).any()]
            (at,) = np.flatnonzero(abs(crossings.t - t) < 1e-12)
            row = np.flatnonzero(run.t == crossings.t[at])[-1]
            assert one.call("EnterEventMode") == OK
            before = one.get(*names)
            assert_allclose(before, [t, *crossings.q[at], *crossings.p[at]], rtol=0, atol=1e-13)
            assert one.update_discrete_states() == (True, False)
            assert_allclose(one.get(*names), [t, *run.q[row], *run.p[row]], rtol=0, atol=1e-13)
            assert before != one.get(*names)
            assert one.update_discrete_states() == (False, False)
            assert one.call("EnterStepMode") == OK
            met.append(t)
        else:
            row = np.flatnonzero(abs(run.t - t) < 1e-9)[-1]
            assert_allclose(one.get(*names), [t, *run.q[row], *run.p[row]], rtol=0, atol=1e-13)
    assert_allclose(met, wanted, rtol=0, atol=1e-13)
    assert one.do_step(7.0, 15.0)[:4] == (OK, True, False, True)  # the crossing of x = -2 ends the simulation
    assert_allclose([one.last, *one.get("x")], [8.0, -2.0], rtol=0, atol=1e-13)
    assert one.call("EnterEventMode") == OK
    assert one.update_discrete_states() == (True, True)


@pytest.mark.rotated
def test_impacts_within_communication_steps(tmp_path):
    """States equal those of the stepper, also from a saved state; the crossing of x = -2 ends the simulation."""
    system = lagrange("ball", "x y", "(x_dot**2 + y_dot**2)/2 - g*y - y**4/40", g=1.0)
    walls = (sc.impact("y", 0.8), sc.Event("x - 3", then={"p_x": "-p_x"}), sc.Event("x + 2", -1, terminal=1))
    model = sc.Model(system=system, method=sc.SVI(2), q=(0.0, 1.0), velocity=(1.0, 0.0), h=H, steps=60, events=walls)
    one = Slave(Fmu(sc.generate_fmu(model, tmp_path / "ball.fmu"), tmp_path / "unpacked"))
    assert one.start() == OK
    run = model.stepper().integrate(model.q, velocity=model.velocity, h=H, steps=70)
    for k in range(70):
        if k == 30:
            saved = one.saved_state()
            assert one.step(k * H, H) == OK
            assert one.call("SetFMUState", saved) == OK
        assert one.step(k * H, H) == OK
        row = np.flatnonzero(np.abs(run.t - (k + 1) * H) < 1e-9)[0]
        assert_allclose(one.get("x", "y"), run.q[row], rtol=0, atol=1e-14)
        assert_allclose(one.get("p_x", "p_y"), run.p[row], rtol=0, atol=1e-14)
    assert [len(each) for each in run.events] == [4, 1, 0]
    assert one.do_step(70 * H, 15 * H) == (OK, False, True, False)
    assert_allclose([one.last, *one.get("x")], [8.0, -2.0], rtol=0, atol=1e-13)
    check_event_mode(one.fmu, model, run)
    with pytest.raises(sc.ModelFileError, match="must change the state"):
        sc.generate_fmu(replace(model, events=walls[2:]), tmp_path / "ended.fmu")


@pytest.mark.second
def test_inputs_are_zero_order_hold_and_parameters_may_change(fmu):
    model, one = pushed(), Slave(fmu)
    assert one.start(0.5, u=0.25, w=0.1) == OK
    run = stepper_of(model).start(model.q, velocity=model.velocity, h=H, t=0.5, parameters={"w_0": 0.1, "u_0": 0.25})
    for k in range(8):
        u, w = -1.5 * one.get("q")[0], 0.1 + 0.01 * k
        assert one.set(u=u, w=w) == OK
        run.set_inputs(u=u, w=w)
        assert one.step(0.5 + 2 * k * H, 2 * H) == OK
        run.advance(2)
        assert one.get("q", "p_q") == [*run.q, *run.p]
    before = one.get("energy")
    assert one.set(m=2.5) == OK
    assert one.get("energy") < before  # the same momentum of a larger mass
    assert one.get("q_dot") == [run.p[0] / (2.5 + w)]


@pytest.mark.second
def test_saved_fmu_state_continues_bitwise_also_from_bytes(fmu):
    one, other = Slave(fmu), Slave(fmu)
    assert one.start(0.5) == one.step(0.5, 3 * H) == OK
    state = one.saved_state()
    data = one.as_bytes(state)
    assert one.set(u=1.0) == one.step(0.8, 2 * H) == OK
    ends = [one.get("t", "q", "p_q", "energy")]
    for again, given in ((one, state), (other, c_void_p())):
        if again is other:
            assert other.from_bytes(data, given) == OK
        assert again.call("SetFMUState", given) == OK
        assert again.get("u") == [0.0]
        assert again.set(u=1.0) == again.step(0.8, 2 * H) == OK
        ends.append(again.get("t", "q", "p_q", "energy"))
        assert again.call("FreeFMUState", byref(given)) == OK
        assert given.value is None
    assert ends[0] == ends[1] == ends[2]
    assert other.from_bytes(data[:-1], c_void_p()) == ERROR
    assert other.from_bytes(b"x" + data[1:], c_void_p()) == ERROR


def test_failed_step_is_discarded_without_side_effects(fmu):
    one = Slave(fmu)
    assert one.start(0.5) == one.step(0.5, H) == OK
    before = one.get("t", "q", "p_q")
    assert one.set(u=float("nan")) == OK
    saved = one.as_bytes(one.saved_state())
    assert one.step(0.6, 2.5 * H) == DISCARD
    assert one.as_bytes(one.saved_state()) == saved
    assert one.log[-1][:2] == (DISCARD, b"logStatusDiscard")
    assert "NaN" in one.log[-1][2]
    assert (one.last, one.get("t", "q", "p_q")) == (before[0], before)
    assert one.set(u=0.0) == one.step(0.6, H) == OK
    assert one.call("Reset") == OK
    assert one.start(0.5) == one.step(0.5, H) == OK
    assert one.get("t", "q", "p_q") == before


def test_forbidden_calls_are_errors_with_a_reason(fmu):
    one = Slave(fmu)
    assert one.step(0.5, H) == one.call("ExitInitializationMode") == one.call("Terminate") == ERROR
    assert one.set(q=0.1, q_dot=0.0) == one.start(0.5) == OK
    assert (
        one.call("EnterInitializationMode", c_bool(False), c_double(0), c_double(0), c_bool(False), c_double(0))
        == ERROR
    )
    for name in ("q", "q_dot", "p_q", "energy", "t"):
        assert one.set(**{name: 1.0}) == ERROR
    for point, size in ((0.7, H), (0.5, 0.0), (0.5, -H), (0.5, float("nan")), (float("nan"), H), (0.5, 1e300)):
        assert one.step(point, size) == ERROR
    hidden = int(fmu.variables["w"]["valueReference"]) + 1
    for reference in (hidden, 9999, 2**32 - 1):
        values = (c_double * 1)()
        assert one.call("GetFloat64", (c_uint32 * 1)(reference), c_size_t(1), values, c_size_t(1)) == ERROR
    assert one.call("GetFloat64", (c_uint32 * 1)(1), c_size_t(1), (c_double * 2)(), c_size_t(2)) == ERROR
    assert one.call("SetFMUState", c_void_p()) == ERROR
    assert all(status == ERROR and category == b"logStatusError" for status, category, _ in one.log)
    assert len({message for *_, message in one.log}) > 10
    for name in NEVER_CALLED:
        assert one.call(name, *[c_void_p()] * 8) == ERROR
        assert f"fmi3{name}" in one.log[-1][2]
    assert one.call("GetBoolean", None, c_size_t(0), None, c_size_t(0)) == OK
    one.call("FreeInstance")


@pytest.mark.second
def test_initial_states_far_off_their_constraints_are_rejected(tmp_path):
    fmu = Fmu(sc.generate_fmu(rod(), tmp_path / "rod.fmu"), tmp_path / "unpacked")
    near, far = Slave(fmu), Slave(fmu)
    assert near.start(0.0, x=1.001) == OK
    assert_allclose(np.hypot(*near.get("x", "y")), 1.0, rtol=1e-15)
    assert far.start(0.0, x=1.5) == ERROR
    assert "violate the constraints" in far.log[-1][2]


def test_description_has_the_elements_required_by_the_standard(fmu):
    root = fmu.description
    assert [part.tag for part in root] == [
        *("CoSimulation", "LogCategories", "DefaultExperiment", "ModelVariables", "ModelStructure")
    ]
    assert root.get("modelName") == 'pushed pendulum <&> "friends"'
    assert (root.get("fmiVersion"), root.find("CoSimulation").get("modelIdentifier")) == ("3.0", "pushed")
    assert root.find("CoSimulation").get("fixedInternalStepSize") == repr(H)
    assert root.find("DefaultExperiment").attrib == {"startTime": "0.5", "stopTime": "2.8", "stepSize": "0.1"}
    assert list(fmu.variables) == ["t", "q", "q_dot", "p_q", "energy", "c", "m", "w", "u"]
    references = [one["valueReference"] for one in fmu.variables.values()]
    assert len(set(references)) == len(references)
    kinds = {name: (one["causality"], one["variability"], one.get("initial")) for name, one in fmu.variables.items()}
    assert kinds["t"] == ("independent", "continuous", None)
    assert kinds["q"] == kinds["q_dot"] == ("output", "continuous", "exact")
    assert kinds["p_q"] == kinds["energy"] == ("output", "continuous", "calculated")
    assert (kinds["c"], kinds["u"]) == (("parameter", "tunable", None), ("input", "continuous", None))
    starts = {name: one["start"] for name, one in fmu.variables.items() if "start" in one}
    assert starts == {"q": "0.3", "q_dot": "0.5", "c": "0.2", "m": "1.5", "w": "0.0", "u": "0.0"}
    outputs, unknown = ([one.get("valueReference") for one in root.iter(kind)] for kind in ("Output", "InitialUnknown"))
    assert outputs == references[1:5]
    assert unknown == references[3:5]


@pytest.mark.second
def test_model_with_initial_momenta_starts_with_them(tmp_path):
    fmu = Fmu(sc.generate_fmu(pushed(p=(0.4,)), tmp_path / "by_momenta.fmu"), tmp_path / "unpacked")
    assert (fmu.variables["p_q"]["start"], fmu.variables["q_dot"]["initial"]) == ("0.4", "calculated")
    one = Slave(fmu)
    assert one.set(q_dot=1.0) == ERROR
    assert one.start(0.5, p_q=3.0) == OK
    assert one.get("q_dot") == [2.0]


@pytest.mark.rotated
def test_archive_is_reproducible_and_contains_all_sources(tmp_path):
    first, second = (sc.generate_fmu(pushed(), part / "push.fmu") for part in _folders(tmp_path, "a", "b"))
    assert first.read_bytes() == second.read_bytes()
    folder = tmp_path / "unpacked"
    zipfile.ZipFile(first).extractall(folder)
    build = ElementTree.parse(folder / "sources" / "buildDescription.xml").getroot()
    names = [one.get("name") for one in build.iter("SourceFile")]
    assert names == ["push.c", "push_fmu.c"]
    for name in names:
        subprocess.run(["cc", *STRICT, name, "-o", f"{name}.o"], cwd=folder / "sources", check=True)
    linked = ["cc", *STRICT, "-DFMI3_FUNCTION_PREFIX=push_", "push_fmu.c", "-o", "prefixed.o"]
    subprocess.run(linked, cwd=folder / "sources", check=True)
    assert b"push_fmi3DoStep" in (folder / "sources" / "prefixed.o").read_bytes()
    for name in ("push_fmu.c", "push_fmu.h"):
        check_style((folder / "sources" / name).read_text())
    assert (
        "h = 0.1" in (folder / "resources" / "model.toml").read_text()
        or "step = 0.1" in (folder / "resources" / "model.toml").read_text()
    )


def _folders(root, *names):
    for name in names:
        (root / name).mkdir()
        yield root / name


@pytest.mark.rotated
def test_unsuitable_models_and_names_are_rejected(tmp_path):
    model = pushed()
    for wrong, words in (
        (replace(model, h=None, tolerance=1e-6), "fixed step size"),
        (replace(model, h=-0.1), "must be positive"),
        (
            replace(sc.Model.from_problem(sc.problem("kepler"), sc.SVI(4)), time_transformation="distance"),
            "without a time transformation",
        ),
    ):
        with pytest.raises(sc.ModelFileError, match=words):
            sc.generate_fmu(wrong, tmp_path / "push.fmu")
    clocked = sc.reparametrise(sc.problem("kepler").system, "distance")
    entry = sc.problem("kepler")
    with pytest.raises(sc.ModelFileError, match="time transformation"):
        sc.generate_fmu(
            replace(model, system=clocked, q=entry.q, velocity=entry.velocity, t=0.0), tmp_path / "push.fmu"
        )
    for name in ("pendulum", "Pendulum.fmu", "while.fmu"):
        with pytest.raises(sc.PackageError):
            sc.generate_fmu(model, tmp_path / name)
    (tmp_path / "mine.fmu").write_text("mine")
    with pytest.raises(sc.PackageError, match="is not an FMU"):
        sc.generate_fmu(model, tmp_path / "mine.fmu")
    assert (tmp_path / "mine.fmu").read_text() == "mine"
    for _ in range(2):
        assert zipfile.is_zipfile(sc.generate_fmu(model, tmp_path / "mine.fmu", force=True))
    with pytest.raises(sc.PackageError, match="cannot be written"):
        sc.generate_fmu(model, tmp_path / "missing" / "push.fmu")


class TestPlatforms:
    """Libraries for other machines, by the cross compiler of the extra ``compiler``."""

    @pytest.mark.second
    def test_each_platform_has_its_folder(self, tmp_path, monkeypatch):
        monkeypatch.setattr(fmu_module, "library_for", lambda name, source, *, flags: f"{name} {flags}".encode())
        here = fmu_module._this_platform()
        path = sc.generate_fmu(pushed(), tmp_path / "push.fmu", platforms=tuple(TARGETS))
        archive = zipfile.ZipFile(path)
        found = {name for name in archive.namelist() if name.startswith("binaries")}
        ends = {"windows": ".dll", "darwin": ".dylib", "linux": ".so"}
        assert found == {f"binaries/{name}/push{ends[name.partition('-')[2]]}" for name in {*TARGETS, here}}
        assert {entry.external_attr >> 16 for entry in archive.infolist()} == {0o100644}
        assert archive.read("binaries/aarch64-windows/push.dll") == f"aarch64-windows {PORTABLE_FLAGS}".encode()

    def test_unknown_or_unbuildable_platforms_are_reported_without_files(self, tmp_path, monkeypatch):
        with pytest.raises(sc.PackageError, match=r"'windows' is not a platform .* x86_64-windows"):
            sc.generate_fmu(pushed(), tmp_path / "push.fmu", platforms=("windows",))
        monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
        with pytest.raises(sc.BuildError, match=r"for aarch64-windows .* pip install 'scvi-codegen\[compiler\]'"):
            sc.generate_fmu(pushed(), tmp_path / "push.fmu", platforms=("aarch64-windows",))
        words = ("generate", "kepler", "--platform", "x86_64-windows", "-o", tmp_path / "kepler")
        assert "--platform requires --fmu" in error_of(*words)
        assert list(tmp_path.iterdir()) == []

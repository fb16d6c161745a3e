"""Runs in a folder: whatever ends the process, nothing written is lost or torn, and the run goes on bit for bit."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import random
import shutil
import signal
import subprocess
import sys
import time
import tracemalloc
import warnings
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner

from scvi_codegen import building, export
from scvi_codegen.binding import SolverOptions
from scvi_codegen.cli import main
from scvi_codegen.errors import MissingLibraryError, RecordingError, RecordingWarning, StateError, StepFailedError
from scvi_codegen.methods import SVI, Gauss, StoermerVerlet
from scvi_codegen.model_file import Model, dump_model
from scvi_codegen.problems import problem
from scvi_codegen.recording import RecordedRun, load_run, record_run, resume_run
from scvi_codegen.run import Run
from scvi_codegen.stepper import Stepper
from scvi_codegen.trajectory import Trajectory

COLUMNS = ("t", "q", "p", "iterations")
STATE = {"q": [0.5, 0.0], "p": [0.0, 1.7]}
H = 0.05


@pytest.fixture(scope="session")
def kepler(compiled) -> Stepper:
    return compiled("kepler", SVI(4))


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(tmp_path)
    return


def start(stepper: Stepper, **settings: object) -> Run:
    return stepper.start(**STATE, h=H, **settings)


def recorded(stepper: Stepper, steps: int = 1000, *, folder: str = "a.run", **settings: object) -> RecordedRun:
    return record_run(start(stepper), folder, steps=steps, **{"rows": 64} | settings)


def digests(folder: str | Path) -> dict[str, str]:
    """Of every file with states, to the byte."""
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(Path(folder).glob("states-*"))}


def assert_same(one: RecordedRun | Trajectory, other: RecordedRun | Trajectory) -> None:
    for column in COLUMNS:
        np.testing.assert_array_equal(np.asarray(getattr(one, column)), np.asarray(getattr(other, column)))


class StopsAfter:
    """Says stop when it was asked so often."""

    def __init__(self, looks: int) -> None:
        self.looks = looks

    def __call__(self) -> bool:
        self.looks -= 1
        return self.looks < 0


class TestRecording:
    @pytest.mark.parametrize("every", [1, 7, 5000])
    def test_a_recorded_run_is_the_one_in_memory(self, kepler, every):
        found = recorded(kepler, 1001, every=every)
        assert_same(found, kepler.integrate(**STATE, h=H, steps=1001, every=every))
        assert (found.steps, found.finished, len(found)) == (1001, True, 1001 // every + 1)
        assert len(list(Path("a.run").iterdir())) == 1 + -(-len(found) // 64)

    def test_files_are_full_but_the_last(self, kepler):
        found = recorded(kepler, 1001, rows=100)
        assert [len(piece) for piece in found.pieces()] == [100] * 10 + [2]

    @pytest.mark.parametrize("method", [SVI(4), Gauss(2), StoermerVerlet()], ids=lambda method: method.name)
    @pytest.mark.parametrize("every", [1, 40, 400])
    def test_an_interrupted_run_has_the_bytes_of_one_that_was_not(self, compiled, method, every):
        stepper = compiled("kepler", method)
        recorded(stepper, 600, every=every, folder="whole.run")
        found, looks = recorded(stepper, 600, every=every, stop=StopsAfter(0), checkpoint_steps=31), 1
        while not found.finished:
            found, looks = resume_run("a.run", stop=StopsAfter(looks), checkpoint_steps=37), looks + 1
        assert looks > 3
        assert digests("a.run") == digests("whole.run")

    def test_options_and_parameters_are_kept(self, kepler):
        settings = {"parameters": {"mu": 1.1}, "options": SolverOptions(tolerance=1e-9), "t": 3.0}
        whole = kepler.integrate(**STATE, h=H, steps=300, **settings)
        record_run(start(kepler, **settings), "a.run", steps=300, rows=64, stop=StopsAfter(2))
        found = resume_run("a.run")
        assert_same(found, whole)
        assert found.manifest.options == settings["options"]
        assert found[:3].parameters == [1.1]

    def test_a_run_may_be_made_longer(self, kepler):
        recorded(kepler, 500)
        assert not resume_run("a.run", steps=900, stop=StopsAfter(0)).finished
        assert_same(resume_run("a.run"), kepler.integrate(**STATE, h=H, steps=900))

    def test_resuming_a_finished_run_changes_nothing(self, kepler):
        recorded(kepler, 500)
        before = digests("a.run")
        assert resume_run("a.run").finished
        assert digests("a.run") == before

    def test_checkpoints_come_by_steps(self, kepler):
        seen = []
        recorded(kepler, 100, checkpoint_steps=25, progress=lambda done: seen.append((done, load_run("a.run").steps)))
        assert {25, 50, 75, 100} <= {done for done, _ in seen}
        assert all(written >= done - done % 25 for done, written in seen)

    def test_the_manifest_says_what_runs(self, kepler):
        text = dump_model(Model.from_problem(problem("kepler")))
        found = recorded(kepler, 10, model=text, certificate={"symplectic": True})
        about = json.loads(Path("a.run/manifest.json").read_text())
        assert about["source"]["code"] == kepler.source.code.split("\n")
        assert about["certificate"] == {"symplectic": True}
        assert (about["model"], about["steps"], about["builds"][0]["step"]) == (text, 10, 0)
        assert found.manifest.about()["method"] == kepler.interface.method

    def test_a_certificate_is_a_file_or_an_object_too(self, kepler):
        Path("c.json").write_text('{"order": 8}')
        assert recorded(kepler, 1, certificate="c.json").manifest.certificate == {"order": 8}
        given = SimpleNamespace(to_json=lambda: '{"order": 4}')
        assert recorded(kepler, 1, certificate=given, folder="b.run").manifest.certificate == {"order": 4}
        for wrong in ("none.json", {1, 2}):
            with pytest.raises(StateError, match="the certificate"):
                recorded(kepler, 1, certificate=wrong, folder="c.run")

    def test_memory_does_not_grow_with_the_length(self, kepler):
        recorded(kepler, 10, folder="first.run")  # what is imported on the way is not counted
        tracemalloc.start()
        found = recorded(kepler, 100_000, rows=2000)
        sum(len(piece) for piece in found.pieces())
        found.save("a.npz")
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 1.5e6 < 100_000 * (8 * 5 + 4)

    def test_another_compiler_or_processor_is_told_and_kept(self, kepler, monkeypatch):
        recorded(kepler, 500, stop=StopsAfter(3))
        step = load_run("a.run").steps
        monkeypatch.setattr(building, "fingerprint", lambda source, flags: "another")
        with pytest.warns(RecordingWarning, match=f"from step {step} on other code runs"):
            resume_run("a.run", steps=600)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = resume_run("a.run", steps=700)
        assert [build.step for build in found.manifest.builds] == [0, step]

    @pytest.mark.parametrize(
        ("settings", "message"),
        [
            ({"every": 0}, "every must be at least 1"),
            ({"steps": -1}, "steps must be at least 0"),
            ({"rows": 0}, "rows must be at least 1"),
            ({"checkpoint_seconds": float("nan")}, "checkpoint_seconds"),
            ({"checkpoint_steps": 0}, "checkpoint_steps must be at least 1"),
        ],
        ids=str,
    )
    def test_wrong_numbers_are_named_before_anything_is_written(self, kepler, settings, message):
        with pytest.raises(StateError, match=message):
            record_run(start(kepler), "a.run", **{"steps": 3} | settings)
        assert not Path("a.run").exists()

    def test_a_run_under_way_is_refused(self, kepler):
        run = start(kepler)
        run.record(3)
        with pytest.raises(StateError, match="from its start, but this one has 3 steps"):
            record_run(run, "a.run", steps=3)


class TestFolders:
    def test_a_folder_with_a_run_is_not_overwritten(self, kepler):
        recorded(kepler, 10)
        before = digests("a.run")
        with pytest.raises(RecordingError, match=r"holds a run already: go on with it .*--resume a\.run"):
            recorded(kepler, 10)
        assert digests("a.run") == before

    def test_a_folder_of_something_else_is_left_alone(self, kepler):
        Path("a.run").mkdir()
        Path("a.run/thesis.tex").touch()
        with pytest.raises(RecordingError, match="is not empty"):
            recorded(kepler, 10)
        assert [path.name for path in Path("a.run").iterdir()] == ["thesis.tex"]

    def test_what_a_process_left_that_was_killed_at_once_is_no_obstacle(self, kepler):
        Path("a.run").mkdir()
        for name in ("states-000000.npz", ".states-000000.npz.x1y2", ".manifest.json.x1y2"):
            Path("a.run", name).write_text("torn")
        assert recorded(kepler, 10).finished
        assert sorted(os.listdir("a.run")) == ["manifest.json", "states-000000.npz"]  # noqa: PTH208  (hidden ones too)

    def test_a_folder_without_a_run_is_named(self, kepler):
        for act in (load_run, resume_run):
            with pytest.raises(RecordingError, match=r"'none\.run' holds no recorded run"):
                act("none.run")
        with pytest.raises(RecordingError, match="nothing was recorded"):
            recorded(kepler, 10, folder="no/such/a.run")

    @pytest.mark.parametrize("damage", ["flip", "truncate", "empty", "remove", "remove last"])
    def test_damage_is_found(self, kepler, damage):
        recorded(kepler, 300)
        path = Path("a.run/states-000001.npz")
        data = path.read_bytes()
        if damage == "flip":
            path.write_bytes(data[:1000] + bytes([data[1000] ^ 1]) + data[1001:])
        elif damage == "remove last":
            for path in Path("a.run").glob("states-*"):
                path.unlink()
        elif damage == "remove":
            path.unlink()
        else:
            path.write_bytes(data[:500] if damage == "truncate" else b"")
        with pytest.raises(RecordingError, match=r"states-000001\.npz'|holds no states"):
            np.asarray(load_run("a.run").q)

    @pytest.mark.parametrize("text", ["", "{", "[]", '{"format": 99}', '{"format": 1}'])
    def test_a_damaged_manifest_is_named(self, kepler, text):
        recorded(kepler, 10)
        Path("a.run/manifest.json").write_text(text)
        with pytest.raises(RecordingError, match=r"manifest\.json' is damaged"):
            resume_run("a.run")

    def test_two_processes_do_not_record_into_one_folder(self, kepler):
        def second(done: int) -> None:
            with pytest.raises(RecordingError, match=r"another process is recording into 'a\.run'"):
                resume_run("a.run")

        assert recorded(kepler, 500, progress=second).finished


class TestReading:
    @pytest.fixture
    def pair(self, kepler) -> tuple[RecordedRun, Trajectory]:
        return recorded(kepler, 300), kepler.integrate(**STATE, h=H, steps=300)

    @pytest.mark.parametrize(
        "index",
        [
            0,
            -1,
            64,
            np.int64(200),
            slice(None),
            slice(60, 70),
            slice(None, None, -13),
            slice(5, 5),
            [3, 250, 3, -1],
            np.arange(301) % 7 == 0,
            [],
        ],
        ids=str,
    )
    def test_columns_are_indexed_like_arrays(self, pair, index):
        lazy, whole = pair
        for column in COLUMNS:
            np.testing.assert_array_equal(getattr(lazy, column)[index], getattr(whole, column)[index])
        np.testing.assert_array_equal(lazy.q[index, 1], whole.q[index, 1])
        np.testing.assert_array_equal(lazy.q[index, ::-1], whole.q[index, ::-1])

    @pytest.mark.parametrize("index", [301, -302, [0, 301], np.ones(5, dtype=bool), [0.5], "t"], ids=str)
    def test_rows_that_are_not_there_are_named(self, pair, index):
        with pytest.raises(IndexError):
            pair[0].q[index]

    def test_columns_pass_for_arrays(self, pair):
        lazy, whole = pair
        assert (lazy.q.shape, lazy.q.ndim, lazy.iterations.dtype, len(lazy.t)) == ((301, 2), 2, np.int32, 301)
        assert np.abs(lazy.p).max() == np.abs(whole.p).max()
        np.testing.assert_array_equal(list(lazy.t), whole.t)
        dask = pytest.importorskip("dask.array")
        blocks = dask.from_array(lazy.q, chunks=lazy.q.chunks)
        assert blocks.numblocks == (5, 1)
        assert blocks.sum(axis=0).compute(scheduler="sync") == pytest.approx(whole.q.sum(axis=0))

    def test_slices_are_trajectories(self, pair):
        lazy, whole = pair
        np.testing.assert_array_equal(lazy[100:200:7].energy(), whole.energy()[100:200:7])
        np.testing.assert_array_equal(lazy.energy(), whole.energy())
        with pytest.raises(TypeError, match="indexed by slices"):
            lazy[3]

    def test_a_run_under_way_can_be_read(self, kepler):
        lengths = []

        def look(done: int) -> None:
            lengths.append(len(np.asarray(load_run("a.run").q)))

        recorded(kepler, 2000, checkpoint_steps=50, progress=look)
        assert lengths == sorted(lengths)
        assert lengths[-1] > lengths[0]


class TestFiles:
    @pytest.fixture(params=["recorded", "in memory"])
    def saved(self, request, kepler) -> tuple[RecordedRun | Trajectory, Trajectory]:
        whole = kepler.integrate(**STATE, h=H, steps=300)
        return (recorded(kepler, 300, certificate={"order": 8}) if request.param == "recorded" else whole), whole

    def test_npz(self, saved):
        given, whole = saved
        given.save("a.npz")
        with np.load("a.npz") as file:
            assert_same(SimpleNamespace(**{name: file[name] for name in COLUMNS}), whole)
            assert list(file["coordinates"]) == ["q1", "q2"]
            assert (file["h"], file["parameters"], file["parameter_names"]) == (H, [1.0], ["mu"])
            assert str(file["title"]) == whole.stepper.title
            assert ("certificate" in file) == isinstance(given, RecordedRun)

    def test_csv(self, saved):
        given, whole = saved
        given.save("a.csv")
        assert Path("a.csv").read_text().splitlines()[0] == "t,q1,q2,p_q1,p_q2,iterations"
        table = np.loadtxt("a.csv", delimiter=",", skiprows=1)
        np.testing.assert_array_equal(table, np.column_stack([whole.t, whole.q, whole.p, whole.iterations]))

    def test_hdf5(self, saved):
        h5py = pytest.importorskip("h5py")
        given, whole = saved
        given.save("a.h5")
        with h5py.File("a.h5") as file:
            assert_same(SimpleNamespace(**{name: file[name][:] for name in COLUMNS}), whole)
            assert file.attrs["title"] == whole.stepper.title
            assert json.loads(file.attrs["parameters"]) == {"mu": 1.0}
            assert file["q"].dims[1][0][:].tolist() == [b"q1", b"q2"]
            assert ("certificate" in file.attrs) == isinstance(given, RecordedRun)

    def test_zarr_as_xarray_reads_it(self, saved):
        pytest.importorskip("zarr")
        xarray = pytest.importorskip("xarray")
        given, whole = saved
        for _ in range(2):  # the second replaces the first
            given.save("a.zarr")
        dataset = xarray.open_zarr("a.zarr")
        assert_same(SimpleNamespace(**{name: dataset[name].values for name in COLUMNS}), whole)
        assert (dataset.q.dims, list(dataset.coordinate)) == (("t", "coordinate"), ["q1", "q2"])
        assert dataset.attrs["method"] == whole.stepper.interface.method

    def test_tables(self, kepler):
        pytest.importorskip("xarray")
        pytest.importorskip("pandas")
        run = kepler.integrate(**STATE, h=H, steps=30)
        dataset, frame = run.to_xarray(), run.to_dataframe()
        np.testing.assert_array_equal(dataset.p.sel(coordinate="q2"), run.p[:, 1])
        np.testing.assert_array_equal(frame["p_q2"], run.p[:, 1])
        np.testing.assert_array_equal(frame.index, run.t)
        assert dataset.attrs == frame.attrs
        assert dataset.attrs["h"] == H

    def test_a_missing_library_is_named_with_its_extra(self, kepler, monkeypatch):
        run = kepler.integrate(**STATE, h=H, steps=3)
        monkeypatch.setitem(export.LIBRARIES, ".h5", "no_such_library")
        monkeypatch.setitem(sys.modules, "xarray", None)
        with pytest.raises(MissingLibraryError, match=r"no_such_library, .* pip install 'scvi-codegen\[data\]'"):
            run.save("a.h5")
        with pytest.raises(MissingLibraryError, match=r"xarray, .*scvi-codegen\[data\]"):
            run.to_xarray()
        assert list(Path().iterdir()) == []

    def test_a_folder_of_something_else_is_not_replaced(self, kepler):
        pytest.importorskip("zarr")
        Path("a.zarr").mkdir()
        with pytest.raises(StateError, match="a folder with something else in it"):
            kepler.integrate(**STATE, h=H, steps=3).save("a.zarr")

    def test_a_file_that_cannot_be_finished_leaves_the_old_one(self, kepler, monkeypatch):
        run = kepler.integrate(**STATE, h=H, steps=3)
        run.save("a.npz")
        before = Path("a.npz").read_bytes()

        def fails(states: object, path: Path) -> None:
            path.write_text("half")
            raise OSError(28, "No space left on device")

        monkeypatch.setitem(export.WRITERS, ".npz", fails)
        with pytest.raises(OSError, match="No space left"):
            run.save("a.npz")
        assert [path.name for path in Path().iterdir()] == ["a.npz"]
        assert Path("a.npz").read_bytes() == before


# The ends a process can meet.

CHILD = """
import os, pickle, resource, sys
from pathlib import Path
from scvi_codegen.recording import record_run, resume_run
stepper = pickle.loads(Path("stepper").read_bytes())
settings = dict(checkpoint_seconds={seconds}, progress=lambda done: print(done, flush=True))
{before}
if Path("a.run/manifest.json").exists():
    resume_run("a.run", **settings)
else:
    run = stepper.start([0.5, 0.0], [0.0, 1.7], h=0.05)
    record_run(run, "a.run", steps=10**12, every=20, rows={rows}, **settings)
"""


def child(stepper: Stepper, *, before: str = "", seconds: float = 0.01, rows: int = 5000) -> subprocess.Popen[str]:
    """A process that records, or goes on, printing the number of steps done; ``before`` it does something else."""
    Path("stepper").write_bytes(pickle.dumps(stepper))
    command = [sys.executable, "-c", CHILD.format(before=before, seconds=seconds, rows=rows)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def assert_whole(stepper: Stepper, *, further: int = 1000) -> None:
    """The run goes on, and has the bytes of one that was never interrupted."""
    steps, rows = load_run("a.run").steps + further, load_run("a.run").manifest.rows
    resume_run("a.run", steps=steps)
    shutil.rmtree("whole.run", ignore_errors=True)
    record_run(start(stepper), "whole.run", steps=steps, every=20, rows=rows)
    assert digests("a.run") == digests("whole.run")
    assert {path.name for path in Path("a.run").iterdir()} == {path.name for path in Path("whole.run").iterdir()}


def states_files() -> set[tuple[str, int]]:
    """Names and times of what lies in the folder."""
    found = set()
    for path in Path("a.run").glob("states-*.npz"):
        with suppress(FileNotFoundError):
            found.add((path.name, path.stat().st_mtime_ns))
    return found


def killed_at_random(stepper: Stepper, times: int, generator: random.Random) -> list[int]:
    """Step numbers in the folder after each kill; before there is a manifest, -1."""
    steps = []
    for _ in range(times):
        before, patient = states_files(), generator.random() < 0.7
        with child(stepper) as process:
            while patient and states_files() == before and process.poll() is None:
                time.sleep(0.01)  # until it has written something
            time.sleep(generator.uniform(0.0, 0.4))
            process.kill()
        assert process.returncode == -signal.SIGKILL
        steps.append(-1)
        if Path("a.run/manifest.json").exists():
            found = load_run("a.run")
            assert sum(len(piece) for piece in found.pieces()) == len(found) == found.steps // 20 + 1
            steps[-1] = found.steps
    return steps


@pytest.mark.parametrize("times", [5, pytest.param(100, marks=pytest.mark.full)])
def test_a_run_killed_at_random_moments_goes_on(kepler, times):
    steps = killed_at_random(kepler, times, random.Random(times))
    assert steps == sorted(steps)
    assert len(set(steps)) > times / 3
    assert_whole(kepler)


def test_a_file_that_may_not_grow_is_told_with_where_the_run_stands(kepler):
    limit = "resource.setrlimit(resource.RLIMIT_FSIZE, (150_000, resource.RLIM_INFINITY))"
    with child(kepler, before=limit) as process:
        _, stderr = process.communicate(timeout=60)
    last, steps = stderr.splitlines()[-1], load_run("a.run").steps
    assert "RecordingError: 'a.run' cannot be written: File too large. " in last
    assert f"It holds the run whole up to step {steps} (t = {steps * H:g})" in last
    assert "go on with 'scvi-codegen run --resume a.run' or resume_run" in last
    assert steps > 0
    assert_whole(kepler)


@pytest.fixture
def small_disk(tmp_path) -> Iterator[Path]:
    """A disk of 400 kB, where one can be made."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=400k", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("no disk can be mounted here")
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def test_a_full_disk_loses_nothing_and_the_run_goes_on_when_there_is_room(kepler, small_disk):
    folder = small_disk / "a.run"
    with pytest.raises(RecordingError, match=r"No space left on device\. It holds the run whole up to step") as error:
        recorded(kepler, 10**9, folder=str(folder), rows=2000)
    steps = load_run(folder).steps
    assert f"up to step {steps} " in str(error.value)
    shutil.copytree(folder, "a.run")
    resume_run("a.run", steps=steps + 5000)
    recorded(kepler, steps + 5000, folder="whole.run", rows=2000)
    assert digests("a.run") == digests("whole.run")


@pytest.mark.parametrize("suffix", ["npz", "csv", "h5", "zarr"])
def test_a_file_for_which_there_is_no_room_leaves_the_old_one_and_nothing_else(kepler, small_disk, suffix):
    pytest.importorskip({"h5": "h5py", "zarr": "zarr"}.get(suffix, "numpy"))
    path = small_disk / f"a.{suffix}"
    kepler.integrate(**STATE, h=H, steps=30).save(path)
    before = {file: file.read_bytes() for file in small_disk.rglob("*") if file.is_file()}
    with pytest.raises(OSError, match=rf"No space left on device: nothing was written.*a\.{suffix}'"):
        kepler.integrate(**STATE, h=H, steps=100_000).save(path)
    assert {file: file.read_bytes() for file in small_disk.rglob("*") if file.is_file()} == before


WITHOUT_RIGHTS = """
for path in (*Path("a.run").iterdir(), Path("a.run"), Path()):
    path.chmod(0o555 if path.is_dir() else 0o444)
"zip".encode("cp437")  # loaded now: the interpreter's own files may be out of reach afterwards
if os.geteuid() == 0:
    os.setegid(65534)
    os.seteuid(65534)
"""


def test_a_folder_that_cannot_be_written_is_told_at_once(kepler, tmp_path):
    recorded(kepler, 100, every=20, rows=5000)
    before = digests("a.run")
    try:
        with child(kepler, before=WITHOUT_RIGHTS) as process:
            _, stderr = process.communicate(timeout=60)
    finally:
        for folder in (tmp_path, tmp_path / "a.run"):
            folder.chmod(0o755)
    assert "'a.run' cannot be written: Permission denied. It holds the run whole up to step 100 (t = 5)" in stderr
    assert digests("a.run") == before


def test_an_exception_on_the_way_loses_nothing(kepler):
    def interrupt(done: int) -> None:
        if done > 300:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        recorded(kepler, 10**9, rows=10**6, progress=interrupt)
    assert load_run("a.run").steps > 300
    assert_same(resume_run("a.run", steps=3000), kepler.integrate(**STATE, h=H, steps=3000))


def test_ctrl_c_at_any_time_loses_nothing(kepler):
    with child(kepler, seconds=1000.0, rows=10**6) as process:
        assert process.stdout is not None
        for _ in range(20):
            done = int(process.stdout.readline())
        process.send_signal(signal.SIGINT)
        _, stderr = process.communicate(timeout=60)
    assert stderr.splitlines()[-1] == "KeyboardInterrupt"
    assert load_run("a.run").steps >= done
    assert_whole(kepler)


def test_a_step_that_fails_leaves_the_states_before_it(compiled):
    stepper = compiled("runaway", SVI(4))
    run = stepper.start([1.0], [1.0], h=0.05)
    with pytest.raises(StepFailedError) as error:
        record_run(run, "a.run", steps=1000, rows=8)
    with pytest.raises(StepFailedError) as whole:
        stepper.integrate([1.0], [1.0], h=0.05, steps=1000)
    assert_same(load_run("a.run"), whole.value.recorded)
    assert load_run("a.run").steps == error.value.step == whole.value.step
    with pytest.raises(StepFailedError):
        resume_run("a.run")
    assert_same(load_run("a.run"), whole.value.recorded)


class TestCommandLine:
    @staticmethod
    def invoke(words: str, status: int = 0) -> str:
        result = CliRunner().invoke(main, words.split(), prog_name="scvi-codegen")
        assert result.exit_code == status, result.output
        return result.output

    def test_a_run_into_a_folder_and_further_and_out(self):
        text = self.invoke("run kepler --method stoermer-verlet --step 0.01 --steps 1000 --every 10 -o a.run")
        assert "1000 steps (all) of 0.01 from t = 0 to t = 10; 101 states kept in 'a.run'" in text
        assert "relative energy error" in text
        assert "wrote a.run" in text
        assert "holds a run already" in self.invoke("run kepler --method stoermer-verlet -o a.run", 1)
        text = self.invoke("run --resume a.run --span 20")
        assert "2000 steps (all)" in text
        self.invoke("run kepler --method stoermer-verlet --step 0.01 --steps 2000 --every 10 -o whole/")
        assert digests("a.run") == digests("whole")
        assert "201 states kept in 'a.run'" in self.invoke("export a.run")
        assert "wrote a.csv" in self.invoke("export a.run -o a.csv")
        assert len(Path("a.csv").read_text().splitlines()) == 202

    @pytest.mark.parametrize(
        ("words", "message", "status"),
        [
            ("run", "Missing argument 'MODEL', or --resume FOLDER", 2),
            ("run --resume none.run", "'none.run' holds no recorded run", 1),
            ("run kepler --resume none.run", "MODEL does not go with --resume", 2),
            ("run --resume none.run --step 0.1", "--step does not go with --resume", 2),
            ("run kepler -o a.run --plot a.png", "--plot is for a trajectory in memory", 2),
            ("run kepler -o a.npz --checkpoint 3", "--checkpoint is for a run that is written into a folder", 2),
            ("run kepler -o a.run --certificate none.json", "the certificate 'none.json' cannot be read", 2),
            ("run kepler -o no/a.run", "'no/a.run' cannot be written", 1),
            ("export none.run", "holds no recorded run", 1),
            ("export none.run -o a.xls", "not as 'a.xls'", 2),
        ],
    )
    def test_what_does_not_work_is_told(self, words, message, status):
        words = words.replace("kepler -o", "kepler --method stoermer-verlet --steps 10 -o")
        assert message in self.invoke(words, status)

    def test_ctrl_c_says_how_to_go_on(self):
        words = "run kepler --method stoermer-verlet --step 0.01 --steps 1000000000000 --every 100000 -o a.run"
        command = [sys.executable, "-m", "scvi_codegen", *words.split(), "--checkpoint", "0.1"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            while not Path("a.run/manifest.json").exists():
                time.sleep(0.05)
            time.sleep(0.3)
            process.send_signal(signal.SIGINT)
            stdout, stderr = process.communicate(timeout=60)
        assert process.returncode == 130
        assert "go on with: scvi-codegen run --resume a.run" in stderr
        assert f"{load_run('a.run').steps} steps (of 1000000000000)" in stdout

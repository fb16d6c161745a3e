"""Runs in a folder: what is in it, how it is read, continued and exported."""

import json
import os
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from recorded_runs import COLUMNS, STATE, H, StopsAfter, assert_same, digests, recorded, start
from samples import pushed_pendulum

import scvi_codegen as sc
from scvi_codegen.interfaces.models.model_files.model_file import dump_model
from scvi_codegen.runs.driver.run_loop import record
from scvi_codegen.runs.recording import manifest, writing
from scvi_codegen.runs.recording.manifest import sealed_text
from scvi_codegen.runs.results import export

pytestmark = pytest.mark.usefixtures("here")


class TestRecording:
    def test_all_files_but_the_last_are_full(self, kepler):
        found = recorded(kepler, 1001, rows=100)
        assert [len(piece) for piece in found.pieces()] == [100] * 10 + [2]

    @pytest.mark.parametrize("save_every", [1, 7])
    def test_steps_after_the_last_saved_state_are_recomputed(self, kepler, save_every, monkeypatch):
        """Ctrl-C between saved states: the run and its memory are beyond the last saved state."""
        recorded(kepler, 600, save_every=save_every, folder="whole.run")
        left = iter([*[False] * 5, True])

        def interrupted(run: sc.Run, steps: int | None = None, **settings: object) -> sc.Trajectory:
            made = record(run, steps, **settings)
            if next(left):
                raise KeyboardInterrupt
            return made

        with monkeypatch.context() as patch:
            patch.setattr(writing, "record", interrupted)
            with pytest.raises(KeyboardInterrupt):
                recorded(kepler, 600, save_every=save_every, checkpoint_seconds=1e9)
        found = sc.load_run("a.run")
        assert 0 < found.resumed().steps == found.steps < 600
        assert sc.resume_run("a.run").finished
        assert digests("a.run") == digests("whole.run")

    def test_resuming_a_finished_run_changes_nothing(self, kepler):
        recorded(kepler, 500)
        before = digests("a.run")
        assert sc.resume_run("a.run").finished
        assert digests("a.run") == before

    def test_manifest_describes_the_run(self, kepler):
        text = dump_model(sc.Model.from_problem(sc.problem("kepler")))
        found = recorded(kepler, 10, model=text)
        about = json.loads(Path("a.run/manifest.json").read_text())
        assert about["source"]["code"] == kepler.source.code.split("\n")
        assert (about["model"], about["steps"], about["builds"][0]["step"]) == (text, 10, 0)
        assert found.manifest.about()["method"] == kepler.interface.method

    def test_different_compiler_or_processor_is_reported_and_saved(self, kepler, monkeypatch):
        recorded(kepler, 500, stop=StopsAfter(3))
        step = sc.load_run("a.run").steps
        monkeypatch.setattr(manifest, "fingerprint", lambda source, flags: "another")
        with pytest.warns(sc.RecordingWarning, match=f"from step {step} on another build is used"):
            sc.resume_run("a.run", steps=600)
        with warnings.catch_warnings(action="error"):
            found = sc.resume_run("a.run", steps=700)
        assert [build.step for build in found.manifest.builds] == [0, step]

    @pytest.mark.parametrize(
        ("settings", "message"),
        [
            ({"save_every": 0}, "save_every must be at least 1"),
            ({"steps": -1}, "steps must be at least 0"),
            ({"rows": 0}, "rows must be at least 1"),
            ({"checkpoint_seconds": float("nan")}, "checkpoint_seconds"),
            ({"checkpoint_steps": 0}, "checkpoint_steps must be at least 1"),
        ],
        ids=str,
    )
    def test_invalid_numbers_are_named_before_writing(self, kepler, settings, message):
        with pytest.raises(sc.StateError, match=message):
            sc.record_run(start(kepler), "a.run", **{"steps": 3} | settings)
        assert not Path("a.run").exists()


class TestFolders:
    def test_a_folder_with_a_run_is_not_overwritten(self, kepler):
        recorded(kepler, 10)
        before = digests("a.run")
        with pytest.raises(sc.RecordingError, match=r"already contains a run: continue it .*--resume a\.run"):
            recorded(kepler, 10)
        assert digests("a.run") == before

    def test_foreign_folder_is_not_changed(self, kepler):
        Path("a.run").mkdir()
        Path("a.run/thesis.tex").touch()
        with pytest.raises(sc.RecordingError, match="is not empty"):
            recorded(kepler, 10)
        assert [path.name for path in Path("a.run").iterdir()] == ["thesis.tex"]

    def test_remains_of_a_killed_process_are_ignored(self, kepler):
        Path("a.run").mkdir()
        for name in ("states-000000.npz", ".states-000000.npz.x1y2", ".manifest.json.x1y2"):
            Path("a.run", name).write_text("torn")
        assert recorded(kepler, 10).finished
        assert sorted(os.listdir("a.run")) == ["manifest.json", "states-000000.npz"]  # noqa: PTH208  (hidden ones too)

    def test_folder_without_a_run_is_named(self, kepler):
        for act in (sc.load_run, sc.resume_run):
            with pytest.raises(sc.RecordingError, match=r"'none\.run' contains no recorded run"):
                act("none.run")
        with pytest.raises(sc.RecordingError, match="Nothing was recorded"):
            recorded(kepler, 10, folder="no/such/a.run")

    @pytest.mark.parametrize("damage", ["flip", "truncate", "empty", "remove", "remove last"])
    def test_damage_is_detected(self, kepler, damage):
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
        with pytest.raises(sc.RecordingError, match=r"states-000001\.npz'|contains no states"):
            np.asarray(sc.load_run("a.run").q)

    @pytest.mark.parametrize("text", ["", "{", "[]", '{"format": 99}', '{"format": 1}'])
    def test_a_damaged_manifest_is_named(self, kepler, text):
        recorded(kepler, 10)
        Path("a.run/manifest.json").write_text(text)
        with pytest.raises(sc.RecordingError, match=r"manifest\.json' is damaged"):
            sc.resume_run("a.run")

    @pytest.mark.parametrize(
        ("place", "value"),
        [
            (("source", "support", "../../outside.h"), ["int x;"]),
            (("source", "support", "support/../../outside.h"), ["int x;"]),
            (("source", "support", "/tmp/outside.h"), ["int x;"]),
            (("source", "support", "support/outside.txt"), ["x"]),
            (("source", "prefix"), "../outside"),
            (("source", "prefix"), "a b"),
            (("fallback", "prefix"), "../outside"),
            (("flags",), ["-O2", "-wrapper", "touch,outside"]),
            (("flags",), ["-fplugin=./outside.so"]),
            (("flags",), ["-Wl,-rpath,/tmp"]),
            (("flags",), ["-o/tmp/outside"]),
            (("flags",), ["@outside"]),
            (("flags",), ["-include", "outside"]),
        ],
    )
    def test_manifest_cannot_reference_other_folders(self, kepler, place, value, tmp_path):
        recorded(kepler, 10)
        path = Path("a.run/manifest.json")
        document = json.loads(path.read_text())
        inner = document
        for key in place[:-1]:
            inner = inner[key]
        inner[place[-1]] = value
        del document["sha256"]
        path.write_text(sealed_text(document))
        before = sorted(tmp_path.rglob("*"))
        for act in (lambda: sc.load_run("a.run")[0:3].energy(), lambda: sc.resume_run("a.run", steps=20)):
            with pytest.raises(sc.RecordingError, match=r"is not the name of a file|compiler flag .* is not allowed"):
                act()
        assert sorted(tmp_path.rglob("*")) == before

    def test_a_run_with_other_flags_is_not_recorded(self, kepler, monkeypatch):
        monkeypatch.setattr(kepler, "flags", (*kepler.flags, "-fplugin=x.so"))
        with pytest.raises(sc.StateError, match=r"'-fplugin=x\.so' is not allowed .* SCVI_CODEGEN_CFLAGS"):
            recorded(kepler, 10)

    def test_two_processes_do_not_record_into_one_folder(self, kepler):
        def second(done: int) -> None:
            with pytest.raises(sc.RecordingError, match=r"another process is recording into 'a\.run'"):
                sc.resume_run("a.run")

        assert recorded(kepler, 500, progress=second).finished


class TestReading:
    @pytest.fixture
    def pair(self, kepler) -> tuple[sc.RecordedRun, sc.Trajectory]:
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
    def test_rows_out_of_range_are_named(self, pair, index):
        with pytest.raises(IndexError):
            pair[0].q[index]

    def test_slices_are_trajectories(self, pair):
        lazy, whole = pair
        np.testing.assert_array_equal(lazy[100:200:7].energy(), whole.energy()[100:200:7])
        np.testing.assert_array_equal(lazy.energy(), whole.energy())
        for number in (3, -1):
            assert str(lazy[number]) == str(whole[number])
        with pytest.raises(TypeError, match="must be a whole number or a slice"):
            lazy[0.5]


class TestFiles:
    @pytest.fixture(params=["recorded", "in memory"])
    def saved(self, request, kepler) -> tuple[sc.RecordedRun | sc.Trajectory, sc.Trajectory]:
        whole = kepler.integrate(**STATE, h=H, steps=300)
        return (recorded(kepler, 300) if request.param == "recorded" else whole), whole

    def test_npz_round_trip(self, saved):
        given, whole = saved
        given.save("a.npz")
        with np.load("a.npz") as file:
            assert_same(SimpleNamespace(**{name: file[name] for name in COLUMNS}), whole)
            assert list(file["coordinates"]) == ["q1", "q2"]
            assert (file["h"], file["parameters"], file["parameter_names"]) == (H, [1.0], ["mu"])
            assert str(file["title"]) == whole.stepper.title

    @pytest.mark.tiers(0, 1)
    def test_zarr_is_read_by_xarray(self, saved):
        pytest.importorskip("zarr")
        xarray = pytest.importorskip("xarray")
        given, whole = saved
        for _ in range(2):  # the second replaces the first
            given.save("a.zarr")
        dataset = xarray.open_zarr("a.zarr")
        assert_same(SimpleNamespace(**{name: dataset[name].values for name in COLUMNS}), whole)
        assert (dataset.q.dims, list(dataset.coordinate)) == (("t", "coordinate"), ["q1", "q2"])
        assert dataset.attrs["method"] == whole.stepper.interface.method

    @pytest.mark.tiers(2, 2)
    @pytest.mark.parametrize("suffix", ["h5", "hdf5", "nc"])
    def test_hdf5_is_read_by_xarray(self, saved, suffix):
        pytest.importorskip("h5netcdf")
        xarray = pytest.importorskip("xarray")
        given, whole = saved
        given.save(f"a.{suffix}", units={"t": "day", "q": "au"})
        with xarray.open_dataset(f"a.{suffix}") as dataset:
            xarray.testing.assert_identical(
                dataset.drop_attrs().load(), whole.to_xarray(units={"t": "day", "q": "au"}).drop_attrs()
            )
            assert dataset.velocity.attrs == {"long_name": "velocity", "units": "au day-1"}
            assert (dataset.t.attrs["units"], dataset.p.attrs) == ("day", {"long_name": "momentum"})

    @pytest.mark.parametrize(("path", "units"), [("a.csv", {"t": "s"}), ("a.h5", {"h": "s"}), ("a.h5", {"t": 1})])
    def test_unsupported_units_are_rejected(self, kepler, path, units):
        with pytest.raises(sc.StateError, match="units"):
            kepler.integrate(**STATE, h=H, steps=3).save(path, units=units)

    def test_missing_library_is_named_with_its_extra(self, kepler, monkeypatch):
        run = kepler.integrate(**STATE, h=H, steps=3)
        monkeypatch.setitem(export.LABELLED, ".h5", export.Format(export.write_hdf5, "no_such_library"))
        monkeypatch.setitem(sys.modules, "xarray", None)
        with pytest.raises(sc.MissingLibraryError, match=r"no_such_library, .* pip install 'scvi-codegen\[data\]'"):
            run.save("a.h5")
        with pytest.raises(sc.MissingLibraryError, match=r"xarray, .*scvi-codegen\[data\]"):
            run.to_xarray()
        assert list(Path().iterdir()) == []

    def test_unfinished_file_preserves_the_old_one(self, kepler, monkeypatch):
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


@pytest.mark.parametrize("t_end", [60.0, -60.0])
def test_run_may_be_extended_or_shortened_but_not_reversed(kepler, t_end):
    sc.record_run(kepler.start(**STATE, t_end=t_end, tolerance=1e-10), "a.run", rows=64, save_every=3)
    longer = sc.resume_run("a.run", t_end=1.5 * t_end)
    assert longer.finished
    assert t_end in longer.t
    assert longer.t[-1] == 1.5 * t_end
    assert np.abs(longer.q[-1] - kepler.integrate(**STATE, t_end=1.5 * t_end).q[-1]).max() < 1e-6
    with pytest.raises(sc.StateError, match="beyond"):
        sc.resume_run("a.run", t_end=t_end)
    with pytest.raises(sc.StateError, match="steps requires a fixed step size"):
        sc.resume_run("a.run", steps=1000)
    assert sc.load_run("a.run").manifest == longer.manifest


def test_missing_inputs_leave_no_folder():
    stepper = sc.compile_stepper(pushed_pendulum(), sc.SVI(2))
    run = stepper.start([0.3], [0.0], h=0.1)
    with pytest.raises(sc.StateError, match=r"the input 'u' is not set.*only constant inputs"):
        sc.record_run(run, "pushed.run", steps=4)
    assert not Path("pushed.run").exists()
    run.set_inputs(u=0.5, w=0.0)
    assert len(sc.record_run(run, "pushed.run", steps=4)) == 5

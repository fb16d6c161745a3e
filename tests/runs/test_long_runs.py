"""Whatever ends the process, nothing written is lost or torn, and the run goes on bit for bit."""

import pickle
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from commands import error_of, output_of
from programs import needs
from recorded_runs import H, digests, recorded, start

import scvi_codegen as sc
from scvi_codegen.runs.recording import load_run

pytestmark = pytest.mark.usefixtures("here")

CHILD = """
import os, pickle, resource, sys
from pathlib import Path
from scvi_codegen.runs.recording import record_run, resume_run
stepper = pickle.loads(Path("stepper").read_bytes())
settings = dict(checkpoint_seconds={seconds}, progress=lambda done: print(done, flush=True))
{before}
if Path("a.run/manifest.json").exists():
    resume_run("a.run", **settings)
else:
    run = stepper.start([0.5, 0.0], [0.0, 1.7], h=0.05)
    record_run(run, "a.run", steps=10**12, save_every=20, rows={rows}, **settings)
"""


def child(stepper: sc.Stepper, *, before: str = "", seconds: float = 0.01, rows: int = 5000) -> subprocess.Popen[str]:
    """A process that records, or goes on, printing the number of steps done; ``before`` it does something else."""
    Path("stepper").write_bytes(pickle.dumps(stepper))
    command = [sys.executable, "-c", CHILD.format(before=before, seconds=seconds, rows=rows)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def assert_whole(stepper: sc.Stepper, *, further: int = 1000) -> None:
    """The run goes on, and has the bytes of one that was never interrupted."""
    steps, rows = load_run("a.run").steps + further, load_run("a.run").manifest.rows
    sc.resume_run("a.run", steps=steps)
    shutil.rmtree("whole.run", ignore_errors=True)
    sc.record_run(start(stepper), "whole.run", steps=steps, save_every=20, rows=rows)
    assert digests("a.run") == digests("whole.run")
    assert {path.name for path in Path("a.run").iterdir()} == {path.name for path in Path("whole.run").iterdir()}


def states_files() -> set[tuple[str, int]]:
    """Names and times of what lies in the folder."""
    found = set()
    for path in Path("a.run").glob("states-*.npz"):
        with suppress(FileNotFoundError):
            found.add((path.name, path.stat().st_mtime_ns))
    return found


def killed_at_random(stepper: sc.Stepper, times: int, generator: random.Random) -> list[int]:
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


@pytest.mark.rotated
@pytest.mark.parametrize("times", [5, pytest.param(100, marks=pytest.mark.full)])
def test_run_killed_at_random_times_continues(kepler, times):
    steps = killed_at_random(kepler, times, random.Random(times))
    assert steps == sorted(steps)
    assert len(set(steps)) > times / 3
    assert_whole(kepler)


@pytest.mark.rotated
def test_file_size_limit_is_reported_with_the_state_of_the_run(kepler):
    limit = "resource.setrlimit(resource.RLIMIT_FSIZE, (2_000_000, resource.RLIM_INFINITY))"  # above the manifest
    with child(kepler, before=limit, rows=80_000) as process:
        _, stderr = process.communicate(timeout=600)
    last, steps = stderr.splitlines()[-1], load_run("a.run").steps
    assert "RecordingError: 'a.run' cannot be written: File too large. " in last
    assert f"It contains the run up to step {steps} (t = {steps * H:g})" in last
    assert "continue with 'scvi-codegen run --resume a.run' or resume_run" in last
    assert steps > 0
    assert_whole(kepler)


@pytest.fixture
def small_disk(tmp_path) -> Iterator[Path]:
    """A disk of 1 MB, where one can be made: more than a manifest with its C source."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=1M", "tmpfs", str(folder)]
    needs("mount", "umount")
    if subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("no disk can be mounted here")
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def test_full_disk_loses_nothing_and_the_run_continues_later(kepler, small_disk):
    folder = small_disk / "a.run"
    with pytest.raises(sc.RecordingError, match=r"No space left on device\. It contains the run up to step") as error:
        recorded(kepler, 10**9, folder=str(folder), rows=2000)
    steps = load_run(folder).steps
    assert f"up to step {steps} " in str(error.value)
    shutil.copytree(folder, "a.run")
    sc.resume_run("a.run", steps=steps + 5000)
    recorded(kepler, steps + 5000, folder="whole.run", rows=2000)
    assert digests("a.run") == digests("whole.run")


WITHOUT_RIGHTS = """
for path in (*Path("a.run").iterdir(), Path("a.run"), Path()):
    path.chmod(0o555 if path.is_dir() else 0o444)
if os.geteuid() == 0:  # give up CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH, with which root ignores permissions
    import ctypes
    libc, header, data = ctypes.CDLL(None), (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
    assert libc.capget(header, data) == 0
    data[0] &= ~(1 << 1 | 1 << 2)
    assert libc.capset(header, data) == 0
"""


@pytest.mark.second
def test_unwritable_folder_is_reported_before_the_run(kepler, tmp_path):
    recorded(kepler, 100, save_every=20, rows=5000)
    before = digests("a.run")
    try:
        with child(kepler, before=WITHOUT_RIGHTS) as process:
            _, stderr = process.communicate(timeout=600)
    finally:
        for folder in (tmp_path, tmp_path / "a.run"):
            folder.chmod(0o755)
    assert "'a.run' cannot be written: Permission denied. It contains the run up to step 100 (t = 5)" in stderr
    assert digests("a.run") == before


class TestCommandLine:
    def test_command_line_records_extends_and_exports_a_run(self):
        text = output_of("run kepler --method stoermer-verlet --step 0.01 --steps 1000 --save-every 10 -o a.run")
        assert "1000 steps (all) of 0.01 from t = 0 to t = 10; 101 states saved in 'a.run'" in text
        assert "relative energy error" in text
        assert "wrote a.run" in text
        assert "already contains a run" in error_of("run kepler --method stoermer-verlet -o a.run", status=1)
        text = output_of("run --resume a.run --span 20")
        assert "2000 steps (all)" in text
        output_of("run kepler --method stoermer-verlet --step 0.01 --steps 2000 --save-every 10 -o whole/")
        assert digests("a.run") == digests("whole")
        assert "201 states saved in 'a.run'" in output_of("export a.run")
        assert "wrote a.csv" in output_of("export a.run -o a.csv")
        assert len(Path("a.csv").read_text().splitlines()) == 202

    @pytest.mark.parametrize(
        ("words", "message", "status"),
        [
            ("run", "Missing argument 'MODEL', or --resume FOLDER", 2),
            ("run --resume none.run", "'none.run' contains no recorded run", 1),
            ("run kepler --resume none.run", "MODEL is not allowed with --resume", 2),
            ("run --resume none.run --step 0.1", "--step is not allowed with --resume", 2),
            ("run kepler -o a.run --plot a.png", "--plot is not available for a run recorded in a folder", 2),
            ("run kepler -o a.npz --checkpoint 3", "--checkpoint requires a run recorded in a folder", 2),
            ("run kepler -o no/a.run", "'no/a.run' cannot be written", 1),
            ("export none.run", "contains no recorded run", 1),
            ("export none.run -o a.xls", "not as 'a.xls'", 2),
        ],
    )
    def test_command_line_reports_invalid_requests(self, words, message, status):
        words = words.replace("kepler -o", "kepler --method stoermer-verlet --steps 10 -o")
        assert message in error_of(words, status=status)

    @pytest.mark.rotated
    def test_interrupt_prints_how_to_continue(self):
        words = "run kepler --method stoermer-verlet --step 0.01 --steps 1000000000000 --save-every 100000 -o a.run"
        command = [sys.executable, "-m", "scvi_codegen", *words.split(), "--checkpoint", "0.1"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            while not Path("a.run/manifest.json").exists():
                time.sleep(0.05)
            time.sleep(0.3)
            process.send_signal(signal.SIGINT)
            stdout, stderr = process.communicate(timeout=600)
        assert process.returncode == 130
        assert "continue with: scvi-codegen run --resume a.run" in stderr
        assert f"{load_run('a.run').steps} steps (of 1000000000000)" in stdout

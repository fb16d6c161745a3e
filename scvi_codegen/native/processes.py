"""Child processes that end with their parent: compilers, with all the processes that they start."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from scvi_codegen.errors import BuildError

GUARDED = 'exec 3<&0 </dev/null; (read -r end <&3; kill -KILL 0) >/dev/null 2>&1 & exec 3<&-; exec "$@"'
"""Shell command that runs a program and kills its process group when the pipe from Python closes."""


@contextmanager
def running(command: Sequence[str], folder: Path) -> Iterator[subprocess.Popen[str]]:
    """Run a program in a folder during the block; kill it with its children at the end.

    Its temporary files are in the folder, too. A program that cannot be run has the status 126 or 127, as in a shell.
    Without POSIX only the program itself is killed, and not if Python is killed.
    """
    with (_guarded if os.name == "posix" else _alone)(command, folder) as process:
        yield process


def _started(command: Sequence[str], folder: Path, stdin: int, *, session: bool) -> subprocess.Popen[str]:
    return subprocess.Popen(
        command,
        cwd=folder,
        env={**os.environ, **dict.fromkeys(("TMPDIR", "TMP", "TEMP"), str(folder))},
        stdin=stdin,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        start_new_session=session,
    )


@contextmanager
def _guarded(command: Sequence[str], folder: Path) -> Iterator[subprocess.Popen[str]]:
    read_end, pipe = os.pipe()
    try:
        with _started(["/bin/sh", "-c", GUARDED, "sh", *command], folder, read_end, session=True) as process:
            try:
                yield process
            finally:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
    finally:
        os.close(read_end)
        os.close(pipe)


@contextmanager
def _alone(command: Sequence[str], folder: Path) -> Iterator[subprocess.Popen[str]]:
    try:
        started = _started(command, folder, subprocess.DEVNULL, session=False)
    except OSError as error:
        raise BuildError(f"the program {command[0]!r} does not run: {error}") from error
    with started as process:
        try:
            yield process
        finally:
            process.kill()

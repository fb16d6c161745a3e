"""Files of a recorded run: its states, and the manifest, everything except its states, in one JSON file."""

from __future__ import annotations

import hashlib
import io
import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.ir.variants import NewtonFallback
from scvi_codegen.codegen.native.arguments import checked_number
from scvi_codegen.codegen.native.compilers import check_flags, compiler_title, fingerprint
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.codegen.rendering.source import Interface, Source, check_interface
from scvi_codegen.common.atomic import read_text, regular, sync_folder, write_atomically, write_text
from scvi_codegen.common.errors import RecordingError
from scvi_codegen.common.once import constantly
from scvi_codegen.common.registry import part
from scvi_codegen.common.validation import checked_count
from scvi_codegen.runs.driver.run import Run
from scvi_codegen.runs.results.export import COLUMNS, Piece, loaded
from scvi_codegen.runs.states.layout import layout_of
from scvi_codegen.runs.states.words import Words, low_words, with_low
from scvi_codegen.runs.stepper import Stepper
from scvi_codegen.runs.stepping.compiled_method import Variants
from scvi_codegen.runs.stepping.integrator import Integrator
from scvi_codegen.runs.stepping.step_plan import Adaptive, Fixed, InTau, plan_from_record
from scvi_codegen.systems.event import Event
from scvi_codegen.version import __version__

NAME = re.compile(r"states-(\d{6,})\.npz")
UNFINISHED = re.compile(r"\.(states-\d{6,}\.npz|manifest\.json)\..+")
"""Names of temporary files that a killed process leaves."""


@dataclass(frozen=True, slots=True)
class Chunk:
    """Consecutive states, and a checkpoint after the last of them or some steps later.

    Attributes:
        piece: the states.
        step: number of steps at the checkpoint.
        memory: memory of the run, as returned by :meth:`Run.checkpoint`.
        crossings: (k, 2 + 2m) crossings of events in these steps: number of the event (plus the number of events
            times that of the element of its loops), t, q, p, with low words in double-double arithmetic.
    """

    piece: Piece
    step: int
    memory: bytes
    crossings: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.piece[0])


def no_states(interface: Interface) -> Piece:
    """Return an empty piece of states, with low words in double-double arithmetic."""
    layout = layout_of(interface)
    t, vectors = layout.missing((0,)), layout.missing((0, interface.dimension))
    return t, vectors, vectors, np.empty(0, dtype=np.int32)


def no_crossings(interface: Interface) -> NDArray[np.float64]:
    """Return an empty array of crossings."""
    none: NDArray[np.float64] = layout_of(interface).missing((0, 2 + 2 * interface.dimension))
    return none


def chunk_path(folder: Path, number: int) -> Path:
    """Return the path of a file of states, numbered from 0."""
    return folder / f"states-{number:06d}.npz"


def chunk_paths(folder: Path) -> list[Path]:
    """Return the existing files of states, in order; RecordingError if a file between them is missing."""
    numbers = sorted(int(match[1]) for path in folder.iterdir() if (match := NAME.fullmatch(path.name)))
    for expected, number in enumerate(numbers):
        if number != expected:
            raise RecordingError(f"'{chunk_path(folder, expected)}' is missing: restore it, later files depend on it")
    return [chunk_path(folder, number) for number in numbers]


def unfinished(folder: Path) -> list[Path]:
    """Return the temporary files that killed processes left."""
    return [path for path in folder.iterdir() if UNFINISHED.fullmatch(path.name)]


def write_chunk(folder: Path, number: int, chunk: Chunk) -> None:
    """Write a file of states atomically and durably; raise OSError on failure."""
    buffer = io.BytesIO()  # a full disk then fails in one plain write
    t, q, p, iterations = chunk.piece
    memory = np.frombuffer(chunk.memory, dtype=np.uint8)
    further: dict[str, Any] = {"step": np.int64(chunk.step), "memory": memory, "crossings": chunk.crossings}
    named = zip((*COLUMNS, "crossings"), (*chunk.piece, chunk.crossings), strict=True)
    further |= {f"{name}_low": column.low for name, column in named if isinstance(column, Words)}
    np.savez(buffer, t=t, q=q, p=p, iterations=iterations, **further)
    write_atomically(chunk_path(folder, number), lambda file: file.write(sealed_archive(buffer.getvalue())))
    sync_folder(folder)


def sealed_archive(archive: bytes) -> bytes:
    """Return a ZIP archive with a comment that contains the checksum of the bytes before.

    The checksums of the format itself leave out names, times and attributes.
    """
    body = archive[: -len(NO_COMMENT)] + DIGEST.to_bytes(len(NO_COMMENT), "little")
    return body + hashlib.sha256(body).digest()


def _unsealed(data: bytes) -> io.BytesIO:
    """Return an archive; raise :class:`ValueError` if its checksum differs."""
    if data[-DIGEST:] != hashlib.sha256(data[:-DIGEST]).digest():
        raise ValueError("its checksum differs: restore it from a copy")
    return io.BytesIO(data)


DIGEST = 32
"""Number of bytes of a checksum."""
NO_COMMENT = b"\0\0"
"""Last bytes of an archive without comment: the length of the comment."""


def read_chunk(path: Path, interface: Interface, rows: int) -> Chunk:
    """Return the contents of a file of states with right checksums, shapes and rows; RecordingError if damaged."""
    try:
        with loaded(_unsealed(regular(path).read_bytes())) as arrays:
            t, q, p, iterations = (arrays[name] for name in COLUMNS)
            if interface.words > 1:
                t, q, p = (with_low(arrays[name], arrays[f"{name}_low"]) for name in ("t", "q", "p"))
            crossings = arrays["crossings"] if "crossings" in arrays else no_crossings(interface)
            if "crossings_low" in arrays:
                crossings = with_low(crossings, arrays["crossings_low"])
            chunk = Chunk((t, q, p, iterations), int(arrays["step"]), arrays["memory"].tobytes(), crossings)
            _check_shapes(chunk, interface, rows)
            return chunk
    except (OSError, ValueError) as error:
        raise RecordingError(f"'{path}' cannot be read: {error}") from error


def _check_shapes(chunk: Chunk, interface: Interface, rows: int) -> None:
    """Raise :class:`ValueError` if columns have other types or inconsistent lengths."""
    columns: tuple[NDArray[Any], ...] = chunk.piece
    likes: tuple[NDArray[Any], ...] = no_states(interface)
    for name, column, like in zip(COLUMNS, columns, likes, strict=True):
        for words in (column, column.low) if isinstance(column, Words) else (column,):
            if words.shape != (len(chunk), *like.shape[1:]) or words.dtype != like.dtype:
                raise ValueError(f"{name} has the shape {words.shape} and the type {words.dtype}")
    for words in (chunk.crossings, low_words(chunk.crossings)):
        if words.shape != (len(chunk.crossings), 2 + 2 * interface.dimension) or words.dtype != np.float64:
            raise ValueError(f"crossings has the shape {words.shape} and the type {words.dtype}")
    if chunk.step < 0 or len(chunk) > rows:
        raise ValueError(f"it has {len(chunk)} states up to step {chunk.step}")


MANIFEST = "manifest.json"
FORMAT = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Build:
    """Compiled code that computed the states from some step on.

    Attributes:
        step: number of steps completed before.
        version: version of this package.
        compiler: identification of the compiler.
        fingerprint: hash of source, compiler, flags, Python and processor; equal hashes imply bitwise equal results.
    """

    step: int
    version: str
    compiler: str
    fingerprint: str

    @classmethod
    def of(cls, stepper: Integrator, step: int) -> Build:
        """Construct for the compiler of this machine."""
        return cls(
            step=step,
            version=__version__,
            compiler=compiler_title(),
            fingerprint=fingerprint(stepper.source, flags=stepper.flags),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Manifest:
    """Description of a run without its states.

    Attributes:
        source, interface, flags: those of its stepper.
        fallback: source of the fallback library with Newton's iteration, ``None`` if the source contains it.
        options: convergence criterion of the solver; ``None`` for the defaults.
        double: source, interface and fallback in double, which locate the events of double-double runs, else empty.
        parameters, parameters_low: values in the order of ``interface.parameters``; low words in double-double
            arithmetic.
        t: initial time.
        save_every: steps between saved states.
        steps: requested number of steps, ``None`` for adaptive steps.
        plan: step plan.
        rows: states in a full file.
        model: text of the model file, if there is one.
        builds: the build at the start, then each that continued the run.
        events: events of the run, which the source does not contain.
        mesh: density and mesh of fields as texts and numbers (``Mesh.to_section``), with the values of its parameters.
    """

    source: Source
    interface: Interface
    flags: tuple[str, ...]
    options: SolverOptions | None
    parameters: tuple[float, ...]
    t: float
    save_every: int
    steps: int | None
    plan: Fixed | Adaptive | InTau
    rows: int
    model: str | None
    builds: tuple[Build, ...]
    fallback: Source | None = None
    events: tuple[Event, ...] = ()
    mesh: Mapping[str, Any] | None = None
    parameters_low: tuple[float, ...] = ()
    double: tuple[Source, Interface, Source | None] | tuple[()] = ()

    @property
    def values(self) -> NDArray[np.float64]:
        """(k,) parameters, of one word or of two."""
        high, low = np.array(self.parameters), self.parameters_low
        return high if self.interface.words == 1 else with_low(high, np.array(low, dtype=float))

    def mesh_of_fields(self, folder: Path) -> Any:
        """Return the mesh of the fields of a density, or ``None``."""
        if self.mesh is None:
            return None
        try:
            return part("readers", "mesh_of")(self.mesh["field"], self.mesh["parameters"])
        except (ValueError, LookupError, TypeError, AttributeError) as error:
            raise RecordingError(f"the mesh in '{folder / MANIFEST}' is damaged: {error}") from error

    def stepper(self, mesh: Any = None) -> Stepper:
        """Return the integrator, compiled or loaded from the cache; ``mesh``: of the fields of a density."""
        variants = Variants({NewtonFallback(): self.fallback})
        interface = replace(self.interface, layout=replace(self.interface.layout, mesh=mesh))
        stepper = Stepper(self.source, interface, variants=variants, flags=self.flags, events=self.events)
        if self.double:
            source, interface, fallback = self.double
            variants = Variants({NewtonFallback(): fallback})
            stepper._doubles = constantly(Stepper(source, interface, variants=variants, flags=self.flags))
        return stepper

    def reached(self, run: Run) -> bool:
        """Return whether a run has reached its end."""
        return run.ended or (run.arrived if self.steps is None else run.steps >= self.steps)

    def continued_by(self, build: Build) -> Manifest:
        """Return the manifest with ``build`` continuing the run."""
        same = build.fingerprint == self.builds[-1].fingerprint
        return self if same else replace(self, builds=(*self.builds, build))

    def about(self) -> dict[str, str]:
        """Return descriptive texts to store with exported states."""
        texts = self.interface.about() | {"version": self.builds[0].version}
        if self.model is not None:
            texts["model"] = self.model
        return texts

    def check(self) -> None:
        """Raise :class:`ValueError` for numbers that are impossible in a run, and for unsafe compiler flags."""
        check_flags(self.flags)
        for source, interface in ((self.source, self.interface), *([self.double[:2]] if self.double else ())):
            check_interface(source, interface)
        if self.fallback and self.fallback.prefix != self.source.prefix:
            raise ValueError(f"the fallback is of '{self.fallback.prefix}', not of '{self.source.prefix}'")
        if not isinstance(self.model, str | None):
            raise TypeError(f"the model is {self.model!r:.60}")
        if not self.builds or not all(type(build.step) is int and build.step >= 0 for build in self.builds):
            raise ValueError("there are no builds, or their steps are no numbers")
        self._check_numbers()

    def _check_numbers(self) -> None:
        for name, least in {"save_every": 1, "rows": 1, "steps": 0}.items():
            if (count := getattr(self, name)) is not None or name != "steps":
                checked_count(count, name, least=least)
        checked_number(self.t, "t")
        if len(self.parameters) != len(self.interface.parameters):
            raise ValueError(f"{len(self.parameters)} parameters where {len(self.interface.parameters)} are wanted")
        if len(self.parameters_low) != (self.interface.words - 1) * len(self.parameters):
            raise ValueError(f"{len(self.parameters_low)} low words of parameters")
        for values in (self.parameters, self.parameters_low) if self.parameters_low else (self.parameters,):
            for name, value in zip(self.interface.parameters, values, strict=True):
                checked_number(value, name)
        if isinstance(self.plan, Fixed) == (self.steps is None):
            raise ValueError("give a number of fixed steps, or a target time")

    def to_json(self) -> str:
        """Return a JSON text for :meth:`from_json`, with the C code line by line."""
        document = {
            "format": FORMAT,
            **{field: getattr(self, field) for field in PLAIN},
            "options": None if self.options is None else asdict(self.options),
            "plan": self.plan.record,
            "builds": [asdict(build) for build in self.builds],
            "interface": self.interface.to_record(),
            "source": self.source.to_record(),
            **({"fallback": self.fallback.to_record()} if self.fallback else {}),
            **({"events": [event.table for event in self.events]} if self.events else {}),
            **({"mesh": self.mesh} if self.mesh else {}),
            **({"parameters_low": self.parameters_low} if self.parameters_low else {}),
            **({"double": [part and part.to_record() for part in self.double]} if self.double else {}),
        }
        return sealed_text(document)

    @classmethod
    def from_json(cls, text: str) -> Manifest:
        """Construct from a JSON text; raise ValueError, KeyError or TypeError if it is invalid."""
        document = json.loads(text)
        if not isinstance(document, dict) or document.get("format") != FORMAT:
            raise ValueError(f"its format is not {FORMAT}")
        start = SEAL % document.get("sha256")
        body = "{" + text.removeprefix(start)
        if not text.startswith(start) or hashlib.sha256(body.encode()).hexdigest() != document["sha256"]:
            raise ValueError("its checksum differs: restore the file from a copy")
        plain = {field: document[field] for field in PLAIN}
        options, plan = document["options"], document["plan"]
        manifest = cls(
            **plain | {field: tuple(plain[field]) for field in ("flags", "parameters")},
            options=None if options is None else SolverOptions(**options),
            plan=plan_from_record(**plan),
            builds=tuple(Build(**build) for build in document["builds"]),
            interface=Interface.from_record(document["interface"]),
            source=Source.from_record(document["source"]),
            fallback=Source.from_record(document["fallback"]) if "fallback" in document else None,
            events=tuple(Event(**table) for table in document.get("events", ())),
            mesh=document.get("mesh"),
            parameters_low=tuple(document.get("parameters_low", ())),
            double=_double(*document.get("double", ())),
        )
        manifest.check()
        return manifest


SEAL = '{\n "sha256": "%s",'
"""First lines of the text of a manifest: the checksum of the others."""
PLAIN = ("flags", "parameters", "t", "save_every", "steps", "rows", "model")


def sealed_text(document: Mapping[str, Any]) -> str:
    """Return the JSON text of a manifest behind its checksum."""
    text = json.dumps(document, indent=1) + "\n"
    return SEAL % hashlib.sha256(text.encode()).hexdigest() + text[1:]


def _double(*records: Any) -> tuple[Source, Interface, Source | None] | tuple[()]:
    if not records:
        return ()
    source, interface, fallback = records
    return Source.from_record(source), Interface.from_record(interface), fallback and Source.from_record(fallback)


def read_manifest(folder: Path) -> Manifest:
    """Return the manifest in a folder; RecordingError if there is none, or it is damaged."""
    path = folder / MANIFEST
    try:
        return Manifest.from_json(read_text(path, "utf-8"))
    except (FileNotFoundError, NotADirectoryError) as error:
        raise RecordingError(f"'{folder}' contains no recorded run: there is no file '{path}'") from error
    except OSError as error:
        raise RecordingError(f"'{path}' cannot be read: {error.strerror or error}") from error
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        raise RecordingError(f"'{path}' is damaged or of another version of this package: {error!r}") from error


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write the manifest into a folder atomically; raise OSError on failure."""
    write_text(folder / MANIFEST, manifest.to_json())

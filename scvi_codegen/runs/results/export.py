"""Export of trajectories of any length to files and tables: npz, CSV, HDF5, Zarr; xarray, pandas.

Files are written in chunks, which bounds memory, and atomically. h5netcdf, zarr, xarray and pandas are the extra
``data``, imported where they are used.

NumPy's files (.npy, .npz) are read without pickle.
"""

from __future__ import annotations

import importlib.util
import json
import os
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.common.atomic import regular, replaced
from scvi_codegen.common.errors import StateError, imported, missing
from scvi_codegen.common.labelled_arrays import CHUNK_BYTES, Labelled, NamedQuantity, write_hdf5, write_zarr

if TYPE_CHECKING:
    import pandas


@contextmanager
def loaded(file: Any | IO[bytes]) -> Iterator[Any]:
    """Return the result of ``numpy.load``, open within the context.

    Raises:
        OSError: if the file cannot be read.
        ValueError: for any failure on a damaged file: of zipfile, zlib, the header parser, or memory.
    """
    try:  # opened here, because ``numpy.load`` leaves files open that are damaged
        with regular(file).open("rb") if isinstance(file, str | os.PathLike) else nullcontext(file) as opened:
            content = np.load(opened, allow_pickle=False)
            try:
                yield content
            finally:
                if hasattr(content, "close"):
                    content.close()
    except (OSError, ValueError):
        raise
    except Exception as error:
        raise ValueError(f"it is not a complete NumPy file: {error!r}") from error


Array = NDArray[np.float64]
Piece: TypeAlias = tuple[Array, Array, Array, NDArray[np.int32]]
"""Chunk of consecutive states: t (n,), q (n, m), p (n, m), iterations (n,)."""

COLUMNS = ("t", "q", "p", "iterations")
MOST_IN_TEXT = 100
"""Largest number of parameters in the attributes of a file; more of them are an array with their names."""


@dataclass(frozen=True, slots=True, kw_only=True)
class States:
    """Trajectory to export.

    Attributes:
        count: number n of states.
        pieces: returns an iterator over chunks in order, each with the arrays ``recorded``; may be called repeatedly.
        coordinates, momenta: the m names of the columns of q and of p.
        parameters: value by name.
        h: step size.
        about: metadata texts by name: title, system, method, version, ...
        maps: names of the momentum maps.
        attitudes: quantities of rotations, directions and spins, and fields on meshes.
        quantities: derived quantities of t (n,), q and p (n, m): velocity (n, m), energy (n,), momentum_map (n, c), and
            the attitudes by name.
        units: of t, q, p and these, as far as known.
        low: low words of t, q, p and parameters in double-double arithmetic, by name of the file's arrays.
        errors: (n, m) errors of q and p and their rounding errors, by name of the file's arrays; or none.
        recorded: t, q, p, and iterations where they were counted.
    """

    count: int
    pieces: Callable[[], Iterator[tuple[NDArray[Any], ...]]]
    coordinates: tuple[str, ...]
    momenta: tuple[str, ...]
    parameters: Mapping[str, float]
    h: float
    about: Mapping[str, str]
    maps: tuple[str, ...] = ()
    attitudes: tuple[NamedQuantity, ...] = ()
    quantities: Callable[[Array, Array, Array], Mapping[str, Array]] | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    low: Mapping[str, Array] = field(default_factory=dict)
    errors: Mapping[str, Array] = field(default_factory=dict)
    recorded: tuple[str, ...] = COLUMNS

    @property
    def attributes(self) -> dict[str, Any]:
        """Metadata: all fields except the states and many parameters, as numbers and texts."""
        many = len(self.parameters) > MOST_IN_TEXT
        return {**self.about, "h": self.h} | ({} if many else {"parameters": json.dumps(dict(self.parameters))})

    def columns(self) -> dict[str, tuple[tuple[int, ...], np.dtype[Any]]]:
        """Return shape and type of each array."""
        n, m = self.count, len(self.coordinates)
        real, counts = np.dtype(float), np.dtype(np.int32)
        columns = {"t": ((n,), real), "q": ((n, m), real), "p": ((n, m), real), "iterations": ((n,), counts)}
        return {name: columns[name] for name in self.recorded}

    def labelled(self) -> Labelled:
        """Return the arrays with named dimensions, including derived quantities."""
        dimensions: dict[str, tuple[str, ...]] = {"t": ("t",), "coordinate": ("coordinate",)}
        dimensions |= {name: ("t", "coordinate")[: len(shape)] for name, (shape, _) in self.columns().items()}
        dimensions |= dict.fromkeys(self.errors, ("t", "coordinate"))
        whole = {"coordinate": np.array(self.coordinates)}
        if len(self.parameters) > MOST_IN_TEXT:
            dimensions |= {"parameter": ("parameter",), "parameters": ("parameter",)}
            whole |= {"parameter": np.array([*self.parameters]), "parameters": np.array([*self.parameters.values()])}
        if self.quantities is not None:
            dimensions |= {"velocity": ("t", "coordinate"), "energy": ("t",)}
        if self.quantities is not None and self.maps:
            dimensions |= {"symmetry": ("symmetry",), "momentum_map": ("t", "symmetry")}
            whole["symmetry"] = np.array(self.maps)
        attitudes = self.attitudes if self.quantities is not None else ()
        if attitudes:
            axes = {axis: values for quantity in attitudes for axis, values in quantity.axes.items()}
            dimensions |= {axis: (axis,) for axis in axes}
            dimensions |= {quantity.name: ("t", *quantity.dimensions) for quantity in attitudes}
            whole |= axes
        return Labelled(
            dimensions=dimensions,
            pieces=self._labelled_pieces,
            whole=whole,
            count=self.count,
            units={name: unit for name, unit in self.units.items() if name in dimensions},
            attributes=self.attributes,
            long_names={quantity.name: quantity.long_name for quantity in attitudes},
        )

    def _labelled_pieces(self) -> Iterator[dict[str, NDArray[Any]]]:
        first = 0
        for piece in self.pieces():
            t, q, p, *_ = piece
            more = {} if self.quantities is None else self.quantities(t, q, p)
            errors = {name: values[first : first + len(t)] for name, values in self.errors.items()}
            first += len(t)
            yield {**dict(zip(self.recorded, piece, strict=True)), **errors, **more}


def chunk_rows(dimension: int) -> int:
    """Return the number of states of m coordinates in a chunk of about 16 MiB."""
    return max(1, CHUNK_BYTES // (8 * (1 + 2 * dimension) + 4))


def check_format(path: str | os.PathLike[str]) -> None:
    """Check before a long run that states can be written to a file of this suffix; StateError, MissingLibraryError."""
    suffix = Path(path).suffix.lower()
    if suffix not in WRITERS:
        raise StateError(f"the format of a trajectory is the suffix of its file, one of {FORMATS}, not {str(path)!r}")
    library = LABELLED[suffix].library if suffix in LABELLED else None
    if library is not None and importlib.util.find_spec(library) is None:
        raise missing(library, "data")


def write_states(states: States, path: str | os.PathLike[str]) -> None:
    """Write states atomically in the format of the suffix; raises as :func:`check_format`, and OSError."""
    check_format(path)
    suffix = Path(path).suffix.lower()
    if states.units and suffix not in LABELLED:
        raise StateError(f"the format {suffix} does not support units; {', '.join(LABELLED)} do")
    if states.errors and suffix == ".csv":
        raise StateError(f"the format .csv has no errors of the states; .npz, {', '.join(LABELLED)} do")
    write_whole(path, lambda new: WRITERS[suffix](states, new))


def write_whole(path: str | os.PathLike[str], write: Callable[[Path], None]) -> None:
    """Create a file or a folder by ``write``, which then replaces ``path``; nothing changes on failure."""
    if Path(path).is_dir() and not (Path(path) / ".zgroup").exists():
        raise StateError(f"{str(path)!r} is a folder with other contents: choose another name")
    try:
        with replaced(path) as new:
            write(new)
    except OSError as error:
        if error.errno is None:
            raise
        reason = f"{os.strerror(error.errno)}: nothing was written, and existing files are unchanged"
        raise OSError(error.errno, reason, str(path)) from error


def to_dataframe(states: States) -> pandas.DataFrame:
    """Return one row per state, indexed by time, with the columns of a CSV file (:func:`_names`)."""
    library = imported("pandas", "data")
    t, *columns = (np.concatenate(parts) for parts in zip(*map(tuple, _columns(states)), strict=True))
    frame: pandas.DataFrame = library.DataFrame(
        dict(zip(_names(states)[1:], columns, strict=True)), index=library.Index(t, name="t")
    )
    frame.attrs = states.attributes
    return frame


def _names(states: States) -> list[str]:
    """Return column names: t, coordinates x, momenta p_x; iterations, velocities, energy and attitudes, if known."""
    names = ["t", *states.coordinates, *states.momenta, *states.recorded[3:]]
    if states.quantities is not None:
        names += [*(f"{name}_dot" for name in states.coordinates), "energy"]
        names += [name for quantity in states.attitudes for name in quantity.columns]
    return names


def _columns(states: States) -> Iterator[Iterator[NDArray[Any]]]:
    """Yield the columns of :func:`_names`, (n,) each, chunk by chunk."""
    for t, q, p, *counted in states.pieces():
        derived = {} if states.quantities is None else states.quantities(t, q, p)
        more = (*derived["velocity"].T, derived["energy"]) if derived else ()
        if derived:
            tables = [derived[quantity.name].reshape(len(t), -1).T for quantity in states.attitudes if quantity.columns]
            more += tuple(column for table in tables for column in table)
        yield iter((t, *q.T, *p.T, *counted, *more))


def _write_npz(states: States, path: Path) -> None:
    """Write the same file as ``np.savez`` for the whole arrays, in chunks."""
    small = {
        "h": np.array(states.h),
        "parameters": np.array(list(states.parameters.values()), dtype=float),
        "coordinates": np.array(states.coordinates),
        "parameter_names": np.array(list(states.parameters), dtype=str),
        **{name: np.array(text) for name, text in states.about.items()},
        **states.low,
        **states.errors,
    }
    with zipfile.ZipFile(path, "w") as archive:
        for i, (name, (shape, kind)) in enumerate(states.columns().items()):
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                described = {"descr": np.lib.format.dtype_to_descr(kind), "fortran_order": False, "shape": shape}
                np.lib.format.write_array_header_1_0(file, described)
                for piece in states.pieces():
                    file.write(np.ascontiguousarray(piece[i], dtype=kind).data)
        for name, array in small.items():
            with archive.open(f"{name}.npy", "w") as file:
                np.lib.format.write_array(file, array, allow_pickle=False)


def _write_csv(states: States, path: Path) -> None:
    names = _names(states)
    formats = ["%d" if name == "iterations" else "%.17g" for name in names]
    with path.open("w", encoding="utf-8") as file:
        file.write(",".join(names) + "\n")
        for columns in _columns(states):
            np.savetxt(file, np.column_stack(tuple(columns)), delimiter=",", fmt=formats)


def _write_labelled(states: States, path: Path, *, suffix: str) -> None:
    LABELLED[suffix].write(states.labelled(), path)


class Format(NamedTuple):
    """Output format: a function that writes a path, and the library that it requires."""

    write: Callable[[Labelled, Path], None]
    library: str | None = None


LABELLED: Mapping[str, Format] = {
    ".h5": Format(write_hdf5, "h5netcdf"),
    ".hdf5": Format(write_hdf5, "h5netcdf"),
    ".nc": Format(write_hdf5, "h5netcdf"),
    ".zarr": Format(write_zarr, "zarr"),
}
"""Formats with named dimensions and units, of trajectories and ensembles."""
WRITERS: Mapping[str, Callable[[States, Path], None]] = {".npz": _write_npz, ".csv": _write_csv} | {
    suffix: partial(_write_labelled, suffix=suffix) for suffix in LABELLED
}
FORMATS = ", ".join(WRITERS)
"""Suffixes of trajectories and ensembles."""

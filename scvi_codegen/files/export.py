"""States of a trajectory, however long, as files and as tables: npz, CSV, HDF5, Zarr; xarray, pandas.

Files are written piece by piece, so that their length does not matter, and take their place when they are whole. HDF5
and Zarr have dimension names, as netCDF has them: ``xarray.open_dataset`` and ``xarray.open_zarr`` read them. h5py,
zarr, xarray and pandas are the extra ``data``, imported where they are used.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import MissingLibraryError, StateError
from scvi_codegen.files.atomic import replaced

if TYPE_CHECKING:
    import pandas
    import xarray

__all__ = ["Piece", "States", "check_format", "chunk_rows", "to_dataframe", "to_xarray", "write_states"]

Array = NDArray[np.float64]
Piece: TypeAlias = tuple[Array, Array, Array, NDArray[np.int32]]
"""Some of the states, one after the other: t (n,), q (n, m), p (n, m), iterations (n,)."""

CHUNK_BYTES = 2**24
COLUMNS = ("t", "q", "p", "iterations")


@dataclass(frozen=True, slots=True, kw_only=True)
class States:
    """A trajectory to write.

    Attributes:
        count: the number n of states.
        pieces: gives them in order, as often as it is called.
        coordinates: the m names.
        parameters: value by name.
        h: step size.
        about: texts to write beside the numbers, by name: title, system, method, version, ...
    """

    count: int
    pieces: Callable[[], Iterator[Piece]]
    coordinates: tuple[str, ...]
    parameters: Mapping[str, float]
    h: float
    about: Mapping[str, str]

    @property
    def attributes(self) -> dict[str, Any]:
        """All but the states as numbers and texts."""
        return {**self.about, "h": self.h, "parameters": json.dumps(dict(self.parameters))}

    def columns(self) -> dict[str, tuple[tuple[int, ...], np.dtype[Any], tuple[str, ...]]]:
        """Shape, type and names of the dimensions of each array."""
        n, m = self.count, len(self.coordinates)
        real, vector = np.dtype(float), ("t", "coordinate")
        return {
            "t": ((n,), real, ("t",)),
            "q": ((n, m), real, vector),
            "p": ((n, m), real, vector),
            "iterations": ((n,), np.dtype(np.int32), ("t",)),
        }


def chunk_rows(dimension: int) -> int:
    """States of m coordinates in a chunk of about 16 MiB."""
    return max(1, CHUNK_BYTES // (8 * (1 + 2 * dimension) + 4))


def check_format(path: str | os.PathLike[str]) -> None:
    """Find out, before a long run, whether states can be written to such a file.

    Raises:
        StateError: for another suffix.
        MissingLibraryError: if the library for it is not installed.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in WRITERS:
        known = ", ".join(WRITERS)
        raise StateError(f"a trajectory is saved by the suffix of its file, one of {known}, not as {str(path)!r}")
    library = LIBRARIES.get(suffix)
    if library is not None and importlib.util.find_spec(library) is None:
        raise _missing(library)


def write_states(states: States, path: str | os.PathLike[str]) -> None:
    """Write states in the format of the suffix, whole or not at all.

    Raises:
        StateError, MissingLibraryError: as :func:`check_format`; StateError also if another folder is in the way.
        OSError: if it cannot be written.
    """
    check_format(path)
    if Path(path).is_dir() and not (Path(path) / ".zgroup").exists():
        raise StateError(f"{str(path)!r} is a folder with something else in it: choose another name")
    try:
        with replaced(path) as made:
            WRITERS[Path(path).suffix.lower()](states, made)
    except OSError as error:
        if error.errno is None:
            raise
        what = f"{os.strerror(error.errno)}: nothing was written, what was there before is there still"
        raise OSError(error.errno, what, str(path)) from error


def to_xarray(states: States) -> xarray.Dataset:
    """Variables q and p (t, coordinate) and iterations (t), with h, parameters and the rest as attributes."""
    library = _imported("xarray")
    arrays = _joined(states)
    named = {name: (dimensions, arrays[name]) for name, (_, _, dimensions) in states.columns().items()}
    coordinates = {"t": named.pop("t"), "coordinate": list(states.coordinates)}
    dataset: xarray.Dataset = library.Dataset(named, coords=coordinates, attrs=states.attributes)
    return dataset


def to_dataframe(states: States) -> pandas.DataFrame:
    """A line a state, by time: a column for each coordinate x and each momentum p_x, and iterations."""
    library = _imported("pandas")
    arrays, names = _joined(states), states.coordinates
    columns = dict(zip(names, arrays["q"].T, strict=True))
    columns |= {f"p_{name}": column for name, column in zip(names, arrays["p"].T, strict=True)}
    frame: pandas.DataFrame = library.DataFrame(
        {**columns, "iterations": arrays["iterations"]}, index=library.Index(arrays["t"], name="t")
    )
    frame.attrs = states.attributes
    return frame


def _joined(states: States) -> dict[str, NDArray[Any]]:
    """All states at once."""
    return {
        name: np.concatenate(parts) for name, parts in zip(COLUMNS, zip(*states.pieces(), strict=True), strict=True)
    }


def _write_npz(states: States, path: Path) -> None:
    """What ``np.savez`` would write of the whole arrays, made of pieces."""
    small = {
        "h": np.array(states.h),
        "parameters": np.array(list(states.parameters.values()), dtype=float),
        "coordinates": np.array(states.coordinates),
        "parameter_names": np.array(list(states.parameters), dtype=str),
        **{name: np.array(text) for name, text in states.about.items()},
    }
    with zipfile.ZipFile(path, "w") as archive:
        for i, (name, (shape, kind, _)) in enumerate(states.columns().items()):
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                described = {"descr": np.lib.format.dtype_to_descr(kind), "fortran_order": False, "shape": shape}
                np.lib.format.write_array_header_1_0(file, described)
                for piece in states.pieces():
                    file.write(np.ascontiguousarray(piece[i], dtype=kind).data)
        for name, array in small.items():
            with archive.open(f"{name}.npy", "w") as file:
                np.lib.format.write_array(file, array, allow_pickle=False)


def _write_csv(states: States, path: Path) -> None:
    names = states.coordinates
    formats = ["%.17g"] * (1 + 2 * len(names)) + ["%d"]
    with path.open("w", encoding="utf-8") as file:
        file.write(",".join(["t", *names, *(f"p_{name}" for name in names), "iterations"]) + "\n")
        for piece in states.pieces():
            np.savetxt(file, np.column_stack(piece), delimiter=",", fmt=formats)


def _write_hdf5(states: States, path: Path) -> None:
    with _imported("h5py").File(path, "w") as file:
        file.attrs.update(states.attributes)
        file.create_dataset("coordinate", data=list(states.coordinates))
        for name, (shape, kind, _) in states.columns().items():
            file.create_dataset(name, shape, kind)
        _fill(states, file)
        for name in ("t", "coordinate"):
            file[name].make_scale(name)
        for name in ("q", "p", "iterations"):
            for axis, dimension in enumerate(states.columns()[name][2]):
                file[name].dims[axis].attach_scale(file[dimension])


def _write_zarr(states: States, path: Path) -> None:
    """Version 2 of the format, which every reader knows."""
    group = _imported("zarr").open_group(str(path), mode="w", zarr_format=2)
    group.attrs.update(states.attributes)
    rows = max(1, min(states.count, chunk_rows(len(states.coordinates))))
    for name, (shape, kind, dimensions) in states.columns().items():
        array = group.create_array(name, shape=shape, dtype=kind, chunks=(rows, *shape[1:]), fill_value=None)
        array.attrs["_ARRAY_DIMENSIONS"] = list(dimensions)
    names = np.array(states.coordinates)
    group.create_array("coordinate", shape=names.shape, dtype=names.dtype).attrs["_ARRAY_DIMENSIONS"] = ["coordinate"]
    group["coordinate"][:] = names
    _fill(states, group)
    _imported("zarr").consolidate_metadata(str(path), zarr_format=2)


def _fill(states: States, arrays: Any) -> None:
    first = 0
    for piece in states.pieces():
        last = first + len(piece[0])
        for name, part in zip(COLUMNS, piece, strict=True):
            arrays[name][first:last] = part
        first = last


WRITERS: dict[str, Callable[[States, Path], None]] = {
    ".npz": _write_npz,
    ".csv": _write_csv,
    ".h5": _write_hdf5,
    ".hdf5": _write_hdf5,
    ".zarr": _write_zarr,
}
LIBRARIES = {".h5": "h5py", ".hdf5": "h5py", ".zarr": "zarr"}


def _imported(library: str) -> Any:
    try:
        return importlib.import_module(library)
    except ImportError as error:
        raise _missing(library) from error


def _missing(library: str) -> MissingLibraryError:
    return MissingLibraryError(f"this needs {library}, which is not installed: pip install 'scvi-codegen[data]'")

"""Arrays whose dimensions have names, for HDF5, Zarr and xarray: states, and what follows from them.

HDF5 files are netCDF4, written through h5netcdf; ``xarray.open_dataset`` reads them, and ``xarray.open_zarr`` the
folders of Zarr. Every variable has a ``long_name``, and ``units`` where they were given.
"""

from __future__ import annotations

import errno
import importlib
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import MissingLibraryError, StateError

if TYPE_CHECKING:
    import xarray

__all__ = ["CHUNK_BYTES", "Labelled", "checked_units", "imported", "missing", "to_dataset", "write_hdf5", "write_zarr"]

CHUNK_BYTES = 2**24
"""Of what is in memory at a time, and of a chunk of a file."""
Arrays: TypeAlias = Mapping[str, NDArray[Any]]

LONG_NAMES = {
    "time": "time of each state of each trajectory",
    "t": "time",
    "q": "position",
    "p": "momentum",
    "iterations": "iterations of the solver since the state before",
    "velocity": "velocity that belongs to the momentum",
    "energy": "energy p.v - L",
    "momentum_map": "what a symmetry conserves",
    "coordinate": "name of the coordinate",
    "symmetry": "name of the momentum map",
    "parameter": "name of the parameter",
    "parameters": "value of the parameter",
    "status": "whether the trajectory reached the end, or why not",
    "steps": "steps completed",
}
MEASURED = ("t", "q", "p", "velocity", "energy", "momentum_map")
"""What may have units."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Labelled:
    """Arrays of any length along t, and whole ones.

    Attributes:
        dimensions: of each array by its name; those along t have it first.
        pieces: gives the arrays along t in parts, as often as it is called.
        whole: the arrays without t; one called as its only dimension names what stands along it.
        count: the length of t.
        units: of arrays, by name.
        attributes: of all together, numbers and texts.
    """

    dimensions: Mapping[str, tuple[str, ...]]
    pieces: Callable[[], Iterator[Arrays]]
    whole: Arrays
    count: int
    units: Mapping[str, str]
    attributes: Mapping[str, Any]

    def sizes(self) -> dict[str, int]:
        """Length of each dimension."""
        found = {"t": self.count}
        for name, array in self.whole.items():
            found |= dict(zip(self.dimensions[name], array.shape, strict=True))
        return found

    def about(self, name: str) -> dict[str, str]:
        """Attributes of an array."""
        units = {"units": self.units[name]} if name in self.units else {}
        return {"long_name": LONG_NAMES[name], **units}

    def size(self) -> int:
        """Bytes of all arrays, texts left out."""
        shapes = [(self.shape(name), _kind(name)) for name in self.along()]
        return sum(int(np.prod(shape)) * kind.itemsize for shape, kind in shapes)

    def along(self) -> list[str]:
        """Names of the arrays along t."""
        return [name for name in self.dimensions if name not in self.whole]

    def shape(self, name: str) -> tuple[int, ...]:
        """Of an array."""
        sizes = self.sizes()
        return tuple(sizes[dimension] for dimension in self.dimensions[name])


def checked_units(units: Mapping[str, str] | None) -> dict[str, str]:
    """Units by name, with those of velocities where those of positions and times are given.

    Raises:
        StateError: for another name, or no text.
    """
    found = dict(units or {})
    for name, unit in found.items():
        if name not in MEASURED or not isinstance(unit, str):
            raise StateError(f"units are texts for {', '.join(MEASURED)}, not {unit!r} for {name!r}")
    if "q" in found and "t" in found:
        found.setdefault("velocity", f"{found['q']} {found['t']}-1")
    return found


def to_dataset(labelled: Labelled) -> xarray.Dataset:
    """An xarray Dataset, whole in memory."""
    library = imported("xarray")
    parts = list(labelled.pieces())
    arrays = {name: np.concatenate([part[name] for part in parts]) for name in labelled.along()} | dict(labelled.whole)
    variables = {
        name: (dimensions, arrays[name], labelled.about(name)) for name, dimensions in labelled.dimensions.items()
    }
    coordinates = {
        name: variables.pop(name) for name, dimensions in labelled.dimensions.items() if dimensions == (name,)
    }
    dataset: xarray.Dataset = library.Dataset(variables, coords=coordinates, attrs=dict(labelled.attributes))
    return dataset


def write_hdf5(labelled: Labelled, path: Path) -> None:
    """A file of netCDF4; OSError where there is no room for it, which HDF5 itself does not survive."""
    if shutil.disk_usage(path.parent).free < labelled.size():
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
    texts = imported("h5py").string_dtype()
    with imported("h5netcdf").File(path, "w") as file:
        file.attrs.update(labelled.attributes)
        file.dimensions = labelled.sizes()
        for name, dimensions in labelled.dimensions.items():
            whole = labelled.whole.get(name)
            kind = _kind(name) if whole is None else texts if whole.dtype.kind == "U" else whole.dtype
            made = file.create_variable(name, dimensions, kind)
            made.attrs.update(labelled.about(name))
            if whole is not None:
                made[...] = whole.astype(object) if whole.dtype.kind == "U" else whole
        _fill(labelled, file)


def write_zarr(labelled: Labelled, path: Path) -> None:
    """A folder of version 2 of the format, which every reader knows."""
    zarr = imported("zarr")
    group = zarr.open_group(str(path), mode="w", zarr_format=2)
    group.attrs.update(labelled.attributes)
    for name, dimensions in labelled.dimensions.items():
        whole, shape = labelled.whole.get(name), labelled.shape(name)
        kind = _kind(name) if whole is None else whole.dtype
        row = int(np.prod(shape[1:])) * kind.itemsize
        rows = max(1, min(labelled.count, CHUNK_BYTES // max(row, 1))) if whole is None else shape[0]
        given = {"chunks": (max(1, rows), *shape[1:]), "fill_value": None}
        made = group.create_array(name, shape=shape, dtype=kind, **given)
        made.attrs.update({"_ARRAY_DIMENSIONS": list(dimensions), **labelled.about(name)})
        if whole is not None:
            made[...] = whole
    _fill(labelled, group)
    zarr.consolidate_metadata(str(path), zarr_format=2)


def _kind(name: str) -> np.dtype[Any]:
    return np.dtype(np.int32 if name == "iterations" else float)


def _fill(labelled: Labelled, arrays: Any) -> None:
    first = 0
    for piece in labelled.pieces():
        last = first + len(piece["t"])
        for name in labelled.along():
            arrays[name][first:last] = piece[name]
        first = last


def imported(library: str) -> Any:
    """The library; MissingLibraryError without it."""
    try:
        return importlib.import_module(library)
    except ImportError as error:
        raise missing(library) from error


def missing(library: str) -> MissingLibraryError:
    """What to say without a library."""
    return MissingLibraryError(f"this needs {library}, which is not installed: pip install 'scvi-codegen[data]'")

"""Arrays with named dimensions, for HDF5, Zarr and xarray: states and derived quantities.

HDF5 files are netCDF4, written by h5netcdf; ``xarray.open_dataset`` reads them, and ``xarray.open_zarr`` Zarr folders.
Every variable has a ``long_name``, and ``units`` if given.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.common.errors import StateError, imported

if TYPE_CHECKING:
    import xarray

CHUNK_BYTES = 2**24
"""Size of chunks in memory and in files."""
Arrays: TypeAlias = Mapping[str, NDArray[Any]]

LONG_NAMES = {
    "time": "time of each state of each trajectory",
    "t": "time",
    "q": "position",
    "p": "momentum",
    "iterations": "solver iterations since the previous state",
    "velocity": "velocity",
    "energy": "energy p.v - L",
    "momentum_map": "conserved quantity of a symmetry",
    "coordinate": "name of the coordinate",
    "space_axis": "axis of the space frame",
    "body_axis": "axis of the body frame",
    "symmetry": "name of the momentum map",
    "parameter": "name of the parameter",
    "parameters": "value of the parameter",
    "status": "end of the trajectory: success or reason of failure",
    "steps": "steps completed",
}
MEASURED = ("t", "q", "p", "velocity", "energy", "momentum_map")
"""Arrays that may have units."""


AXES: dict[str, NDArray[np.int_]] = {name: np.arange(1, 4) for name in ("space_axis", "body_axis")}
"""Dimensions of the quantities, with their coordinates."""


@dataclass(frozen=True, slots=True)
class NamedQuantity:
    """Rotation matrix, angular velocity, angular momentum, direction or spin, or a field on a mesh.

    Attributes:
        name: as in formulas, ``R``, ``omega``, ``p_R``, ``n``, ``n_dot``, ``s``.
        dimensions: names of its axes.
        columns: names of its entries in tables, ``R_11``, ``omega_1``, ``n_1_dot``; none of fields, whose states are.
        long_name: description.
        axes: coordinates of its dimensions.
    """

    name: str
    dimensions: tuple[str, ...]
    columns: tuple[str, ...]
    long_name: str
    axes: Mapping[str, NDArray[Any]] = field(default_factory=lambda: AXES)


@dataclass(frozen=True, slots=True, kw_only=True)
class Labelled:
    """Arrays of any length along t, and arrays without t.

    Attributes:
        dimensions: of each array by its name; t is the first.
        pieces: returns an iterator over chunks of the arrays along t; may be called repeatedly.
        whole: the arrays without t; one named like its only dimension is the coordinate of that dimension.
        count: the length of t.
        units: of arrays, by name.
        attributes: global attributes, numbers and texts.
        long_names: of arrays that are not in ``LONG_NAMES``, by name.
    """

    dimensions: Mapping[str, tuple[str, ...]]
    pieces: Callable[[], Iterator[Arrays]]
    whole: Arrays
    count: int
    units: Mapping[str, str]
    attributes: Mapping[str, Any]
    long_names: Mapping[str, str] = field(default_factory=dict)

    def sizes(self) -> dict[str, int]:
        """Return the length of each dimension."""
        sizes = {"t": self.count}
        for name, array in self.whole.items():
            sizes |= dict(zip(self.dimensions[name], array.shape, strict=True))
        return sizes

    def about(self, name: str) -> dict[str, str]:
        """Return the attributes of an array."""
        units = {"units": self.units[name]} if name in self.units else {}
        return {"long_name": self.long_names.get(name) or LONG_NAMES.get(name, f"coordinate {name}"), **units}

    def size(self) -> int:
        """Return the bytes of the arrays along t."""
        shapes = [(self.shape(name), _kind(name)) for name in self.along()]
        return sum(int(np.prod(shape)) * kind.itemsize for shape, kind in shapes)

    def along(self) -> list[str]:
        """Return the names of the arrays along t."""
        return [name for name in self.dimensions if name not in self.whole]

    def shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of an array."""
        sizes = self.sizes()
        return tuple(sizes[dimension] for dimension in self.dimensions[name])


def checked_units(units: Mapping[str, str] | None) -> dict[str, str]:
    """Return units by name, those of velocities from positions and time; StateError for unknown names, other values."""
    result = dict(units or {})
    for name, unit in result.items():
        if name not in MEASURED or not isinstance(unit, str):
            raise StateError(f"units must be texts for {', '.join(MEASURED)}, not {unit!r} for {name!r}")
    if "q" in result and "t" in result:
        result.setdefault("velocity", f"{result['q']} {result['t']}-1")
    return result


def to_dataset(labelled: Labelled) -> xarray.Dataset:
    """Return an xarray Dataset in memory."""
    library = imported("xarray", "data")
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
    """Write a netCDF4 file; OSError if the disk is too full, since HDF5 itself crashes then."""
    if shutil.disk_usage(path.parent).free < labelled.size():
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
    texts = imported("h5py", "data").string_dtype()
    with imported("h5netcdf", "data").File(path, "w") as file:
        file.attrs.update(labelled.attributes)
        file.dimensions = labelled.sizes()
        for name, dimensions in labelled.dimensions.items():
            whole = labelled.whole.get(name)
            kind = _kind(name) if whole is None else whole.dtype
            kind = texts if kind.kind == "U" else kind
            variable = file.create_variable(name, dimensions, kind)
            variable.attrs.update(labelled.about(name))
            if whole is not None:
                variable[...] = whole.astype(object) if whole.dtype.kind == "U" else whole
        _fill(labelled, file)


def write_zarr(labelled: Labelled, path: Path) -> None:
    """Write a Zarr folder of format version 2, which all readers support."""
    zarr = imported("zarr", "data")
    group = zarr.open_group(str(path), mode="w", zarr_format=2)
    group.attrs.update(labelled.attributes)
    for name, dimensions in labelled.dimensions.items():
        whole, shape = labelled.whole.get(name), labelled.shape(name)
        kind = _kind(name) if whole is None else whole.dtype
        row = int(np.prod(shape[1:])) * kind.itemsize
        rows = max(1, min(labelled.count, CHUNK_BYTES // max(row, 1))) if whole is None else shape[0]
        options = {"chunks": (max(1, rows), *shape[1:]), "fill_value": None}
        array = group.create_array(name, shape=shape, dtype=kind, **options)
        array.attrs.update({"_ARRAY_DIMENSIONS": list(dimensions), **labelled.about(name)})
        if whole is not None:
            array[...] = whole
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

"""Systems that a section ``[system]`` names instead of writing them out: of the catalogue, and of robots' files."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, NamedTuple

from scvi_codegen.common.atomic import inside
from scvi_codegen.common.errors import ModelFileError, closest
from scvi_codegen.interfaces.models.model import Model
from scvi_codegen.interfaces.models.model_files.document import motion_of
from scvi_codegen.interfaces.models.model_files.sections import Document, Section, check_keys, in_section, text_of
from scvi_codegen.interfaces.models.options import STATE
from scvi_codegen.interfaces.models.problems import problem
from scvi_codegen.methods import specification_of
from scvi_codegen.systems.lagrangian import LagrangianSystem
from scvi_codegen.systems.system import MechanicalSystem

ARGUMENTS = ("name", "actuated", "limits", "friction", "restitution", "impacts", "check_inertias")
ROBOT_KEYS = ("robot", "time_transformation", *ARGUMENTS)
FORMAT_KEYS = {True: ("floating", "gravity"), False: ("contacts", "actuators", "keyframe")}
"""Those of URDF files (true) and of MJCF files."""
URDF = ".urdf"
ROBOT_FILES = (URDF, ".xml", ".mjcf")
"""Suffixes of robots' files, which are models by themselves."""
METHOD, STEP, SPAN = "svi:3", 0.005, 10.0
"""Method, step size and span of a robot without ``[method]`` and ``[run]``."""


class Entry(NamedTuple):
    """System that a file names, and the sections of its default motion."""

    system: MechanicalSystem
    motion: Document

    def completed(self, initial: Section) -> dict[str, Any]:
        """Return an initial state that was merged over that of the entry: tables by name change a part of it."""
        default = self.motion["initial"]
        changed = {key: initial[key] for key in STATE if key in initial and initial[key] is not default.get(key)}
        tables = {
            key: default[key] | value for key, value in changed.items() if isinstance(value, dict) and key in default
        }
        if self.system.rotations and any(isinstance(value, list) for value in changed.values()):
            from scvi_codegen.runs.states.rotations import state_by_name  # not needed for other systems

            rest = state_by_name(self.system, default["q"], None, default["q_dot"])
            vectors = {key: vector.tolist() for key, vector in zip(STATE, rest, strict=True) if vector is not None}
            tables |= {key: vector for key, vector in vectors.items() if initial.get(key) is default[key]}
        return {**initial, **tables}


def read_entry(section: Section, folder: str | os.PathLike[str]) -> Entry | None:
    """Return the system that a section ``[system]`` names, if it names one; ModelFileError for other keys and names."""
    if "catalogue" in section:
        check_keys(section, ("catalogue", "time_transformation"), "key", "[system] beside catalogue")
        entry = in_section("[system]", lambda: problem(text_of(section, "catalogue", "[system]")))
        names = [coordinate.name for coordinate in entry.system.coordinates]
        return Entry(entry.system, motion_of(Model.from_problem(entry), names))
    if "robot" in section:
        return _robot(section, Path(folder))
    for key in (*ARGUMENTS[1:], *FORMAT_KEYS[True], *FORMAT_KEYS[False]):
        if key in section:
            raise ModelFileError(f"[system] {key} belongs to files of robots: write robot = 'FILE', or omit {key}")
    return None


def is_robot(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is that of a robot, by its suffix."""
    return Path(path).suffix.lower() in ROBOT_FILES


def _robot(section: Section, folder: Path) -> Entry:
    """Return the system of a URDF or MJCF file, by default at rest in its reference configuration."""
    name = text_of(section, "robot", "[system]")
    try:
        path = inside(folder, name)
    except OSError as error:
        raise ModelFileError(f"[system] robot = '{name}' cannot be read: {error.strerror}") from error
    urdf = path.suffix.lower() == URDF
    own = FORMAT_KEYS[urdf]
    check_keys(section, (*ROBOT_KEYS, *own), "key", f"[system] beside robot = {path.name!r}")
    arguments: dict[str, Any] = {key: section[key] for key in (*ARGUMENTS, *own) if key in section}
    for key in ("floating", "check_inertias", "actuators"):
        if not isinstance(arguments.get(key, False), bool):
            raise ModelFileError(f"[system] {key} must be true or false, not {arguments[key]!r}")
    if "name" in arguments:
        text_of(section, "name", "[system]")
    read: Any = LagrangianSystem.from_urdf if urdf else LagrangianSystem.from_mjcf
    key = text_of(arguments, "keyframe", "[system]") if "keyframe" in arguments else "qpos0"
    arguments.pop("keyframe", None)
    system = in_section("[system] robot", lambda: read(path, **arguments))
    if key not in (states := system.keyframes):
        raise ModelFileError(f"there is no keyframe '{key}' in {path.name}{closest(key, states)}")
    start = states[key]
    controls = {name: start["inputs"][name] for name in system.actuators.values()}
    motion = {"initial": {"q": start["q"], "q_dot": start["velocity"]}, "inputs": controls}
    motion["run"] = {"span": SPAN, "step": STEP}
    return Entry(system, {**motion, "method": specification_of(METHOD)})

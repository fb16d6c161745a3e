"""Model files in generated folders of array systems, with tables of the arrays that it reads from files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from scvi_codegen.models.array_model import ArrayModel
from scvi_codegen.models.model_document import method_section
from scvi_codegen.models.sections import Section

__all__ = ["MODEL_FILE", "model_texts"]

MODEL_FILE = "model.toml"
STATES = {"q": "q", "p": "p", "q_dot": "velocity"}
"""Field of a model by key of the initial state."""


def model_texts(model: ArrayModel) -> dict[str, str]:
    """Return the model file and the tables that it refers to, by file name; empty for models not read from a file."""
    if model.document is None:
        return {}
    import tomli_w  # imported here: not needed for reading

    files = _Files()
    document = {**model.document, "method": {**method_section(model.method), "solver": model.solver}}
    for section, known in (("parameters", model.parameters), ("tables", model.tables)):
        if section in document:
            document[section] = files.section(section, document[section], known)
    initial = dict(document.get("initial", {}))
    for key, name in STATES.items():
        if key in initial:
            initial[key] = files.state(key, initial[key], getattr(model, name))
    text = tomli_w.dumps({**document, "initial": initial}, multiline_strings=True)
    return {MODEL_FILE: text, **files.texts}


class _Files:
    """Tables that replace references to files outside the folder."""

    def __init__(self) -> None:
        self.texts: dict[str, str] = {}

    def section(self, section: str, values: Section, known: Mapping[str, Any]) -> dict[str, Any]:
        """Return the values of a section, by declarations."""
        names = {key: key.partition("[")[0] for key in values}
        return {key: self.value(f"{section}_{names[key]}", values[key], known.get(names[key])) for key in values}

    def state(self, key: str, value: Any, known: Mapping[str, Any]) -> Any:
        """Return the value of one array, or of several by name."""
        if not isinstance(value, dict):
            return value
        if "file" in value:
            return self.value(key, value, next(iter(known.values())))
        return {name: self.value(f"{key}_{name}", entry, known[name]) for name, entry in value.items()}

    def value(self, name: str, value: Any, values: Any) -> Any:
        """Return a reference to a new table (or a list) for values read from a file, else the value itself."""
        if not isinstance(value, dict):
            return value
        if np.ndim(values) > 2:
            return np.asarray(values).tolist()
        columns = np.asarray(values).reshape(len(values), -1)
        head = [f"c{k}" for k in range(columns.shape[1])]
        lines = [",".join(head), *(",".join(map(repr, row)) for row in columns.tolist())]
        self.texts[f"model_{name}.csv"] = "\n".join(lines) + "\n"
        return {"file": f"model_{name}.csv"}

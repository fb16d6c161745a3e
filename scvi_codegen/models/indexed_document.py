"""The model file in a generated folder of sums over indices, with the arrays that it takes from files beside it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from scvi_codegen.models.indexed_model import IndexedModel
from scvi_codegen.models.model_document import method_section
from scvi_codegen.models.sections import Section

__all__ = ["MODEL_FILE", "model_texts"]

MODEL_FILE = "model.toml"
STATES = {"q": "q", "p": "p", "q_dot": "velocity"}
"""What each key of the initial state is called by a model."""


def model_texts(model: IndexedModel) -> dict[str, str]:
    """The model file and the tables that it names, by their names; nothing of a model that was not read from a file."""
    if model.document is None:
        return {}
    import tomli_w  # here, because reading does not need it

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
    """Tables in place of files that stand elsewhere."""

    def __init__(self) -> None:
        self.texts: dict[str, str] = {}

    def section(self, section: str, given: Section, known: Mapping[str, Any]) -> dict[str, Any]:
        """The values of a section, by declarations."""
        names = {key: key.partition("[")[0] for key in given}
        return {key: self.value(f"{section}_{names[key]}", given[key], known.get(names[key])) for key in given}

    def state(self, key: str, given: Any, known: Mapping[str, Any]) -> Any:
        """What is said of one array, or of several by name."""
        if not isinstance(given, dict):
            return given
        if "file" in given:
            return self.value(key, given, next(iter(known.values())))
        return {name: self.value(f"{key}_{name}", value, known[name]) for name, value in given.items()}

    def value(self, name: str, given: Any, values: Any) -> Any:
        """A table of columns for what was read from a file, or a list where it has more axes; else what was given."""
        if not isinstance(given, dict):
            return given
        if np.ndim(values) > 2:
            return np.asarray(values).tolist()
        columns = np.asarray(values).reshape(len(values), -1)
        head = [f"c{k}" for k in range(columns.shape[1])]
        lines = [",".join(head), *(",".join(map(repr, row)) for row in columns.tolist())]
        self.texts[f"model_{name}.csv"] = "\n".join(lines) + "\n"
        return {"file": f"model_{name}.csv"}

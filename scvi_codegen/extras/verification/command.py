"""Command ``scvi-codegen verify``: the certificate of a model, or of the C code in a generated folder."""

import json
from collections.abc import Mapping
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from scvi_codegen.api.commands import check_writable, model_arguments, note, read_model, reporting, tell
from scvi_codegen.common.errors import PackageError
from scvi_codegen.extras.verification import Certificate
from scvi_codegen.extras.verification import verify as measured
from scvi_codegen.interfaces.models.model import Model
from scvi_codegen.interfaces.models.packages.package import load_package
from scvi_codegen.runs.stepper import Stepper

MODEL_FILE, CERTIFICATE_FILE = "model.toml", "certificate.json"
"""Files of a generated folder."""


@click.command()
@model_arguments("solver")
@click.option("-o", "--output", type=click.Path(), metavar="FILE", help="Write the certificate as JSON.")
@reporting
def verify(model_name: str, output: str | None, **choices: Any) -> None:
    """Measure the guaranteed properties of the integrator of MODEL; exit status 1 if one is violated.

    MODEL may also be a folder written by 'generate': then its C code is measured. A step is compared with the paper's
    equations solved in 60 digits, and these with the exact motion. Order, symplecticity, reversibility, momentum maps,
    Newton's matrix and identities between methods are measured; if the model has a tolerance or a time transformation,
    also runs with these steps. Array models are measured on a few indices, compared with the unrolled system, and at
    full size. The JSON is written into the folder or next to the model file.

    \b
    Examples:
      scvi-codegen verify kepler --method scvi:3
      scvi-codegen verify kepler --time-transformation distance
      scvi-codegen verify mine.toml
      scvi-codegen generate mine.toml -o mine_svi
      scvi-codegen verify mine_svi
    """
    path = _certificate_path(model_name) if output is None else Path(output)
    if path is not None:
        check_writable(path, "'-o'")
    certificate = _verified(model_name, choices)
    tell(certificate.to_text(), nl=False, **json.loads(certificate.to_json()))
    if path is not None:
        certificate.save(path)
        note(f"wrote {path}")
    if not certificate.passed:
        raise click.ClickException(f"violated: {', '.join(check.name for check in certificate.violated)}")


def _verified(name: str, choices: Mapping[str, Any]) -> Certificate:
    """Return the certificate of a model file, a system of the catalogue or a generated folder."""
    folder = Path(name)
    if not folder.is_dir():
        model = read_model(name, choices)
        if model.array_system is not None and (model.h is None or model.array_system.constraints):
            model = model.with_known_sizes("verify (adaptive steps, constraints)")
        model._check_double("a certificate")
        model._check_located("a certificate")
        model = replace(model, method=copy(model.method))  # named, so that runs with a tolerance have it, too
        return _certificate(model, model.stepper())
    if not (folder / MODEL_FILE).is_file():
        raise PackageError(
            f"{folder} has no {MODEL_FILE}, which defines its guaranteed properties: generate it from a model"
        )
    model, own = (read_model(str(folder / MODEL_FILE), options) for options in (choices, {}))
    if (model.method, model.solver) != (own.method, own.solver):
        raise click.UsageError(f"'{name}' is a generated folder: its method and solver are those it was generated with")
    return _certificate(model, load_package(folder))


def _certificate(model: Model, stepper: Stepper) -> Certificate:
    state = model.initial_state(stepper)
    if model.array_system is not None:
        arguments: dict[str, Any] = {"h": model.step, "parameters": model.fields}
    else:
        arguments = {"h": model.first_step_size(stepper), "tolerance": model.allowed_error, "solver": model.solver}
    return measured(model.system, model.method, **state, **arguments, stepper=stepper)


def _certificate_path(name: str) -> Path | None:
    """Return the default path of the certificate, in the folder or next to the model file; else ``None``."""
    path = Path(name)
    if path.is_dir():
        return path / CERTIFICATE_FILE
    return path.with_suffix(f".{CERTIFICATE_FILE}") if path.is_file() else None

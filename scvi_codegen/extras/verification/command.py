"""Command ``scvi-codegen verify``: the certificate of a model, or of the C code in a generated folder."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from scvi_codegen.api.commands import check_writable, model_arguments, read_model, reporting, tell, with_known_sizes
from scvi_codegen.common.errors import PackageError
from scvi_codegen.extras import verification
from scvi_codegen.extras.verification import Certificate
from scvi_codegen.interfaces.cli.command_group import CommandFailure, note
from scvi_codegen.interfaces.cli.model_options import Choices, sections_of
from scvi_codegen.interfaces.models.model import DEFAULT_METHOD, Model
from scvi_codegen.interfaces.models.model_files.model_file import load_model
from scvi_codegen.interfaces.models.options import METHOD_KEYS
from scvi_codegen.interfaces.models.packages.package import CERTIFICATE_FILE, MODEL_FILE, load_package
from scvi_codegen.methods import SVI
from scvi_codegen.runs.stepper import Stepper


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
        raise CommandFailure(f"violated: {', '.join(check.name for check in certificate.violated)}")


def _verified(name: str, choices: Choices) -> Certificate:
    """Return the certificate of a model file, a system of the catalogue or a generated folder."""
    folder = Path(name)
    if not folder.is_dir():
        model = read_model(name, choices)
        if model.array_system is not None and (model.h is None or model.array_system.constraints):
            model = with_known_sizes(model, "verify (adaptive steps, constraints)")
        model._check_double("a certificate")
        if model.method is DEFAULT_METHOD:  # of this one
            model = replace(model, method=SVI(8))
        return _certificate(model, model.stepper())
    if choices["solver"] != "auto" or any(choices[choice] is not None for choice in METHOD_KEYS):
        raise click.UsageError(f"'{name}' is a generated folder: its method and solver are those it was generated with")
    if not (folder / MODEL_FILE).is_file():
        raise PackageError(
            f"{folder} has no {MODEL_FILE}, which defines its guaranteed properties: generate it from a model"
        )
    return _certificate(load_model(folder / MODEL_FILE, sections_of(choices)), load_package(folder))


def _certificate(model: Model, stepper: Stepper) -> Certificate:
    state = model.initial_state(stepper)
    if model.array_system is not None:
        arguments: dict[str, Any] = {"h": model.step, "parameters": model.fields}
    else:
        arguments = {"h": model.first_step_size(stepper), "tolerance": model.allowed_error, "solver": model.solver}
    return verification.verify(model.system, model.method, **state, **arguments, stepper=stepper)


def _certificate_path(name: str) -> Path | None:
    """Return the default path of the certificate, in the folder or next to the model file; else ``None``."""
    path = Path(name)
    if path.is_dir():
        return path / CERTIFICATE_FILE
    return path.with_suffix(f".{CERTIFICATE_FILE}") if path.is_file() else None

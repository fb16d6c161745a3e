"""Ensembles on a cluster: :func:`integrate_ensemble` of the extra ``distributed``."""

from typing import Any

from scvi_codegen.common.registry import part


def __getattr__(name: str) -> Any:
    if name != "integrate_ensemble":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return part("services", name)

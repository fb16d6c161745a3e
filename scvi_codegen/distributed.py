"""Ensembles over a cluster, by the path that programs import (:mod:`scvi_codegen.runtime.distributed`)."""

from scvi_codegen.runtime.distributed import integrate_ensemble as integrate_ensemble

"""Import path of :mod:`scvi_codegen.runtime.distributed` for user programs."""

from scvi_codegen.runtime.distributed import integrate_ensemble as integrate_ensemble

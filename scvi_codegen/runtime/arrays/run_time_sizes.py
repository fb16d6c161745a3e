"""Features that steppers, runs and trajectories of arrays lack if sizes are known at run time only."""

from __future__ import annotations

from typing import Any, ClassVar

from scvi_codegen.errors import MethodError
from scvi_codegen.indices import SIZES_REQUIRED

__all__ = ["RunTimeSizes"]


class UnavailableError(MethodError, AttributeError):
    """Error of a feature that requires known sizes; ``hasattr`` is false."""


class RunTimeSizes:
    """Base class of objects that lack features of the same objects with known sizes.

    Attributes:
        COUNTERPART: the class whose public members are the features.
    """

    __slots__ = ()
    COUNTERPART: ClassVar[type]
    REQUIRES_SIZES: ClassVar[str] = SIZES_REQUIRED

    def __getattr__(self, name: str) -> Any:
        if not name.startswith("_") and hasattr(self.COUNTERPART, name):
            raise UnavailableError(f"{name} is not available for {type(self).__name__}: {SIZES_REQUIRED}")
        raise AttributeError(f"'{type(self).__name__}' has no attribute '{name}'")

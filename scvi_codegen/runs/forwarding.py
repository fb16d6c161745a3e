"""Methods of steppers, runs and ensembles that extras add (:mod:`scvi_codegen.common.registry`)."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from scvi_codegen.common.registry import homes, part


class Forwarded:
    """Member of a class of an extra, which is imported at its first use; ``change``: function of this member."""

    def __init__(self, kind: str, name: str, change: Callable[..., Any] = lambda member: member) -> None:
        self.kind, self.name, self.change = kind, name, change

    def __get__(self, instance: Any, owner: Any = None) -> Any:
        return self.change(part(self.kind, self.name)).__get__(instance, owner)


if TYPE_CHECKING:
    from scvi_codegen.extras.chaos import methods as chaos
    from scvi_codegen.extras.paths import methods as paths
    from scvi_codegen.extras.pictures import methods as pictures

    class OfSteppers(paths.OfSteppers, chaos.OfSteppers): ...  # noqa: D101

    class OfRuns(chaos.OfRuns, pictures.OfRuns): ...  # noqa: D101

    OfEnsembles = pictures.OfRuns
else:
    OfSteppers, OfRuns, OfEnsembles = (
        type(f"Of{kind.capitalize()}", (), {"__slots__": (), **{name: Forwarded(kind, name) for name in homes(kind)}})
        for kind in ("steppers", "runs", "ensembles")
    )

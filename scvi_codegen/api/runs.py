"""States along runs, and how runs are judged.

``STEPPER``
    Kind of an argument that is a compiled stepper.
``EnsembleSettings``
    The arguments of ``integrate_ensemble`` but the initial states, checked for one stepper. StateError.
``without_accuracy_warnings()``
    Context or decorator without AccuracyWarning, for large steps on purpose.
"""

from scvi_codegen.runs.accuracy.warning_switch import without_accuracy_warnings
from scvi_codegen.runs.ensembles.ensemble import EnsembleSettings
from scvi_codegen.runs.stepper import STEPPER

__all__ = ["STEPPER", "EnsembleSettings", "without_accuracy_warnings"]

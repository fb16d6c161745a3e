"""How runs are judged.

``without_accuracy_warnings()``, ``warnings_wanted()``
    Context or decorator without AccuracyWarning, for large steps on purpose; whether they are wanted.
"""

from scvi_codegen.runs.accuracy.warning_switch import warnings_wanted, without_accuracy_warnings

__all__ = ["warnings_wanted", "without_accuracy_warnings"]

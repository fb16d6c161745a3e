"""How runs are judged, and what a product does with a stepper.

``Products``
    ``stepper.products``: checks, states and their tangent vectors, inputs, further C of its steps, blocks of ensembles;
    ``Products.RESOLVED`` and ``Products.LOST`` say when differences count and digits are lost.
``without_accuracy_warnings()``
    Context or decorator without AccuracyWarning, for large steps on purpose; ``Products.warnings_wanted()``: whether.
"""

from scvi_codegen.runs.accuracy.warning_switch import without_accuracy_warnings
from scvi_codegen.runs.products import Products

__all__ = ["Products", "without_accuracy_warnings"]

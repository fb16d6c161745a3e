"""How runs are judged, and what a product does with a stepper.

``Products``
    ``stepper.products``: checks, reduced states, inputs, further C of its steps, blocks of ensembles;
    ``Products.RESOLVED`` and ``Products.LOST`` say when differences count and digits are lost.
``without_accuracy_warnings()``, ``warnings_wanted()``
    Context or decorator without AccuracyWarning, for large steps on purpose; whether they are wanted.
"""

from scvi_codegen.runs.accuracy.warning_switch import warnings_wanted, without_accuracy_warnings
from scvi_codegen.runs.products import Products

__all__ = ["Products", "warnings_wanted", "without_accuracy_warnings"]

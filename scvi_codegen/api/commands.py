"""Commands of the command line: a function in ``command.py`` of an extra, decorated by click.

``reporting(command)``
    Decorator: options ``--json`` and ``--quiet``; errors of the package become messages and exit statuses.
``tell(text, *, nl, **numbers)``
    Print a text, with ``--json`` add the numbers to the document.
``check_writable(path, hint)``
    Error of usage unless a file can be written, before a long computation.
``model_arguments(*further)``, ``read_model(name, choices)``, ``with_known_sizes(model, option)``
    Decorator of the argument MODEL and its options; the model of these; the model in named coordinates.
"""

from scvi_codegen.interfaces.cli.command_group import check_writable, reporting, tell
from scvi_codegen.interfaces.cli.model_options import model_arguments, read_model, with_known_sizes

__all__ = ["check_writable", "model_arguments", "read_model", "reporting", "tell", "with_known_sizes"]

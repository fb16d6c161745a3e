"""Commands of the command line: a function in ``command.py`` of an extra, decorated by click.

``reporting(command)``
    Decorator: options ``--json`` and ``--quiet``; errors of the package become messages and exit statuses.
``tell(text, *, nl, **numbers)``, ``note(text)``
    Print a text, with ``--json`` add the numbers to the document; print a remark to stderr, unless ``--quiet``.
``check_writable(path, hint, *, states)``
    Error of usage unless a file can be written, of ``states`` also in its format, before a long computation.
``progress_bar(steps, label)``
    Context of a bar on a terminal: a function of the number of completed steps and a text beside it.
``model_arguments(*further)``, ``read_model(name, choices, unused=)``
    Decorator of the argument MODEL and its options; the ``Model`` of these, whose file may lack the keys that a
    function of its sections returns.
``ModelSection(keys, system, initial, check)``
    A section of model files, in ``section.py`` of an extra, with the checks of keys and numbers, ModelFileError.
``part(kind, name)``
    What another extra adds (``common/registry.py`` lists kinds and names), also one below. MissingLibraryError.

A ``click.ClickException`` ends a command with status 1, ``KeyboardInterrupt`` with 130.
"""

from scvi_codegen.common.registry import part
from scvi_codegen.interfaces.cli.command_group import check_writable, note, reporting, tell
from scvi_codegen.interfaces.cli.model_options import model_arguments, read_model
from scvi_codegen.interfaces.cli.supervision import progress_bar
from scvi_codegen.interfaces.models.model_files.sections import ModelSection

__all__ = [
    "ModelSection",
    "check_writable",
    "model_arguments",
    "note",
    "part",
    "progress_bar",
    "read_model",
    "reporting",
    "tell",
]

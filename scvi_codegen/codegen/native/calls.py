"""C functions that take the arguments of a run as one struct, added to a source when it is compiled for Python.

cffi converts each argument of a call at a cost of .05 microseconds. The struct is filled once per run, and the results
of a short run are read at once. The texts are ``templates/calls.h`` and ``calls_declarations.h``, read without Jinja2,
which programs that only load compiled steppers do not import.
"""

import re
from dataclasses import replace
from functools import cache
from struct import Struct

from scvi_codegen.codegen.rendering.source import Source
from scvi_codegen.common.cache import template_folder

RESULTS, FIRST_RESULT = Struct("=4d4q"), "error"
"""Format of the last fields of the struct (``calls_declarations.h``), and the first of them."""
OPTIONAL_FUNCTIONS = frozenset(("advance_to", "set_fallback", "project"))
"""Functions that not all integrators have, HAS_.. in ``calls.h`` like the optional fields of a run."""


def with_calls(source: Source) -> Source:
    """Return a source of runs with the functions of calls; others unchanged."""
    if "advance" not in source.contents.functions:
        return source
    declarations, functions = (
        re.sub(r"NAME\((\w+)\)", rf"{source.prefix}_\1", _text(name)) for name in ("calls_declarations", "calls")
    )
    present = [name for name in source.contents.functions if name in OPTIONAL_FUNCTIONS]
    switches = "".join(f"#define HAS_{name.upper()}\n" for name in (*present, *source.contents.run_fields))
    return replace(
        source,
        code=f"{source.code}\n{switches}{declarations}\n{functions}",
        declarations=f"{source.declarations}\n{declarations}",
    )


@cache
def _text(name: str) -> str:
    return (template_folder() / f"{name}.h").read_text(encoding="utf-8")

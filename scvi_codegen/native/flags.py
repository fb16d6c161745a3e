"""Compiler flags that a recorded run may contain: optimisation, precision, processor and warnings.

A flag can make a compiler run another program (``-wrapper``, ``-fplugin=``) or read and write files, so a folder from
somebody else may contain only these. Others can be set in the environment variable SCVI_CODEGEN_CFLAGS.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

ALLOWED = re.compile(
    r"-O([0123sgz]|fast)?|-g[0123]?|-W(no-)?[a-z][a-z-]*|-pthread"
    r"|-m(arch|tune|cpu)=[\w.+-]+|-m(no-)?(avx[\w.-]*|sse[\w.]*|fma4?|f16c|bmi2?|prefer-vector-width=\d+)"
    r"|-ffp-contract=(on|off|fast)|-fsanitize=[a-z,-]+|-D[A-Za-z_]\w*(=\d+)?"
    r"|-f(no-)?(math-errno|trapping-math|fast-math|signed-zeros|associative-math|reciprocal-math|finite-math-only"
    r"|rounding-math|unsafe-math-optimizations|unroll-loops|tree-vectorize|tree-slp-vectorize|inline|wrapv|gcse"
    r"|tree-pre"
    r"|strict-aliasing|omit-frame-pointer|schedule-insns2?|rerun-cse-after-loop|dse|lto)",
    re.ASCII,
)


def check_flags(flags: Sequence[str], error: type[ValueError] = ValueError) -> None:
    """Raise an error for a flag that is not allowed."""
    for flag in flags:
        if not isinstance(flag, str) or not ALLOWED.fullmatch(flag):
            raise error(
                f"the compiler flag {flag!r} is not allowed in a recorded run: allowed are flags of "
                "optimisation (-O2), "
                "floating point (-ffp-contract=off), processor (-march=native), definitions (-DNAME=1). Leave it out, "
                "or set it in the environment variable SCVI_CODEGEN_CFLAGS"
            )

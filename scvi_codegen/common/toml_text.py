"""Safe parsing of TOML of any origin: text that would exhaust memory, time or the parser is rejected.

Tables that belong to this package are TOML files beside its modules.
"""

import re
import tomllib
from collections.abc import Callable
from typing import Any

from scvi_codegen.common.cache import PACKAGE
from scvi_codegen.common.errors import ModelFileError

MAX_CHARACTERS = 1_000_000
MAX_BITS = 4096
"""Maximum number of bits of an integer: Python does not print longer ones. TOML's have 64."""
LONG_KEY = re.compile(r"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){32}""")
"""Keys with many dots; the time of the parser grows with the square of their number."""


def read_toml(text: str, parse_float: Callable[[str], float] = float) -> dict[str, Any]:
    """Return the document in a text, its real numbers by ``parse_float``; ModelFileError if invalid or too large."""
    if len(text) > MAX_CHARACTERS:
        raise ModelFileError(f"the file has {len(text)} characters: the limit is {MAX_CHARACTERS}")
    if LONG_KEY.search(text):
        raise ModelFileError("this is not a file of this program: a key has more than 32 words between dots")
    try:
        document = tomllib.loads(text, parse_float=parse_float)
    except tomllib.TOMLDecodeError as error:
        raise ModelFileError(f"this is not TOML: {error}") from error
    except RecursionError:
        raise ModelFileError("this is not a file of this program: lists or tables are nested too deeply") from None
    except ValueError as error:  # Python's limit for the digits of an integer
        raise ModelFileError(f"this is not TOML: a number is too long ({error})") from error
    pending: list[Any] = [document]
    while pending:
        item = pending.pop()
        if isinstance(item, dict):
            pending.extend(item.values())
        elif isinstance(item, list):
            pending.extend(item)
        elif isinstance(item, int) and item.bit_length() > MAX_BITS:
            raise ModelFileError(f"this is not TOML: a whole number has {item.bit_length()} bits, more than {MAX_BITS}")
    return document


def package_table(path: str) -> dict[str, Any]:
    """Return the document in a file of this package, as ``"interfaces/models/problems.toml"``."""
    return tomllib.loads((PACKAGE / path).read_text(encoding="utf-8"))

"""The certificates of cases, with the code as it stands: status 1 at the first broken one, 3 if there is none."""

import json
import sys

from certified_cases import case
from samples import QUICK_FLAGS

from scvi_codegen import BuildError, compile_stepper, verify


def certify(names: list[str]) -> None:
    for name in names:
        own = case(name)
        try:
            certificate = verify(own.system, own.method(), own.q, own.p, h=own.h)
        except (BuildError, SyntaxError, NameError) as error:
            print(f"{type(error).__name__}: {' '.join(str(error).split())[:120]}")
            sys.exit(3)
        if certificate.violated:
            print(f"BROKEN {name}: {', '.join(check.name for check in certificate.violated)}")
            sys.exit(1)


def templates(name: str) -> list[str]:
    """What the C of a case is made from."""
    own = case(name)
    stepper = compile_stepper(own.system, own.method(), flags=QUICK_FLAGS)
    texts = (stepper.source, stepper.ensemble, stepper.fallback, stepper.derivatives)
    return sorted({file for text in texts if text for file in text.files if file.startswith("support/")})


if __name__ == "__main__":
    if sys.argv[1] == "--list":
        print(json.dumps({name: templates(name) for name in sys.argv[2:]}))
    else:
        certify(sys.argv[1:])

"""Record the C sources of the cells, all or those named, as ``python tests/tools/record_golden.py [cell ...]``.

Do so where results change on purpose: say in the commit which bits changed, and why.
"""

import json
import lzma
import sys
from dataclasses import asdict
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[1] / name) for name in ("tools", "oracles")]

from golden_cells import CELLS, RECORDED, TIMED, program, recorded  # noqa: E402  (the path comes first)


def main(names: list[str]) -> None:
    before = recorded() if names else {}
    made = {name: program(name) if name in names or name not in before else before[name] for name in CELLS | TIMED}
    text = json.dumps({name: asdict(each) for name, each in made.items()})
    RECORDED.write_bytes(lzma.compress(text.encode(), preset=9 | lzma.PRESET_EXTREME))


if __name__ == "__main__":
    main(sys.argv[1:])

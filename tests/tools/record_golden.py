"""Record the C sources of the cells, all or those named, as ``python tests/tools/record_golden.py [cell ...]``.

Do so where results change on purpose: say in the commit which bits changed, and why. With ``--states`` first, record
the states of scenes with contacts and of robots instead: those of a new scene, not where bits of others change.
"""

import json
import lzma
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).parents[1] / name) for name in ("tools", "oracles")]

from golden_cells import RECORDED, RECORDED_CELLS, output, program, recorded  # noqa: E402  (the path comes first)
from golden_scenes import SCENES, STATES, digest, states_of  # noqa: E402


def record_states(names: list[str]) -> None:
    """Record the states of the scenes named, which must be insensitive, or of all."""
    states = dict(np.load(STATES)) if names else {}
    for name in names or [name for name, scene in SCENES.items() if scene.within]:
        made = program(name)
        with tempfile.TemporaryDirectory() as folder:
            states[name] = states_of(output(made, Path(folder)))
        states[f"{name} source"] = np.array(digest(made.files))
    np.savez_compressed(STATES, **states)


def main(names: list[str]) -> None:
    if names[:1] == ["--states"]:
        record_states(names[1:])
        return
    before = recorded() if names else {}
    made = {name: program(name) if name in names or name not in before else before[name] for name in RECORDED_CELLS}
    text = json.dumps({name: asdict(each) for name, each in made.items()})
    RECORDED.write_bytes(lzma.compress(text.encode(), preset=9 | lzma.PRESET_EXTREME))


if __name__ == "__main__":
    main(sys.argv[1:])

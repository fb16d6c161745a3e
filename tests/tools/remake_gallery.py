"""Redraw the pictures of ``docs/gallery`` and update the printed output by running the code of its pages.

python tests/tools/remake_gallery.py                 all of them
python tests/tools/remake_gallery.py figure_eight    one
"""

import os
import shutil
import sys
import tempfile
from pathlib import Path

import matplotlib as mpl
import pytest
from pages import ROOT, run_page, runnable

GALLERY = ROOT / "docs" / "gallery"


def remake(page: Path) -> None:
    """Run a page, replace its output blocks and copy its pictures."""
    text = page.read_text(encoding="utf-8")
    heard: list[tuple[str, str]] = []
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        parts = list(runnable(text))
        run_page(page.name, parts, Path(folder), patch, lambda *both: heard.append(both))
        for picture in Path(folder).glob("*.svg"):
            shutil.copy(picture, GALLERY)
            print(picture.name, picture.stat().st_size)
    for message, printed in heard:
        text = text.replace(f"```text\n{message}```", f"```text\n{printed}```", 1)
    page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    os.environ["SOURCE_DATE_EPOCH"] = "0"  # so that equal pictures are equal files
    mpl.rcParams["svg.hashsalt"] = "gallery"
    for chosen in sys.argv[1:] or sorted(page.stem for page in GALLERY.glob("*.md") if page.stem != "index"):
        remake(GALLERY / f"{chosen}.md")

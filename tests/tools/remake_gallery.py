"""Redraw the pictures of pages of ``docs`` and update the printed output by running the code of these pages.

python tests/tools/remake_gallery.py                         the gallery
python tests/tools/remake_gallery.py gallery/kdv events      two pages
"""

import os
import shutil
import sys
import tempfile
from pathlib import Path

import matplotlib as mpl
import pytest
from pages import ROOT, run_page, runnable

DOCS = ROOT / "docs"


def remake(page: Path) -> None:
    """Run a page, replace its output blocks and copy its pictures."""
    text = page.read_text(encoding="utf-8")
    heard: list[tuple[str, str]] = []
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        parts = list(runnable(text))
        run_page(page.name, parts, Path(folder), patch, lambda *both: heard.append(both))
        for picture in Path(folder).glob("*.svg"):
            shutil.copy(picture, page.parent)
            print(picture.name, picture.stat().st_size)
    for message, printed in heard:
        text = text.replace(f"```text\n{message}```", f"```text\n{printed}```", 1)
    page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    os.environ["SOURCE_DATE_EPOCH"] = "0"  # so that equal pictures are equal files
    mpl.rcParams["svg.hashsalt"] = "gallery"
    gallery = sorted(f"gallery/{page.stem}" for page in DOCS.glob("gallery/*.md") if page.stem != "index")
    for name in sys.argv[1:] or gallery:
        remake(DOCS / f"{name}.md")

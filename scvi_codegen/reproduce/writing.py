"""Files of a result: NAME.svg, NAME.png, NAME.csv, and NAME.txt with the statement; each written atomically."""

from __future__ import annotations

import csv
import io
import textwrap
from pathlib import Path

from scvi_codegen.files.atomic import write_atomically
from scvi_codegen.pictures.canvas import write_figure
from scvi_codegen.reproduce.laboratory.drawing import STYLE
from scvi_codegen.reproduce.laboratory.experiment import (
    Block,
    Formula,
    Listing,
    Paragraph,
    Picture,
    Result,
    TableBlock,
)

WIDTH = 100


def write_result(result: Result, folder: Path) -> list[Path]:
    """Write the files of a result into an existing folder; return their paths."""
    written = []

    def write(name: str, content: bytes) -> None:
        path = folder / name
        write_atomically(path, lambda file: file.write(content))
        written.append(path)

    if result.picture is not None:
        write(f"{result.name}.svg", draw(result.picture, "svg"))
        write(f"{result.name}.png", draw(result.picture, "png"))
    for table in result.tables:
        write(f"{'-'.join(filter(None, (result.name, table.name)))}.csv", csv_text(table).encode())
    write(f"{result.name}.txt", statement(result).encode())
    return written


def draw(picture: Picture, kind: str) -> bytes:
    """Return the bytes of a picture, ``kind`` being ``"svg"`` or ``"png"``; equal results give equal bytes."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    file = io.BytesIO()
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(picture.width, picture.height))
        picture.draw(figure)
        write_figure(figure, file, kind)
    return file.getvalue()


def csv_text(table: TableBlock) -> str:
    """Return CSV with a line of headings; floats in full precision."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(table.columns)
    writer.writerows(["" if cell is None else cell for cell in row] for row in table.rows)
    return file.getvalue()


def statement(result: Result) -> str:
    """Return setting, claims and measurements as text."""
    lines = [f"{result.name}: {result.title}", f"verdict: {result.verdict.value}", ""]
    lines += [line for sentence in result.setting for line in _wrapped(sentence)]
    for check in result.checks:
        lines += ["", *_wrapped(f"paper:    {check.claim}"), *_wrapped(f"measured: {check.measured}")]
        lines += [f"verdict:  {check.verdict.value}"]
    for block in result.body:
        lines += ["", *_block_lines(block)]
    return "\n".join(lines) + "\n"


def _block_lines(block: Block) -> list[str]:
    match block:
        case Paragraph():
            return _wrapped(block.text)
        case Listing():
            return [f"    {line}".rstrip() for line in block.text.splitlines()]
        case Formula():
            left = "" if block.left is None else f"{block.left} = "
            number = f"    ({block.number})" if block.number else ""
            return [f"    {left}{block.right}{number}"]


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(text, WIDTH, subsequent_indent="  ")

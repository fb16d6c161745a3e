"""What commands ask of pictures: whether a file of that name can be written, and whether it is a film."""

from pathlib import Path

from scvi_codegen.extras.pictures.animation import FILMS
from scvi_codegen.extras.pictures.canvas import PICTURES, check_plot_path


def check_picture(path: str, *, films: bool = False) -> None:
    """Check before a long run that a picture, or a film, can be written; raises as :func:`check_plot_path`."""
    check_plot_path(path, PICTURES + FILMS if films else PICTURES)


def is_film(path: str) -> bool:
    """Return whether the name of a file is that of a film."""
    return Path(path).suffix.lower() in FILMS

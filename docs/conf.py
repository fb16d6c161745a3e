"""Sphinx configuration: ``python -m sphinx -W -j auto docs site`` builds the site without network access.

``-t online`` adds links to the documentation of Python, NumPy, SciPy and SymPy, whose object inventories are fetched.
"""

import sys
from pathlib import Path

from scvi_codegen.version import __version__

sys.path.insert(0, str(Path(__file__).parent / "_extensions"))

project = "scvi_codegen"
copyright = "the authors of scvi_codegen, MIT licence"  # noqa: A001  (Sphinx's name)
release = version = __version__
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.intersphinx",
    "mathml",
    "motions",
    "notebooks",
    "public_names",
    "search_words",
    "thumbnails",
]
exclude_patterns = ["_extensions", "motions"]

html_theme = "furo"
html_title = f"scvi_codegen {release}"
html_logo = html_favicon = "_static/logo.svg"
html_copy_source = html_show_sourcelink = False
html_static_path = ["_static", "../templates/mathematics"]
html_css_files = ["site.css"]
html_search_scorer = str(Path(__file__).parent / "_extensions" / "search_scorer.js")

myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3

autodoc_typehints = "signature"
maximum_signature_line_length = 90
autodoc_type_aliases = {
    name: name
    for name in (
        "Array",
        "ArrayLike",
        "Parameters",
        "EnsembleParameters",
        "Vector",
        "Number",
    )
}
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
napoleon_attr_annotations = False
napoleon_use_rtype = False

intersphinx_mapping = (
    {
        "python": ("https://docs.python.org/3", None),
        "numpy": ("https://numpy.org/doc/stable", None),
        "scipy": ("https://docs.scipy.org/doc/scipy", None),
        "sympy": ("https://docs.sympy.org/latest", None),
    }
    if tags.has("online")  # noqa: F821  (Sphinx's)
    else {}
)

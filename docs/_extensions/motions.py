"""Directive ``motion``: a page that moves, embedded in a page of the site.

The option ``model`` is the path of a model file, ``picture`` the image for readers without scripts and for sites built
without the extra ``compiler``. Pages are loaded when they become visible.

The directive ``motions`` shows one of several such pages, by choice; ``write-your-own`` writes the model file of a
Lagrangian that the visitor types (``_static/motions.js``).
"""

import hashlib
import html
import os
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.parsers.rst import directives
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.util.docutils import SphinxDirective

from scvi_codegen import page

__all__ = ["setup"]

FOLDER = "moving"
CAN_COMPILE = find_spec("ziglang") is not None
HERE = Path(__file__).parent
MADE_OF = b"".join(
    path.read_bytes()
    for path in sorted((HERE.parents[1] / "templates/page").iterdir())
    + [
        path
        for name in ("pages", "pictures")
        for path in sorted(
            (HERE.parents[1] / "scvi_codegen" / "extras" / name).glob("*.py")
        )
    ]
)
"""Sources of a page besides its model: a page is written again when they change."""
LOGGER = logging.getLogger(__name__)


class motion(nodes.General, nodes.Element):  # noqa: N801  (docutils names nodes in lower case)
    """A page that moves: name, title, path and text of the model file; its child is the picture."""


class motions(nodes.General, nodes.Element):  # noqa: N801
    """A choice of pages that move; its children are of class ``motion``."""


class MotionDirective(SphinxDirective):
    """One page that moves."""

    required_arguments = 1
    final_argument_whitespace = True
    option_spec = {  # noqa: RUF012  (docutils reads the class attribute)
        "picture": directives.unchanged_required,
        "model": directives.unchanged_required,
    }

    def run(self) -> list[nodes.Node]:
        """Return the page, or its picture if pages cannot be compiled."""
        relative, path = self.env.relfn2path(self.options["model"])
        self.env.note_dependency(relative)
        text = Path(path).read_text(encoding="utf-8")
        title = self.arguments[0]
        key = hashlib.sha256(text.encode() + MADE_OF).hexdigest()[:8]
        name = f"{nodes.make_id(title)}-{key}"
        node = motion("", name=name, title=title, model=path, text=text)
        if "picture" in self.options:
            node += nodes.image(uri=self.options["picture"], alt=title)
        return [node]


class MotionsDirective(SphinxDirective):
    """A choice of pages that move: the directives of the body."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        """Return the choice."""
        node = motions()
        self.state.nested_parse(self.content, self.content_offset, node)
        return [node]


OWN = """
<div id="own" class="own">
<label for="own-lagrangian">Lagrangian</label>
<textarea id="own-lagrangian" rows="3" spellcheck="false">m*l**2*theta_dot**2/2 + m*g*l*cos(theta)</textarea>
<div class="values" role="group" aria-label="Values of parameters and initial values"></div>
<p class="note" role="status" hidden></p>
<pre tabindex="0" aria-label="Model file">[system]
name = "my system"
coordinates = ["theta"]
lagrangian = "m*l**2*theta_dot**2/2 + m*g*l*cos(theta)"

[parameters]
g = 9.81
l = 1.0
m = 1.0

[initial]
q = [0.5]
q_dot = [0.0]

[run]
step = 0.02
span = 20.0
</pre>
<button type="button">Copy</button>
</div>
"""


class OwnDirective(SphinxDirective):
    """A form that turns a Lagrangian into a model file; without scripts an example."""

    def run(self) -> list[nodes.Node]:
        """Return the form."""
        return [nodes.raw("", OWN, format="html")]


def _visit_motion(writer: Any, node: motion) -> None:
    """Write the frame and how to make the page; the picture is the child, without scripts or a compiler."""
    title = html.escape(node["title"])
    writer.body.append('<div class="motion">')
    if CAN_COMPILE:
        address = writer.builder.get_relative_uri(
            writer.builder.current_docname, "index"
        ).rpartition("/")[0]
        address = f"{address}/{FOLDER}/{node['name']}.html".lstrip("/")
        writer.body.append(
            f'<iframe loading="lazy" src="{address}" title="{title}: a page that moves"></iframe>'
        )
        writer.body.append(
            f'<p class="motion-links"><a href="{address}">{title} as a page of its own</a></p>'
        )
        writer.body.append("<noscript><style>.motion iframe { display: none }</style>")


def _depart_motion(writer: Any, node: motion) -> None:
    source = html.escape(node["text"])
    writer.body.append("</noscript>" if CAN_COMPILE else "")
    writer.body.append(
        f"<details><summary>Model file</summary><pre>{source}</pre></details></div>"
    )


def _visit_motions(writer: Any, node: motions) -> None:
    """Write one radio button a page; the style sheet shows the page of the one that is checked."""
    shown = [child for child in node.children if isinstance(child, motion)]
    writer.body.append(
        '<div class="motions" role="group" aria-label="Choice of a motion">'
    )
    for k, child in enumerate(shown):
        checked = " checked" if k == 0 else ""
        writer.body.append(
            f'<input type="radio" name="motions" id="motion{k}"{checked}>'
        )
        writer.body.append(
            f'<label for="motion{k}">{html.escape(child["title"])}</label>'
        )


def _depart_motions(writer: Any, node: motions) -> None:
    writer.body.append("</div>")


def _skip(writer: Any, node: nodes.Node) -> None:
    raise nodes.SkipNode


def _build_pages(app: Sphinx, failure: Exception | None) -> None:
    """Write the pages that are new; compiled code comes from the cache of the package."""
    if failure or app.builder.format != "html":
        return
    if not CAN_COMPILE:
        LOGGER.info(
            "pages that move are shown as pictures, without the extra compiler: "
            "pip install -e '.[docs,compiler]'"
        )
        return
    folder = Path(app.outdir, FOLDER)
    folder.mkdir(exist_ok=True)
    pages = {
        node["name"]: node
        for docname in sorted(app.env.found_docs)
        for node in app.env.get_doctree(docname).findall(motion)
        if not (folder / f"{node['name']}.html").exists()
    }
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(_write_page, pages.values(), [folder] * len(pages)))


def _write_page(node: motion, folder: Path) -> None:
    LOGGER.info("page that moves: %s", node["title"])
    page(node["model"]).save(folder / f"{node['name']}.html")


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the directives, and write the pages at the end of a build."""
    app.add_node(
        motion,
        html=(_visit_motion, _depart_motion),
        text=(_skip, None),
        latex=(_skip, None),
        man=(_skip, None),
    )
    app.add_node(
        motions,
        html=(_visit_motions, _depart_motions),
        text=(_skip, None),
        latex=(_skip, None),
    )
    app.add_directive("motion", MotionDirective)
    app.add_directive("motions", MotionsDirective)
    app.add_directive("write-your-own", OwnDirective)
    app.add_js_file("motions.js")
    app.connect("build-finished", _build_pages)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

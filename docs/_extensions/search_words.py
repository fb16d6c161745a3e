"""Search in other words than a page's: index entries in comments, British and American spelling, accents.

``<!-- index: neighbour list, Verlet list -->`` below a heading adds phrases that lead to its section, or below the
title to the page, in the search and in the general index. Viewers of Markdown do not show the comment.
"""

import json
import re
import unicodedata
from typing import Any

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.search.en import SearchEnglish
from sphinx.transforms import SphinxTransform

__all__ = ["setup"]

SPELLINGS = {
    r"(behavi|col|fav|harb|lab|neighb|vap)our": "$1or",
    r"\b(cent|fib|theat)re(s?)\b": "$1er$2",
    r"\b(cent|fib)red\b": "$1ered",
    r"is(e[ds]?|ing|ations?|ers?)\b": "iz$1",
    r"ys(e[ds]?|ing)\b": "yz$1",
    r"(model|travel|label|cancel|signal|level)l": "$1",
    r"(licen|defen)[cs]e": "$1se",
    r"(catal|anal)ogue": "$1og",
    r"programme\b": "program",
    r"\bdisc(s?)\b": "disk$1",
    r"\bgrey": "gray",
    r"\b(st|schr|s)oe(rmer|dinger|derlind)": "$1o$2",
}
"""Regular expression of a spelling and the spelling under which the search finds both."""
COMMENT = re.compile(r"\s*<!--\s+index: (.*?)\s+-->\s*", re.DOTALL)


def spelled(text: str) -> str:
    """Return a text in lower case, in American spelling and without accents."""
    text = "".join(
        c
        for c in unicodedata.normalize("NFD", text.lower())
        if not unicodedata.combining(c)
    )
    for spelling, other in SPELLINGS.items():
        text = re.sub(spelling, other.replace("$", "\\"), text)
    return text


STEMMER = """
const spellings = %s.map(([spelling, other]) => [new RegExp(spelling, "g"), other]);
const spelled = (text) => spellings.reduce(
  (text, [spelling, other]) => text.replace(spelling, other),
  text.toLowerCase().normalize("NFD").replace(/\\p{M}/gu, ""),
);
window.Stemmer = class {
  plain = new EnglishStemmer();
  stemWord = (word) => this.plain.stemWord(spelled(word));
};
"""


class English(SearchEnglish):
    """English with one spelling of each word, in the index and in the queries of the browser."""

    js_splitter_code = STEMMER % json.dumps([*SPELLINGS.items()])

    def stem(self, word: str) -> str:
        """Return the stem of a word in its common spelling."""
        return super().stem(spelled(word))


class IndexComments(SphinxTransform):
    """Replace comments by index entries of their section, and add their words to those of the page."""

    default_priority = 500

    def apply(self, **options: Any) -> None:
        """Transform the document in place."""
        for comment in [*self.document.findall(nodes.raw)]:
            found = COMMENT.fullmatch(comment.astext())
            if found is None:
                continue
            phrases = re.split(r",\s+", " ".join(found[1].split()))
            section = (
                comment.parent["ids"][0]
                if isinstance(comment.parent.parent, nodes.section)
                else ""
            )
            forms = dict.fromkeys(
                form for phrase in phrases for form in (phrase, spelled(phrase))
            )
            entries = [("single", form, section, "main", None) for form in forms]
            words = re.findall(r"\w+", " ".join(phrases))
            keywords = nodes.meta(name="keywords", content=", ".join(words))
            comment.replace_self([addnodes.index(entries=entries), keywords])


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the language of the search and the transformation of comments with Sphinx."""
    app.add_search_language(English)
    app.add_transform(IndexComments)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

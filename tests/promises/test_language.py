"""The words of the project are the field's: no retired term, no docstring that begins as a fragment."""

import re

import pytest
from language import (
    FRAGMENT,
    RETIRED_NAMES,
    RETIRED_PHRASES,
    ROOT,
    docstrings,
    identifiers,
    is_retired_in_tests,
    messages,
    names_in_tests,
    prose,
    unknown_arguments,
    words_of,
)

EXCEPTIONS: dict[str, str] = {}
"""Paths in which a retired term is right, with the reason."""


def place(text):
    return f"{text.path.relative_to(ROOT)}:{text.line}"


def excepted(text):
    return str(text.path.relative_to(ROOT)) in EXCEPTIONS


@pytest.mark.second
def test_docstrings_name_the_thing():
    found = list(docstrings())
    fragments = [f"{place(text)}: {text.text.splitlines()[0]}" for text in found if FRAGMENT.match(text.text)]
    assert len(found) > 3000
    assert fragments == []


def test_docstrings_describe_parameters_of_their_function():
    assert [f"{place(text)}: {text.text}" for text in unknown_arguments()] == []


def test_no_retired_term_is_read_anywhere():
    retired = re.compile("|".join(RETIRED_PHRASES), re.IGNORECASE)
    texts = list(prose())
    assert len(texts) > 10_000
    found = [f"{place(text)}: {hit[0]}" for text in texts if not excepted(text) for hit in retired.finditer(text.text)]
    assert found == []


def test_no_retired_term_is_a_name():
    found = {
        f"{place(text)}: {text.text}"
        for text in identifiers()
        if not excepted(text) and words_of(text.text) & RETIRED_NAMES
    }
    assert found == set()


def test_no_retired_term_is_a_name_in_tests():
    names = list(names_in_tests())
    assert len(names) > 20_000
    assert {f"{place(text)}: {text.text}" for text in names if is_retired_in_tests(text.text)} == set()


def test_messages_are_sentences():
    """Messages are found, and none is a single status word."""
    found = list(messages())
    assert len(found) > 800
    assert [place(text) for text in found if re.search(r"\b(vanished|strayed|stalled)\b", text.text)] == []

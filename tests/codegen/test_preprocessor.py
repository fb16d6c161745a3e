"""Partial preprocessing: which conditions, macros and headers remain in the text for readers."""

import pytest

from scvi_codegen.codegen.rendering.preprocessor import included, preprocessed

HEADERS = {
    "support/core/a.h": '#ifndef A_H\n#define A_H\n#ifdef FAST\n#include "b.h"\nfast;\n#else\nslow;\n#endif\n#endif\n',
    "support/core/b.h": '#ifndef B_H\n#define B_H\n#include "../run/c.h"\nb;\n#endif\n',
    "support/run/c.h": "#ifndef C_H\n#define C_H\nc;\n#endif\n",
}
INCLUDES = '#include "support/core/a.h"\nend;\n'


@pytest.mark.parametrize(
    ("text", "lines"),
    [
        ("#define X\n#ifdef X\na;\n#else\nb;\n#endif\n", "a;"),
        ("#ifndef X\na;\n#endif\n", "a;"),
        ("#define X\n#undef X\n#ifdef X\na;\n#endif\nb;\n", "#define X|#undef X|b;"),
        ("#define X\n#if !defined(X)\na;\n#elif defined(X)\nb;\n#else\nc;\n#endif\n", "b;"),
        ("#define N 4\n#if N < 5\na;\n#endif\n", "#define N 4|#if N < 5|a;|#endif"),
        ("#ifdef __GNUC__ /* kept */\na;\n#else\nb;\n#endif\n", "#ifdef __GNUC__ /* kept */|a;|#else|b;|#endif"),
        ("#define X\n#ifdef Y\na;\n#elif defined(SCVI_D)\nb;\n#elif defined(X)\nc;\n#else\nd;\n#endif\n",
         "#if defined(SCVI_D)|b;|#else|c;|#endif"),
        # defined in one alternative: the condition remains
        ("#ifdef __GNUC__\n#define X\n#endif\n#ifdef X\na;\n#endif\n",
         "#ifdef __GNUC__|#define X|#endif|#ifdef X|a;|#endif"),
        ("#ifdef __GNUC__\n#ifdef SCVI_A\n#define X\n#endif\n#endif\n#ifdef X\na;\n#endif\n",
         "#ifdef __GNUC__|#ifdef SCVI_A|#define X|#endif|#endif|#ifdef X|a;|#endif"),
        # defined in both, or where compilation does not fail
        ("#ifdef __GNUC__\n#define X\n#else\n#define X\n#endif\n#ifdef X\na;\n#endif\n",
         "#ifdef __GNUC__|#else|#endif|a;"),
        ("#ifdef __GNUC__\n#define X\n#else\n#error none\n#endif\n#ifdef X\na;\n#endif\n",
         "#ifdef __GNUC__|#else|#error none|#endif|a;"),
        # a condition that remained before: macros are those at its end
        ("#ifdef __GNUC__\n#define X\n#endif\n#ifdef __GNUC__\n#ifdef X\na;\n#endif\n#endif\n",
         "#ifdef __GNUC__|#endif|#ifdef __GNUC__|a;|#endif"),
        # certain again
        ("#ifdef __GNUC__\n#define X\n#endif\n#undef X\n#define X\n#ifdef X\na;\n#endif\n",
         "#ifdef __GNUC__|#define X|#endif|#undef X|#define X|a;"),
    ],
)  # fmt: skip
def test_alternatives_that_remain(text, lines):
    assert preprocessed(text, HEADERS.__getitem__).rstrip("\n") == lines.replace("|", "\n")


@pytest.mark.parametrize(("macros", "lines"), [("", "slow;\nend;\n"), ("#define FAST\n", "c;\nb;\nfast;\nend;\n")])
def test_headers_that_remain(macros, lines):
    read = HEADERS.__getitem__
    assert preprocessed(macros + INCLUDES, read) == lines
    assert [name for name, _ in included(macros + INCLUDES, read)] == [*HEADERS]

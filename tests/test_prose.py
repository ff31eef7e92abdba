"""The prose of the product: summaries name their subject, sentences name things."""

from __future__ import annotations

import ast
import re
import tokenize
from pathlib import Path

ROOT = Path(__file__).parents[1]

SOURCES = sorted((ROOT / "hapticbridge").rglob("*.py"))

OPENERS = re.compile(r"(What|How|Where|Whether|Which|Who|Whoever|Of|In)\b")
"""First words of a summary that does not name its subject."""

NOBODIES = re.compile(r"\b(nobody|somebody|whoever|likewise)\b", re.IGNORECASE)
"""Words that stand for something the sentence should name."""


def docstrings(tree: ast.Module) -> list[tuple[int, str]]:
    """Returns the line and text of every docstring, those of constants and fields included."""
    return [
        (node.lineno, node.value.value.strip())
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    ]


def test_no_docstring_opens_with_a_relative_clause() -> None:
    offences = [
        f"{path.relative_to(ROOT)}:{line}: {text.splitlines()[0]}"
        for path in SOURCES
        for line, text in docstrings(ast.parse(path.read_text(encoding="utf-8")))
        if OPENERS.match(text)
    ]
    assert not offences


def test_no_docstring_comment_or_message_speaks_of_nobody() -> None:
    offences = []
    for path in SOURCES:
        with tokenize.open(path) as file:
            offences += [
                f"{path.relative_to(ROOT)}:{token.start[0]}: {token.line.strip()}"
                for token in tokenize.generate_tokens(file.readline)
                if token.type in TEXTS and NOBODIES.search(token.string)
            ]
    assert not offences


TEXTS = {tokenize.COMMENT, tokenize.STRING, getattr(tokenize, "FSTRING_MIDDLE", tokenize.STRING)}
"""Kinds of tokens that people read."""

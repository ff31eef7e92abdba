"""The prose of the product: summaries name their subject, sentences name things."""

from __future__ import annotations

import ast
import re
import tokenize
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

ROOT = Path(__file__).parents[1]

SOURCES = sorted((ROOT / "hapticbridge").rglob("*.py"))

HELPERS = sorted([*(ROOT / "tests").rglob("*.py"), *(ROOT / "scripts").rglob("*.py")])

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
        for path in [*SOURCES, *HELPERS]
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


POINTER = re.compile(r"``([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)+)(?:\(\))?``")
"""Dotted name in a docstring, such as ``law.slack_gains``."""

NOT_OURS = {
    "mujoco.introspect",
    "mujoco.set_mjcb_time",
    "hapticbridge.meta",
    "hapticbridge.events",
    "hapticbridge.flags",
}
"""Dotted names that begin like a module here: names of MuJoCo, and names in a recording."""

MODULES = [
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for path in SOURCES
]


def starts(pointer: str) -> Iterator[tuple[object, list[str]]]:
    """Yields each module or class that a dotted name may begin with, and the rest of the name."""
    parts = pointer.split(".")
    for count in range(len(parts), 0, -1):
        head = "." + ".".join(parts[:count])
        yield from (
            (import_module(name), parts[count:]) for name in MODULES if f".{name}".endswith(head)
        )


def exists(start: object, names: list[str]) -> bool:
    """Returns True if a module or class has an attribute, which has the next one, and so on."""
    for name in names:
        if not hasattr(start, name) and name in getattr(start, "__annotations__", {}):
            return True  # a field without default
        start = getattr(start, name, None)
    return start is not None


def test_a_dotted_name_that_begins_with_a_module_exists() -> None:
    offences = []
    for path in SOURCES:
        for line, text in docstrings(ast.parse(path.read_text(encoding="utf-8"))):
            for pointer in POINTER.findall(text):
                if pointer in NOT_OURS or pointer.endswith(".md"):
                    continue
                found = list(starts(pointer))
                if found and not any(exists(*start) for start in found):
                    offences.append(f"{path.relative_to(ROOT)}:{line}: {pointer}")
    assert not offences


TEXTS = {tokenize.COMMENT, tokenize.STRING, getattr(tokenize, "FSTRING_MIDDLE", tokenize.STRING)}
"""Kinds of tokens that people read."""

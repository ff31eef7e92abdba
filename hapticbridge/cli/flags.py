"""Flags of a command, made from the fields of its dataclass: names, values, help.

A field of a dataclass type stands for that class's own flags. Type, default, unit, range and text
of a flag are those of the field (``arguments.Rule``, ``Attributes`` of the class's docstring, or
the text below the field).
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

from hapticbridge.arguments import Rule, members, rule_of, shown, types_of, value_from
from hapticbridge.errors import HapticBridgeError, nearest

if TYPE_CHECKING:
    import ast

Path = tuple[str, ...]

WIDTH = 79
"""Columns of help. Eighty wrap in a terminal of the usual width."""

COLUMN = 22
"""Largest width of the column of flags. A longer flag has a line of its own."""


@dataclass(frozen=True, slots=True)
class Flag:
    """A flag, or a positional word, of a command.

    Attributes:
        path: Names of the fields that lead to its value, from the command's class down.
        kind: Type of the value.
        rule: Unit, range and name.
        default: Default of the field; ``MISSING`` for a value that must be named.
        owner: Class whose field it is.
    """

    path: Path
    kind: Any
    rule: Rule
    default: Any
    owner: Any

    @property
    def words(self) -> dict[str, Any]:
        """Words of the command line that set it; those of a switch with the value that they set."""
        name = (self.rule.flag or self.path[-1]).replace("_", "-")
        if self.rule.is_positional:
            return {}
        if bool not in members(self.kind):
            return {f"--{name}": None}
        own = {f"--{name}": True, f"--no-{name}": False}
        return {word: value for word, value in own.items() if value is not self.default}

    @property
    def of_tuple(self) -> tuple[Any, ...]:
        """Types of the values of a tuple, with ``...`` for any number; empty for one value."""
        return next((get_args(k) for k in members(self.kind) if get_origin(k) is tuple), ())

    @property
    def count(self) -> float:
        """Number of words that it takes at once; infinite for all up to the next flag."""
        if bool in members(self.kind):
            return 0
        if not self.of_tuple or self.rule.is_repeated:
            return 1
        is_long = self.of_tuple[-1] is not Ellipsis
        usual = self.default if isinstance(self.default, tuple) else ()
        return len(self.of_tuple) if is_long else len(usual) or math.inf

    @property
    def form(self) -> str:
        """The flag with a word for its value, as help shows it."""
        words = {int: "INT", float: "NUMBER", str: "TEXT"}
        kind = self.of_tuple[0] if self.of_tuple else members(self.kind)[0]
        usual = "NAME" if get_origin(kind) is Literal else words.get(kind, "PATH")
        value = "" if self.count == 0 else self.rule.metavar or usual
        if self.of_tuple and self.count > 1 and not self.rule.metavar:
            value += " …"
        return " ".join(filter(None, (", ".join(self.words), value)))

    def value(self, texts: list[str]) -> Any:
        """Returns its value from words of the command line.

        Raises:
            HapticBridgeError: A word is none, or too many or few are there.
        """
        name = next(iter(self.words), self.form)
        if not self.rule.is_repeated and self.of_tuple and self.count not in (len(texts), math.inf):
            raise HapticBridgeError(f"{name} takes {self.count} values, not {len(texts)}")
        kind = self.of_tuple[0] if self.of_tuple else self.kind
        found = []
        for text in texts:
            try:
                found.append(value_from(kind, text, self.rule))
            except ValueError as valid:
                raise HapticBridgeError(f"{name} is {shown(text)}; it must be {valid}") from None
        return tuple(found) if self.of_tuple else found[-1]

    def text(self, *, is_whole: bool = True) -> str:
        """Returns its help: the field's text, or its first sentence, with range and default."""
        source, name = self.rule.source or (self.owner, self.path[-1])
        texts = texts_of(self.owner)
        text = (texts.get(self.path[-1]) or texts_of(source)[name]).replace("``", "'")
        text = text if is_whole else re.split(r"(?<=\.)\s", text, maxsplit=1)[0]
        literals = [kind for kind in members(self.kind) if get_origin(kind) is Literal]
        chosen = [each for kind in literals for each in get_args(kind)]
        hints = [] if all(each in text for each in chosen) else [", ".join(chosen)]
        if self.rule.unit and self.rule.unit not in text:
            hints.append(self.rule.unit)
        if self.rule.most < math.inf:
            hints.append(self.rule.valid())
        usual = self.default if isinstance(self.default, tuple) else (self.default,)
        if usual and all(_is_telling(each) for each in usual):
            hints.append("default " + " ".join(_short(each) for each in usual))
        return text + (f" ({'; '.join(hints)})" if hints else "")


def _is_telling(default: object) -> bool:
    """Returns True for a default that help shows; the text says what stands for the others."""
    if isinstance(default, float):
        return math.isfinite(default)
    return default is not MISSING and default is not None and not isinstance(default, bool)


def _short(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _inner(kind: Any, own: Rule) -> type[Any] | None:
    """Returns the class whose flags stand for a field; None for a field with a flag of its own."""
    return own.gains_of or (kind if is_dataclass(kind) else None)  # type: ignore[return-value]


def flags_of(kind: Any, path: Path = ()) -> Iterator[Flag]:
    """Yields the flags of a dataclass, those of its inner classes in their place."""
    for each in fields(kind):
        own, its_kind = rule_of(each), types_of(kind)[each.name]
        its_path = (*path, each.name)
        if own.no_flag:
            continue
        if inner := _inner(its_kind, own):
            yield from flags_of(inner, its_path)
        else:
            default = each.default if own.gains_of is None else MISSING
            yield Flag(its_path, its_kind, own, default, kind)


def values_of(command: type[Any], name: str, words: list[str]) -> dict[Path, Any]:
    """Returns the values that words of the command line name.

    Raises:
        HapticBridgeError: A word is no option, or its value none; one sentence says what is valid.
    """
    flags = list(flags_of(command))
    values, texts, free = _split(name, flags, words)
    for flag in flags:
        if flag.rule.is_positional and free:
            count = len(free) if flag.of_tuple else 1
            texts[flag.path], free = free[:count], free[count:]
    if free:
        raise HapticBridgeError(
            f"'{name}' has no place for {shown(free[0])}: {usage(command, name)}"
        )
    values |= {flag.path: flag.value(texts[flag.path]) for flag in flags if flag.path in texts}
    for flag in flags:
        if flag.default is MISSING and flag.path not in values and len(flag.path) == 1:
            raise HapticBridgeError(f"'{name}' needs {flag.form}: {usage(command, name)}")
    return values


def _split(
    name: str, flags: list[Flag], words: list[str]
) -> tuple[dict[Path, Any], dict[Path, list[str]], list[str]]:
    """Returns the values of switches, the texts of the other flags, and words without a flag."""
    known = {word: (flag, value) for flag in flags for word, value in flag.words.items()}
    values: dict[Path, Any] = {}
    texts: dict[Path, list[str]] = {}
    free: list[str] = []
    rest = list(words)
    while rest:
        word = rest.pop(0)
        head, is_joined, joined = word.partition("=")
        head = head.replace("_", "-")
        if word == "--":
            return values, texts, free + rest
        if head in known:
            flag, value = known[head]
            own = [joined] if is_joined else []
            while rest and len(own) < flag.count and rest[0].partition("=")[0] not in known:
                own.append(rest.pop(0))
            if len(own) > flag.count or (flag.count == 1 and not own):
                what = "takes no value" if own else f"needs a value: {flag.form}"
                raise HapticBridgeError(f"{head} {what}")
            if flag.count == 0:
                values[flag.path] = value
            else:
                before = texts.get(flag.path, []) if flag.rule.is_repeated else []
                texts[flag.path] = before + own
        elif re.fullmatch(r"-{1,2}[A-Za-z].*", word):
            advice = nearest(head, known).rstrip() or f"'hapticbridge {name} --help' lists them"
            raise HapticBridgeError(f"'{name}' has no option '{head}'; {advice}")
        else:
            free.append(word)
    return values, texts, free


def built(kind: Any, values: Mapping[Path, Any], path: Path = ()) -> Any:
    """Returns a dataclass with the named values, and its own defaults for all others."""
    named: dict[str, Any] = {}
    for each in fields(kind):
        own, its_path = rule_of(each), (*path, each.name)
        inner = _inner(types_of(kind)[each.name], own)
        if its_path in values:
            named[each.name] = values[its_path]
        elif own.gains_of is not None:
            named[each.name] = {p[-1]: v for p, v in values.items() if p[:-1] == its_path}
        elif inner is not None and any(p[: len(its_path)] == its_path for p in values):
            named[each.name] = built(inner, values, its_path)
    return kind(**named)


# Help


def _source_of(kind: Any) -> tuple[str, list[ast.stmt]]:
    """Returns docstring and statements of a class, from its source: 'python -OO' drops them."""
    import ast  # noqa: PLC0415 - for help alone
    import inspect  # noqa: PLC0415

    [definition] = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(definition, ast.ClassDef)
    return ast.get_docstring(definition) or "", definition.body


@cache
def texts_of(kind: Any) -> dict[str, str]:
    """Returns the text of each field: ``Attributes`` of the docstring, or below the field."""
    import ast  # noqa: PLC0415 - for help alone
    from itertools import pairwise  # noqa: PLC0415

    docstring, statements = _source_of(kind)
    section = re.split(r"\n(?=\S)", docstring.partition("\nAttributes:\n")[2])[0]
    entries = re.findall(r"^    (\w+): (.*(?:\n      +.*)*)", section, flags=re.MULTILINE)
    below = [
        (option.target.id, ast.literal_eval(text.value))
        for option, text in pairwise(statements)
        if isinstance(option, ast.AnnAssign)
        and isinstance(option.target, ast.Name)
        and isinstance(text, ast.Expr)
    ]
    return {name: " ".join(text.split()) for name, text in (*entries, *below)}


def usage(command: type[Any], name: str) -> str:
    """Returns the line that shows how a command is called."""
    words = []
    for flag in flags_of(command):
        if flag.rule.is_positional:
            word = f"{flag.form} …" if flag.of_tuple else flag.form
            words.append(word if flag.default is MISSING else f"[{word}]")
        elif flag.default is MISSING and len(flag.path) == 1:
            words.insert(0, flag.form)
    return " ".join(("hapticbridge", name, *words, "[OPTIONS]"))


def help_page(command: type[Any], name: str, *, is_whole: bool) -> str:
    """Returns the help of a command: its ``FIRST_OPTIONS`` in short, or all options in full."""
    flags = list(flags_of(command))
    first = getattr(command, "FIRST_OPTIONS", ())
    is_whole = is_whole or not first
    shown_flags = [f for f in flags if is_whole or (f.rule.flag or f.path[-1]) in first]
    lines = [f"usage: {usage(command, name)}", ""]
    for paragraph in _source_of(command)[0].split("\n\n"):
        is_example = "\n " in paragraph
        lines += paragraph.splitlines() if is_example else _wrapped(paragraph, "")
        lines.append("")
    for flag in shown_flags:
        indent = " " * (COLUMN + 2)
        text = _wrapped(flag.text(is_whole=is_whole), indent)
        head = f"  {flag.form}"
        if len(head) < len(indent) and text:
            text[0] = head.ljust(len(indent)) + text[0].lstrip()
            head = ""
        lines += [*filter(None, [head]), *text]
    if len(shown_flags) < len(flags):
        count = len(flags) - len(shown_flags)
        lines += ["", f"{count} more options, and more on these: hapticbridge {name} --help-all"]
    return "\n".join(lines)


def _wrapped(text: str, indent: str) -> list[str]:
    return textwrap.wrap(
        text,
        WIDTH,
        initial_indent=indent,
        subsequent_indent=indent,
        break_on_hyphens=False,
        break_long_words=False,
    )

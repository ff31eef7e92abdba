"""Lines of a scene's files on which its elements are written."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any, Literal

import mujoco

from hapticbridge.kernel.codes import PREFIX
from hapticbridge.scene import SceneSource
from hapticbridge.scene.compile import START_KEYFRAME
from hapticbridge.scene.source import Element, read_elements

_TAGS = {
    "joint": ("joint", "freejoint"),
    "equality": ("connect", "weld", "joint", "tendon", "flex", "flexvert", "flexstrain"),
    "tendon": ("spatial", "fixed"),
    "actuator": (
        "general",
        "motor",
        "position",
        "velocity",
        "intvelocity",
        "damper",
        "cylinder",
        "muscle",
        "adhesion",
        "plugin",
    ),
}
"""Tags of a kind of element where they differ from its name."""

_LISTS = {"body": "bodies", "equality": "equalities", "mesh": "meshes"}
"""Lists of an MjSpec that are not called after their kind and an s."""


_BODIES = {"geom": "geom_bodyid", "joint": "jnt_bodyid"}
"""Arrays of the model with the body of an element."""

Kind = Literal["geom", "body", "joint", "site", "equality", "tendon", "actuator", "pair", "mesh"]
"""Kind of an element."""


@dataclass(frozen=True, slots=True)
class Place:
    """An element in a scene's files.

    Attributes:
        file: Name of the file, relative to the scene's folder.
        line: Line, from 1; 0 if the element was not found in the files.
        element: Kind and name: ``geom 'peg'``, ``<option>``.
    """

    file: str
    line: int
    element: str

    def __str__(self) -> str:
        where = f"{self.file}:{self.line}" if self.line else self.file
        return f"{where}, {self.element}"


class Places:
    """Finder of the lines of a compiled scene's elements.

    MuJoCo records lines of the main file and, without the file's name, of attached models, but not
    of included files. There an element is found by its name. An unnamed element is found by its
    position among the unnamed elements of its kind, provided that their numbers in files and model
    agree.
    """

    def __init__(self, source: SceneSource, model: mujoco.MjModel) -> None:
        """Reads the files.

        The model may contain the bridge's handle.
        """
        self._spec, self._model = source.spec, model
        self._files = [
            (file.name, list(read_elements(file.data)))
            for file in source.sources
            if file.name.lower().endswith(".xml")
        ]
        self._main = self._files[0][0] if self._files else source.path.name
        models = {
            PurePosixPath(element.attributes.get("file", "")).name
            for _, elements in self._files
            for element in elements
            if element.tag == "model"
        }
        self._attached = {name for name, _ in self._files if PurePosixPath(name).name in models}

    def find(self, kind: Kind, index: int) -> Place:
        """Returns the place of an element; an unnamed mesh has the name of its file."""
        tags, name = _TAGS.get(kind, (kind,)), str(getattr(self._model, kind)(index).name)
        label = f"{kind} '{name}'" if name else f"{kind} {index}{self._owner(kind, index)}"
        if name and (found := self._first(tags, lambda e: e.attributes.get("name") == name)):
            return Place(found.file, found.line, label)
        elements = list(getattr(self._spec, _LISTS.get(kind, f"{kind}s")))
        if index >= len(elements) or not self._has_numbers_of(kind, elements, index):
            return Place(self._main, 0, label)
        if _line(elements[index]):
            return Place(*self._recorded(elements[index], tags), label)
        nameless = [k for k, e in enumerate(elements) if not e.name and not _line(e)]
        included = [
            (file, element.line)
            for file, those in self._files[1:]
            for element in _outside_defaults(those)
            if element.tag in tags and "name" not in element.attributes
        ]
        if index in nameless and len(nameless) == len(included):
            return Place(*included[nameless.index(index)], label)
        return Place(self._main, 0, label)

    def named(self, tag: str, name: str) -> Place:
        """Returns the place of an element by its tag and name."""
        found = self._first((tag,), lambda element: element.attributes.get("name") == name)
        return found or Place(self._main, 0, f"{tag} '{name}'")

    def start(self) -> Place:
        """Returns the place of the keyframe that the scene starts from, or would start from."""
        named = self.named("key", START_KEYFRAME)
        return named if named.line else self._first(("key",), _is_nameless) or named

    def option(self, attribute: str) -> Place:
        """Returns the place at which <option> sets an attribute, or at which it would be set."""
        return (
            self._first(("option", "flag"), lambda element: attribute in element.attributes)
            or self._first(("option",), lambda _: True)
            or self._first(("mujoco",), lambda _: True)
            or Place(self._main, 0, "<option>")
        )

    def option_change(self, attribute: str, value: str) -> str:
        """Returns the text to write at ``option(attribute)``, also for a scene without <option>."""
        written = f'{attribute}="{value}"'
        is_missing = self.option(attribute).element == "<mujoco>"
        return f"<option {written}/> in <mujoco>" if is_missing else written

    def flag(self) -> Place:
        """Returns the place of flags; MuJoCo takes one <flag> per <option>."""
        return self._first(("flag",), lambda _: True) or self.option("flag")

    def setting(self, settings: Iterable[tuple[str, str]]) -> Place:
        """Returns the only element that sets one of some attributes; else all that may.

        Args:
            settings: Pairs of element and attribute, as of a ``Treatment``. The attribute is empty
                for an element that a run adds.
        """
        pairs = [(element.rpartition("/")[2], attribute) for element, attribute in settings]
        tags = list(dict.fromkeys(tag for tag, _ in pairs))
        if set(tags) <= {"option", "flag"}:
            return self.option(pairs[0][1])
        if tags == ["key"]:  # a run starts at no other
            return self.start()
        found = {
            Place(file, element.line, _describe(element))
            for file, elements in self._files
            for element in elements
            if any((element.tag, name) in pairs for name in element.attributes)
        }
        listed = ", ".join(f"<{tag}>" for tag in tags)
        return found.pop() if len(found) == 1 else Place(self._main, 0, listed)

    def with_attribute(self, attribute: str) -> Place | None:
        """Returns the first element of any tag that has an attribute."""
        return self._first((), lambda element: attribute in element.attributes)

    def may_set(self, tag: str, attribute: str, place: Place) -> bool:
        """Returns False if neither the element at a place nor a default class sets an attribute.

        True for an element that was not found in the files if any of its tag sets it.
        """
        return any(
            not place.line or k < defaults or (name, element.line) == (place.file, place.line)
            for name, elements in self._files
            for defaults in [len(elements) - len(_outside_defaults(elements))]
            for k, element in enumerate(elements)
            if element.tag == tag and attribute in element.attributes
        )

    def _owner(self, kind: Kind, index: int) -> str:
        """Returns words on the body of an element without a name."""
        if kind not in _BODIES:
            return ""
        body = int(getattr(self._model, _BODIES[kind])[index])
        if body == 0:
            return " of the world"
        name = self._model.body(body).name
        return f" of body '{name}'" if name else f" of body {body}"

    def _recorded(self, element: Any, tags: tuple[str, ...]) -> tuple[str, int]:
        """Returns file and line of an element whose line MuJoCo recorded; line 0 if in doubt."""
        line, name = _line(element), str(element.name)
        if not self._attached:
            return self._main, line
        found = {
            file
            for file, those in self._files
            for each in those
            if file in {self._main, *self._attached} and each.line == line and each.tag in tags
            if _may_become(each.attributes.get("name", ""), name)
        }
        return (found.pop(), line) if len(found) == 1 else (self._main, 0)

    def _has_numbers_of(self, kind: Kind, elements: list[Any], index: int) -> bool:
        """Returns False if elements up to this one were fused or dropped by the compiler."""
        names = list[str]()
        with suppress(IndexError):
            while True:
                names.append(str(getattr(self._model, kind)(len(names)).name))
        names = [name for name in names if not name.startswith(PREFIX)]
        written = [str(each.name) for each in elements]
        return len(names) >= len(written) and names[: index + 1] == written[: index + 1]

    def _first(self, tags: tuple[str, ...], fits: Callable[[Element], bool]) -> Place | None:
        """Returns the first element with one of some tags, or with any if there are none."""
        for file, elements in self._files:
            for element in elements:
                if (not tags or element.tag in tags) and fits(element):
                    return Place(file, element.line, _describe(element))
        return None


def _is_nameless(element: Element) -> bool:
    return "name" not in element.attributes


def _describe(element: Element) -> str:
    name = element.attributes.get("name")
    return f"{element.tag} '{name}'" if name else f"<{element.tag}>"


def _may_become(name: str, compiled: str) -> bool:
    """Returns True if attaching or replicating, which add to a name, may give the compiled one."""
    return name in compiled and bool(name) == bool(compiled)


def _line(element: Any) -> int:
    words = str(element.info).split()
    return int(words[-1]) if words and words[-1].isdigit() else 0


def _outside_defaults(elements: list[Element]) -> list[Element]:
    """Drops the elements before the first body or world; default classes contain geoms too."""
    for k, element in enumerate(elements):
        if element.tag in ("worldbody", "body"):
            return elements[k:]
    return []

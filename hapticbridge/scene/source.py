"""Original files of a scene: its XML, includes and assets.

A recording stores them, because MuJoCo's own output is not equivalent. ``to_xml`` rounds numbers to
6 digits, and ``to_zip`` omits assets. Its list of dependencies (``mju_getXMLDependencies``) has no
order and searches height fields in the wrong folder.
"""

from __future__ import annotations

import re
import stat
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import unescape
from pathlib import Path

from hapticbridge.errors import SceneError
from hapticbridge.scene.parameters import parameters_file

_FILE_ATTRIBUTES = (
    "file",
    "fileright",
    "fileleft",
    "fileup",
    "filedown",
    "filefront",
    "fileback",
    "filename",  # URDF
)

# MuJoCo's parser accepts more than well-formed XML ("--" in a comment, a bare "&"), so these
# patterns must accept it too.
# What is never closed ends with the text: else each of many starts would be sought to the end.
_NOT_AN_ELEMENT = re.compile(r"<!--.*?(?:-->|\Z)|<\?.*?(?:\?>|\Z)|<![A-Z].*?(?:>|\Z)", re.DOTALL)
_ELEMENT = re.compile(r"<([A-Za-z_][\w.:-]*)((?:\s+[\w.:-]+\s*=\s*(?:\"[^\"]*\"|'[^']*'))*)\s*/?>")
_ATTRIBUTE = re.compile(r"([\w.:-]+)\s*=\s*(?:\"([^\"]*)\"|'([^']*)')")


@dataclass(frozen=True, slots=True)
class SourceFile:
    """One file of a scene.

    Attributes:
        name: Path relative to the deepest folder that contains all files of the scene, with forward
            slashes. It is the main file's folder if all files are inside it.
        data: The file's bytes.
    """

    name: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Element:
    """One element of an XML file.

    Attributes:
        tag: Name of the element.
        attributes: Attribute values by name.
        line: Line of its start, counted from 1.
    """

    tag: str
    attributes: dict[str, str]
    line: int


def collect_sources(path: Path, main: bytes | None = None) -> tuple[SourceFile, ...]:
    """Returns the main file, first, and all existing files that it refers to.

    A parameter file beside the main file is included. A file that is not found here (in a search
    path of MuJoCo's own) is left out without an error. Written into an empty folder under their
    names, the files compile to an identical model.

    Args:
        path: The main file.
        main: Content of the main file if none exists at ``path``; it has no parameter file then.

    Raises:
        SceneError: A name leads to a device, pipe or socket, or through a link out of the folder.
    """
    files: dict[Path, Path] = {}
    _find_files(path, files, main)
    parameters = parameters_file(path)
    if main is None and parameters.is_file():
        files.setdefault(_key(parameters), parameters)
    root = path.absolute().parent
    passed = [folder for file in files.values() for folder in _left_folders(file)]
    while not all(file.is_relative_to(root) for file in (*files, *passed)) and root != root.parent:
        root = root.parent
    _refuse_links(files, root, path)
    names = (file.relative_to(root if file.is_relative_to(root) else file.anchor) for file in files)
    return tuple(
        SourceFile(name.as_posix(), main if main and file is path else file.read_bytes())
        for name, file in zip(names, files.values(), strict=True)
    )


_FILE_NAME = re.compile(
    r"""(?=\b(?:file\w*|meshdir|texturedir|assetdir)\s*=\s*(?:"([^"]*)"|'([^']*)'))"""
)


def refuse_outside(data: bytes, name: str) -> int:
    """Refuses a file of a foreign scene that names files outside the scene's folder.

    Returns the largest number of ``..`` in one name.

    Every text that looks like a file's name counts, also in a comment: this pattern and MuJoCo's
    parser need not agree on what a comment is.

    Args:
        data: Content of the file.
        name: Its path in the scene's folder, with forward slashes.

    Raises:
        SceneError: A name is absolute, or leads out of the folder.
    """
    text = data.decode("utf-8-sig", errors="replace")
    names = {unescape(double or single) for double, single in _FILE_NAME.findall(text)}
    depth, climb = name.count("/"), 0
    for found in names:
        parts = found.replace("\\", "/").split("/")
        climb = max(climb, parts.count(".."))
        is_absolute = found[:1] in ("/", "\\", "~") or ":" in parts[0]
        if is_absolute or parts.count("..") > depth:
            raise SceneError(
                f"'{name}' names the file '{found:.80}', which lies outside the scene's folder; a "
                "recording's scene may only name its own files"
            )
    return climb


def read_elements(data: bytes) -> Iterator[Element]:
    """Yields the elements of an XML file in order; other content is skipped."""
    text = data.decode("utf-8-sig", errors="replace")
    text = _NOT_AN_ELEMENT.sub(lambda match: "\n" * match[0].count("\n"), text)
    line, end = 1, 0
    for match in _ELEMENT.finditer(text):
        line, end = line + text.count("\n", end, match.start()), match.start()
        attributes = {
            name: unescape(double or single)
            for name, double, single in _ATTRIBUTE.findall(match[2])
        }
        yield Element(match[1], attributes, line)


def _find_files(path: Path, files: dict[Path, Path], content: bytes | None = None) -> None:
    """Adds a model's file, its includes, its assets and the models that it attaches."""
    if _key(path) in files:
        return
    files[_key(path)] = path
    elements = list(_expanded(path, path.parent, {path}, content))
    folders = _asset_folders([element for element, _ in elements])
    for element, namer in elements:
        for attribute in _FILE_ATTRIBUTES:
            reference = element.attributes.get(attribute)
            if reference is None:
                continue
            homes = path.parent, namer.parent
            file = _existing(_candidates(reference, element.tag, homes, folders))
            if file is None:
                continue
            if element.tag == "model":
                _find_files(file, files)
            else:
                files.setdefault(_key(file), file)


def _key(path: Path) -> Path:
    """Returns the absolute path without ``..``, which could leave a folder of copies."""
    parts: list[str] = []
    for part in path.absolute().parts:
        if part == "..":
            del parts[-1:]
        else:
            parts.append(part)
    return Path(*parts)


def _left_folders(path: Path) -> Iterator[Path]:
    """Yields the folders to which each ``..`` of a path leads, as in ``../objects/peg.stl``."""
    parts: list[str] = []
    for part in path.absolute().parts:
        if part == "..":
            del parts[-1:]
            yield Path(*parts)
        else:
            parts.append(part)


def _expanded(
    path: Path, folder: Path, seen: set[Path], content: bytes | None = None
) -> Iterator[tuple[Element, Path]]:
    """Yields the elements of an MJCF file and of its includes, each with its own file."""
    for element in read_elements(content or path.read_bytes()):
        yield element, path
        if element.tag == "include" and "file" in element.attributes:
            included = _existing(_beside(element.attributes["file"], (folder, path.parent)))
            if included is not None and included not in seen:
                seen.add(included)
                yield from _expanded(included, folder, seen)


def _asset_folders(elements: list[Element]) -> dict[str, str]:
    """Returns the compiler's asset folders; the last setting holds for the whole model."""
    folders = {"meshdir": "", "texturedir": "", "strippath": "false"}
    for element in elements:
        if element.tag == "compiler":
            shared = element.attributes.get("assetdir")
            if shared is not None:
                folders["meshdir"] = folders["texturedir"] = shared
            folders |= {n: v for n, v in element.attributes.items() if n in folders}
    return folders


def _candidates(
    reference: str, tag: str, homes: tuple[Path, Path], folders: dict[str, str]
) -> Iterator[Path]:
    """Yields the paths at which MuJoCo looks for an asset, in its order."""
    if tag in {"include", "model"}:
        yield from _beside(reference, homes)
        return
    folder = folders["texturedir" if tag == "texture" else "meshdir"]
    is_stripped = folders["strippath"] == "true"
    name = reference.replace("\\", "/").rsplit("/", 1)[-1] if is_stripped else reference
    yield from _beside(f"{folder}/{name}" if folder else name, homes[:1])
    yield from _beside(name, homes)


def _beside(reference: str, homes: Sequence[Path]) -> Iterator[Path]:
    """Yields a file relative to the model's folder, then to the folder of the referring file."""
    for name in dict.fromkeys((reference, reference.replace("\\", "/"))):
        for home in homes:
            yield home / name


def _existing(candidates: Iterator[Path]) -> Path | None:
    """Returns the first file that exists.

    Raises:
        SceneError: A device, pipe or socket comes before it, which would be read without end.
    """
    for path in candidates:
        try:
            mode = path.stat().st_mode
        except (OSError, ValueError):
            continue
        if stat.S_ISREG(mode):
            return path
        if not stat.S_ISDIR(mode):
            kind = "pipe" if stat.S_ISFIFO(mode) else "socket" if stat.S_ISSOCK(mode) else "device"
            raise SceneError(
                f"the scene names the {kind} '{path}'; meshes, textures and includes must be files"
            )
    return None


def _refuse_links(files: dict[Path, Path], root: Path, main: Path) -> None:
    """Refuses links that lead out of the scene's folder, its main file's own, and its repository.

    A recording contains all files, also those that a scene reaches through a link.
    """
    around = [each for each in main.absolute().parents if (each / ".git").exists()]
    homes = [each.resolve() for each in (root, *around[:1])] + [main.resolve().parent]
    for place, file in files.items():
        target = file.resolve()
        if not any(target.is_relative_to(home) for home in homes):
            raise SceneError(
                f"the scene names the link '{place}', which leads out of its folder to '{target}'; "
                "copy the file there if it belongs to the scene"
            )

"""Original files of a scene: its XML, includes and assets.

A recording stores them, because MuJoCo's own output is not equivalent. ``to_xml`` rounds numbers to
6 digits, and ``to_zip`` omits assets. Its list of dependencies (``mju_getXMLDependencies``) has no
order and searches height fields in the wrong folder.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape, unescape
from pathlib import Path, PurePosixPath

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


_ARCHIVE = b"PK"
"""Start of a zipped scene, whose names lead nowhere else."""


def collect_sources(path: Path, main: bytes | None = None) -> tuple[SourceFile, ...]:
    """Returns the main file, first, and all existing files that it refers to.

    A parameter file beside the main file is included. A file that is not found here (in a search
    path of MuJoCo's own) is left out without an error. Names that lead out of the scene's folder,
    as absolute ones do, are rewritten: written into an empty folder under their names, the files
    compile to an identical model.

    Args:
        path: The main file.
        main: Content of the main file if none exists at ``path``; it has no parameter file then.

    Raises:
        SceneError: A name leads to a device, pipe or socket, or through a link out of the folder.
    """
    files: dict[Path, Path] = {}
    homes: dict[Path, _Home] = {}
    _find_files(path, files, homes, main)
    parameters = parameters_file(path)
    if main is None and parameters.is_file():
        files.setdefault(_key(parameters), parameters)
    root = path.absolute().parent
    passed = [folder for file in files.values() for folder in _left_folders(file)]
    while not all(file.is_relative_to(root) for file in (*files, *passed)) and root != root.parent:
        root = root.parent
    _refuse_links(files, root, path)
    contents = {
        key: main if main and file is path else file.read_bytes() for key, file in files.items()
    }
    while root != root.parent and not all(
        homes[key].reaches_all(contents[key], _named_in(key, root).count("/"), root)
        for key in homes.keys() & contents.keys()
    ):
        root = root.parent  # an XML file that lies deeper may climb farther
    sources = []
    for key, data in contents.items():
        name, inner = _named_in(key, root), data
        if key in homes and not data.startswith(_ARCHIVE):
            inner = homes[key].with_inner_names(data, name.count("/"), root)
        sources.append(SourceFile(name, inner))
    return tuple(sources)


def with_assets(
    sources: tuple[SourceFile, ...], assets: Mapping[str, bytes]
) -> tuple[SourceFile, ...]:
    """Returns the sources of a specification with the assets that it holds in memory.

    MuJoCo finds an asset in memory before a file on the disk: by the whole path of the file that an
    element names, by its name as written or by the last part of both, in any case of letters. It
    finds a file only at its path, where each asset is placed. Assets that no element names are left
    out.
    """
    main, held = sources[0], {name.casefold(): data for name, data in assets.items()}
    lasts = [_parts(name)[-1] for name in held]
    held |= {
        last: held[name] for name, last in zip(held, lasts, strict=True) if lasts.count(last) == 1
    }
    found = {source.name: source for source in sources}
    elements = list(read_elements(main.data))
    folders, home = _asset_folders(elements), PurePosixPath(main.name).parent
    for element in elements:
        for reference in filter(None, map(element.attributes.get, _FILE_ATTRIBUTES)):
            inner = next(_candidates(reference, element.tag, (Path(), Path()), folders)).as_posix()
            names = map(str.casefold, (inner, reference, _parts(reference)[-1]))
            if (name := next(filter(held.__contains__, names), None)) is not None:
                place = (home / inner).as_posix()
                found[place] = SourceFile(place, held[name])
    return tuple(found.values())


def _named_in(file: Path, root: Path) -> str:
    return file.relative_to(root if file.is_relative_to(root) else file.anchor).as_posix()


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
    for each in names:
        if _leads_out(each, name.count("/")):
            raise SceneError(
                f"'{name}' names the file '{each:.80}', which lies outside the scene's folder; a "
                "recording's scene may only name its own files"
            )
    return max((_parts(each).count("..") for each in names), default=0)


def _parts(name: str) -> list[str]:
    return name.replace("\\", "/").split("/")


def _leads_out(name: str, depth: int) -> bool:
    """Returns True if a name in a file that lies so many folders deep leads out of the scene's."""
    parts = _parts(name)
    is_absolute = name[:1] in ("/", "\\", "~") or ":" in parts[0]
    return is_absolute or parts.count("..") > depth


@dataclass(frozen=True, slots=True)
class _Home:
    """Folders to which the names in a model's XML files are relative.

    Attributes:
        folder: Folder of the model's main file.
        folders: Settings of its compiler, as from ``_asset_folders``.
    """

    folder: Path
    folders: dict[str, str]

    def of(self, tag: str) -> Path:
        """Returns the folder to which the file names of an element are relative."""
        if tag in _NAMED_FROM_HOME:
            return self.folder
        return self.folder / self.folders["texturedir" if tag == "texture" else "meshdir"]

    def file(self, tag: str, name: str) -> Path | None:
        """Returns the file or folder that an element names, if there is one."""
        places = _candidates(name, tag, (self.folder, self.folder), self.folders)
        there = filter(os.path.exists, places)  # Path.exists fails for a name that is too long
        return next(map(_key, there), None)

    def with_inner_names(self, data: bytes, depth: int, root: Path) -> bytes:
        """Returns an XML file with names that ``refuse_outside`` lets pass.

        A name that leads out of the scene's folder ``root`` is written relative to its own. What
        does not lie in it has no file there, as in a comment: the last part of its name stays.
        """
        text, pieces, end = data.decode("utf-8", errors="surrogateescape"), [], 0
        for (start, stop), name, inner in self._outer_names(text, depth, root):
            if start < end:
                continue
            is_found = inner and not _leads_out(inner, depth)
            last = _parts(name)[-1].rpartition(":")[-1]
            pieces += [text[end:start], escape(inner if is_found else last)]
            end = stop
        return "".join((*pieces, text[end:])).encode("utf-8", errors="surrogateescape")

    def reaches_all(self, data: bytes, depth: int, root: Path) -> bool:
        """Returns True if an XML file so many folders deep can name all its files relatively."""
        text = data.decode("utf-8", errors="surrogateescape")
        return data.startswith(_ARCHIVE) or not any(
            inner and _leads_out(inner, depth)
            for _, _, inner in self._outer_names(text, depth, root)
        )

    def _outer_names(
        self, text: str, depth: int, root: Path
    ) -> Iterator[tuple[tuple[int, int], str, str]]:
        """Yields span, name and relative name of what a file names outside the scene's folder.

        The relative name is empty if no file of the scene has the name.
        """
        for match in _FILE_NAME.finditer(text):
            group = 1 if match[1] is not None else 2
            if not _leads_out(name := unescape(match[group]), depth):
                continue
            tag = _TAG.match(text, text.rfind("<", 0, match.start()) + 1)
            element = tag[0] if tag else ""
            home, file = _key(self.of(element)), self.file(element, name)
            inner = os.path.relpath(file, home) if file and file.is_relative_to(root) else ""
            if ":" in _parts(inner)[0]:  # on Linux a letter of a name, and no drive
                inner = f"./{inner}"
            yield match.span(group), name, inner


_TAG = re.compile(r"[\w.:-]*")
_NAMED_FROM_HOME = {"include", "model", "compiler"}


REPLACED = "\ufffd"
"""Character that ``read_elements`` yields for a byte that is not UTF-8."""


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


def _find_files(
    path: Path, files: dict[Path, Path], homes: dict[Path, _Home], content: bytes | None = None
) -> None:
    """Adds a model's file, its includes, its assets and the models that it attaches.

    ``homes`` gets the folders of the model to which each XML file belongs.
    """
    if _key(path) in files:
        return
    files[_key(path)] = path
    elements = list(_expanded(path, path.parent, {path}, content))
    folders = _asset_folders([element for element, _ in elements])
    homes |= {_key(namer): _Home(path.absolute().parent, folders) for _, namer in elements}
    for element, namer in elements:
        for attribute in _FILE_ATTRIBUTES:
            reference = element.attributes.get(attribute)
            if reference is None:
                continue
            beside = path.parent, namer.parent
            file = _existing(_candidates(reference, element.tag, beside, folders))
            if file is None:
                continue
            if element.tag == "model":
                _find_files(file, files, homes)
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
    if tag in _NAMED_FROM_HOME:
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

"""The original bytes of a scene: its XML, what it includes, and the assets it names.

A recording keeps them, because what MuJoCo writes back is not what was read: ``to_xml`` rounds
numbers to 6 digits and ``to_zip`` leaves assets out.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

_FILE_ATTRIBUTES = (
    "file",
    "fileright",
    "fileleft",
    "fileup",
    "filedown",
    "filefront",
    "fileback",
)


@dataclass(frozen=True, slots=True)
class SourceFile:
    """One file of a scene.

    Attributes:
        name: Path relative to the folder of the scene's main file, with forward slashes.
        data: The file's bytes.
    """

    name: str
    data: bytes


def collect_sources(path: Path) -> tuple[SourceFile, ...]:
    """Returns the main file and everything it refers to that can be found beside it.

    MuJoCo has already compiled the scene when this runs, so what cannot be found here (a file in a
    search path of MuJoCo's own) is left out instead of refused.
    """
    root = path.parent
    found: dict[str, Path] = {}
    _walk(path, root, found)
    return tuple(SourceFile(name, file.read_bytes()) for name, file in found.items())


def _walk(path: Path, root: Path, found: dict[str, Path]) -> None:
    name = Path(os.path.relpath(path, root)).as_posix()
    if name in found or not path.is_file():
        return
    found[name] = path
    try:
        element_root = ElementTree.fromstring(path.read_bytes())
    except (ElementTree.ParseError, ValueError):
        return  # an asset, or XML that only MuJoCo's parser accepts
    folders = _asset_folders(element_root)
    for element in element_root.iter():
        for attribute in _FILE_ATTRIBUTES:
            reference = element.get(attribute)
            if reference is None:
                continue
            for candidate in _candidates(reference, path.parent, root, folders):
                if candidate.is_file():
                    is_xml = element.tag in {"include", "model"}
                    if is_xml:
                        _walk(candidate, root, found)
                    else:
                        key = Path(os.path.relpath(candidate, root)).as_posix()
                        found.setdefault(key, candidate)
                    break


def _asset_folders(root: ElementTree.Element) -> list[str]:
    compiler = root.iter("compiler")
    names = ("meshdir", "texturedir", "assetdir")
    return [value for element in compiler for name in names if (value := element.get(name))]


def _candidates(reference: str, folder: Path, root: Path, assets: list[str]) -> Iterator[Path]:
    for base in dict.fromkeys((folder, root)):
        for asset_folder in assets:
            yield base / asset_folder / reference
            yield base / asset_folder / Path(reference).name  # compiler strippath
        yield base / reference
        yield base / Path(reference).name

"""Shipped scenes, by name."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from hapticbridge.errors import SceneError, choices


@cache
def _folder() -> Path:
    package = Path(__file__).resolve().parents[1]
    installed = package / "models"  # place in an installed wheel
    return installed if installed.is_dir() else package.parent / "models"


def scene_names() -> tuple[str, ...]:
    """Returns the names of the shipped scenes, sorted."""
    return tuple(sorted(path.parent.name for path in _folder().glob("*/*.xml") if _is_scene(path)))


def _is_scene(path: Path) -> bool:
    return path.stem == path.parent.name


def scene_path(path_or_name: str | Path) -> Path:
    """Returns the MJCF file of a path or of a shipped scene's name.

    Args:
        path_or_name: A file, or one of ``scene_names()``. A name without a dot or a slash is taken
            as a file only if that file exists.

    Raises:
        SceneError: No such file and no such name exists.
    """
    if not str(path_or_name):
        raise SceneError(
            f"the scene's name is empty; give an MJCF file or one of: {choices(scene_names())}"
        )
    path = Path(path_or_name)
    try:
        if path.is_file():
            return path
    except OSError as error:
        raise SceneError(f"cannot read scene '{path!s:.80}': {error.strerror}") from None
    if path.is_dir():
        raise SceneError(f"scene '{path}' is a folder; name the MJCF file in it")
    name = str(path_or_name)
    if name in scene_names():
        return _folder() / name / f"{name}.xml"
    if path.suffix or len(path.parts) > 1:
        raise SceneError(
            f"no scene file '{path}' exists; give the path of an MJCF file or one of: "
            f"{choices(scene_names())}"
        )
    raise SceneError(
        f"no scene is called '{name}' and no such file exists; scenes: {choices(scene_names())}"
    )

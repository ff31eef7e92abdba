"""Compilation of a scene from the bytes of its files."""

from __future__ import annotations

import re
from collections.abc import Callable

import mujoco

from hapticbridge.scene.source import SourceFile


def compiled(spec: mujoco.MjSpec, sources: tuple[SourceFile, ...]) -> mujoco.MjModel:
    """Compiles a scene from the bytes of its files, independent of their folder.

    A compiled model names the files of its meshes and textures. With their paths it would differ
    from folder to folder, and a recording would reveal the user's folders. Files outside the
    scene's own folder, and files that only MuJoCo finds, are read from their place.
    """
    main, *assets = sources
    if not assets or "/" in main.name:
        return spec.compile()
    portable = spec.copy()
    portable.modelfiledir = ""
    portable.assets = {source.name: source.data for source in assets}
    try:
        return portable.compile()
    except ValueError:
        return spec.compile()


def _malformed(match: re.Match[str]) -> str:
    fault, line, element = match[1].replace("_", " ").lower(), match[2], match[3]
    where = f" '{element}'" if element else ""
    return f"line {line} is not well-formed XML ({fault}{where})"


_WORDING: tuple[tuple[str, str | Callable[[re.Match[str]], str]], ...] = (
    (r".*XML_ERROR_(\w+) .*?Line number=(\d+)(?:: XMLElement name=([^\s']+))?.*", _malformed),
    (r"((XML )?Error|ParseXML): ", ""),
    (r",? Element name '(.*?)', id (\d+)(, line \d+)?", r" (element '\1', id \2\3)"),
    (r" Element '(.*?)', line 0", r" (element '\1' of an included file)"),
    (r" Element '(.*?)', line (\d+)", r" (element '\1', line \2)"),
    (
        r"could not find decoder.*",
        "its name must end in .xml and it must hold MJCF (of a compiled .mjb, the file behind it)",
    ),
    (r"(engine error: Could not allocate memory)", r"\1; reduce the numbers in <size>"),
)
"""Patterns of MuJoCo's error messages, and their wording after a colon."""


def clause(error: Exception) -> str:
    """Returns MuJoCo's error message, worded to follow a colon."""
    text = " ".join(str(error).split())
    for pattern, wording in _WORDING:
        text = re.sub(pattern, wording, text)
    return text or type(error).__name__

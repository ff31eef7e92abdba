"""Loads an MJCF scene and puts a handle and a coupling into it."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import mujoco

from hapticbridge.errors import SceneError
from hapticbridge.scene.attach import attach_handle, set_options
from hapticbridge.scene.checks import check_model, check_numbers, check_options, check_start
from hapticbridge.scene.compiler import clause, compiled
from hapticbridge.scene.library import scene_path
from hapticbridge.scene.parameters import apply_parameters
from hapticbridge.scene.scene import Scene
from hapticbridge.scene.source import SourceFile, collect_sources
from hapticbridge.scene.start import seat_handle


@dataclass(frozen=True, slots=True)
class SceneSource:
    """A scene as its file says, with its parameters set and nothing put into it.

    Attributes:
        path: The MJCF file.
        spec: MuJoCo's specification of it.
        sources: The original bytes of the file, its includes and its assets.
        parameters: Value of each of the scene's parameters, in the unit that its file names.
        concerns: What will run otherwise than the file says, a clause each.
    """

    path: Path
    spec: mujoco.MjSpec
    sources: tuple[SourceFile, ...]
    parameters: dict[str, float]
    concerns: tuple[str, ...] = ()


def load_scene(path_or_name: str | Path, grip: str = "grip", **parameters: float) -> Scene:
    """Loads an MJCF file, or a scene by name, and puts a handle and a coupling into it.

    The user's own actuators, equality constraints, keyframes and assets survive. The grip may sit
    on a free body, on a body at the end of joints, or on one with a single slide joint.

    Args:
        path_or_name: An MJCF file, or one of ``scene_names()``.
        grip: Name of the site on the tool.
        **parameters: Values of the scene's parameters, such as ``clearance=0.1e-3``; see
            ``scene.scene_parameters`` or ``hapticbridge scenes NAME`` for what there is.

    Raises:
        SceneError: The scene cannot be read, compiled or put behind a device, or has no such
            parameter or not of that value; says why.

    Warns:
        UserWarning: The scene will run, but not quite as its file says.
    """
    return compile_scene(read_scene(path_or_name, **parameters), grip, stacklevel=3)


def read_scene(path_or_name: str | Path, **parameters: float) -> SceneSource:
    """Reads a scene without putting anything into it: what ``compile_scene`` makes a scene of.

    Args:
        path_or_name: An MJCF file, or one of ``scene_names()``.
        **parameters: Values of the scene's parameters.

    Raises:
        SceneError: The scene cannot be read or has an option that does not belong under a bridge,
            or has no such parameter or not of that value.
    """
    path = scene_path(path_or_name)
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        sources = collect_sources(path)
    except (ValueError, OSError) as error:
        raise SceneError(f"cannot read scene '{path}': {clause(error)}") from None
    concerns = check_options(spec)
    check_numbers(sources)
    values = apply_parameters(spec, path, parameters)
    return SceneSource(path, spec, sources, values, tuple(concerns))


def plain_model(source: SceneSource) -> mujoco.MjModel:
    """Compiles a scene as its files say, without handle and coupling, so that it needs no grip.

    Raises:
        SceneError: The scene cannot be compiled; says why.
    """
    with _refused(source.path):
        return compiled(source.spec.copy(), source.sources)


def compile_scene(
    source: SceneSource,
    grip: str = "grip",
    *,
    warns: bool = True,
    checks_start: bool = True,
    stacklevel: int = 2,
) -> Scene:
    """Puts handle and coupling into a scene that was read, and compiles it.

    Args:
        source: What ``read_scene`` returned, or the same with a changed specification; it stays as
            it is.
        grip: Name of the site on the tool.
        warns: Whether to say what will run otherwise than the file says.
        checks_start: Whether to refuse a start that no hand should feel: inside something, or not
            finite.
        stacklevel: Whose line the warnings name.

    Raises:
        SceneError: The scene cannot be compiled or put behind a device; says why.

    Warns:
        UserWarning: The scene will run, but not quite as its file says.
    """
    path, spec = source.path, source.spec.copy()
    attach_handle(spec, grip)
    set_options(spec)
    with _refused(path):
        model = compiled(spec, source.sources)
        concerns = [*source.concerns, *check_model(model, grip)]
        seat_handle(model, grip)
        data, values = mujoco.MjData(model), dict(source.parameters)
        scene = Scene(path, grip, model, data, source.sources, values, spec)
        scene.reset()
    if checks_start:
        check_start(model, scene.data, grip)
    if warns:
        for concern in concerns:
            warnings.warn(f"scene '{path}': {concern}", UserWarning, stacklevel=stacklevel)
    return scene


@contextmanager
def _refused(path: Path) -> Iterator[None]:
    """Turns what MuJoCo says while it compiles into a sentence that names the scene."""
    try:
        yield
    except (ValueError, OSError, MemoryError, mujoco.FatalError) as error:
        raise SceneError(f"cannot compile scene '{path}': {clause(error)}") from None

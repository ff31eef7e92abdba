"""Loading of an MJCF scene with a handle and a coupling."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

import mujoco

from hapticbridge.arguments import shown
from hapticbridge.errors import SceneError, SceneWarning, choices, nearest
from hapticbridge.files import folder_words, name_fault
from hapticbridge.kernel.mujoco_c import copy_of, quiet, warnings_of_reading
from hapticbridge.scene.checks import (
    MAY_BE_ACTIVE,
    check_finite,
    check_model,
    check_numbers,
    check_options,
    check_start,
    check_text,
    refuse_callbacks,
    refuse_overlap,
    unmetered_work,
)
from hapticbridge.scene.compile import (
    START_KEYFRAME,
    clause,
    find_start,
    hold_servos,
    seat_handle,
)
from hapticbridge.scene.grip import add_grip
from hapticbridge.scene.handle import (
    LET_GO,
    announce_gravity_compensation,
    announce_overlaps,
    attach_handles,
    exclude_nested,
    limit_motors_alone,
    set_options,
    take_over_mocap,
)
from hapticbridge.scene.parameters import apply_parameters
from hapticbridge.scene.physics import gradientless_flexes
from hapticbridge.scene.scene import Scene
from hapticbridge.scene.softness import mixed_forms
from hapticbridge.scene.source import SourceFile, collect_sources, with_assets
from hapticbridge.scene.start import start_on_constraints
from hapticbridge.scene.treatment import SceneChange
from hapticbridge.units import format_si

# Shipped scenes, by name


@cache
def _folder() -> Path:
    package = Path(__file__).resolve().parents[1]
    installed = package / "models"  # place in an installed wheel
    return installed if installed.is_dir() else package.parent / "models"


def scene_names(hands: int | None = None) -> tuple[str, ...]:
    """Returns the names of the shipped scenes, sorted; of those for so many hands, if named."""
    return tuple(name for name, count in _scenes() if hands in (count, None))


@cache
def _scenes() -> tuple[tuple[str, int], ...]:
    """Returns name and number of hands of the shipped scenes, sorted."""
    paths = [path for path in _folder().glob("*/*.xml") if path.stem == path.parent.name]
    texts = [ElementTree.parse(path).find("custom/text[@name='grips']") for path in paths]
    hands = [1 if text is None else len(text.get("data", "").split()) for text in texts]
    return tuple(sorted(zip((path.stem for path in paths), hands, strict=True)))


def own_grips(source: SceneSource) -> tuple[str, ...]:
    """Returns the grips that a scene names for several hands, in its custom text ``grips``."""
    named = (text.data.split() for text in source.spec.texts if text.name == "grips")
    return tuple(next(named, ()))


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
    is_text = str(path_or_name).lstrip().startswith("<")
    path = Path(path_or_name)
    try:
        if path.is_file():
            return path
    except OSError as error:
        if not is_text:  # which is too long for a file's name
            raise SceneError(f"cannot read scene '{path!s:.80}': {error.strerror}") from None
    if is_text:
        raise SceneError(
            "the scene is a text of MJCF, and not a file; give mujoco.MjSpec.from_string(TEXT), or "
            "write it to a file"
        )
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
        f"no scene is called '{name}' and no such file exists; {nearest(name, scene_names())}"
        f"scenes: {choices(scene_names())}"
    )


@dataclass(frozen=True, slots=True)
class SceneSource:
    """A scene as read from its file, with its parameters set, before handle and coupling are added.

    Attributes:
        path: The MJCF file.
        spec: MuJoCo's specification of it.
        sources: The original bytes of the file, its includes and its assets.
        parameters: Value of each of the scene's parameters, in the unit of its parameter file.
    """

    path: Path
    spec: mujoco.MjSpec
    sources: tuple[SourceFile, ...]
    parameters: dict[str, float]


def load_scene(
    source: str | Path | mujoco.MjSpec,
    grip: str | Sequence[str] | None = None,
    *,
    as_is: bool = False,
    **parameters: float,
) -> Scene:
    """Loads an MJCF file, a shipped scene or an ``MjSpec``, and adds a handle and a coupling.

    The user's own actuators, equality constraints, keyframes and assets are kept. The grip may be
    on a free body, on a body at the end of joints, or on a body with a single slide joint.

    Args:
        source: An MJCF file, one of ``scene_names()``, or a specification built in memory, which
            is not modified. A run of a specification computes with it as MuJoCo writes it: numbers
            with 6 digits, and the assets that are in ``MjSpec.assets`` or in a file. A recording
            keeps this written form, so the audit compiles the scene that ran.
        grip: Site that the hand holds, ``BODY`` for a body at its centre of mass, or
            ``BODY@x,y,z`` for a point in m in its frame (``scene.grip``). Several hands hold
            several grips, in order; each has a handle and a coupling of its own (``kernel.tick``),
            and two may hold one tool. None holds those that the scene names in its custom text
            ``grips``, else the site ``grip``.
        as_is: If true, a scene is refused that must be changed to be felt (options that exclude the
            coupling, force limits of joints, a tool inside something); else it is changed, and
            ``Scene.changes`` lists the changes. A small memory (``MIN_MEMORY``) is enlarged
            either way, because that alters no motion.
        **parameters: Values of the scene's parameters, such as ``clearance=0.1e-3``.
            ``scene.scene_parameters`` and ``hapticbridge scenes NAME`` list them. A specification
            has none.

    Raises:
        SceneError: The scene cannot be read, compiled or put behind a device, a parameter is
            unknown, or its value is out of range.

    Warns:
        UserWarning: The run deviates from the file in a detail.
    """
    if not isinstance(source, mujoco.MjSpec | str | Path):
        raise SceneError(
            f"scene is {shown(source)}; it must be an MJCF file, the name of a shipped scene or an "
            "MjSpec"
        )
    if not isinstance(source, mujoco.MjSpec):
        return compile_scene(read_scene(source, **parameters), grip, as_is=as_is, stacklevel=3)
    if parameters:
        raise SceneError(
            f"a specification has no parameters, and {choices(parameters)} cannot be set; change "
            "the specification itself"
        )
    return compile_scene(_written(spec_source(source)), grip, as_is=as_is, stacklevel=3)


_MESHES = ".stl", ".obj", ".msh"
"""Suffixes of files that MuJoCo opens as a specification without a body."""


def read_scene(path_or_name: str | Path, **parameters: float) -> SceneSource:
    """Reads a scene for ``compile_scene``, without adding anything to it.

    Args:
        path_or_name: An MJCF file, or one of ``scene_names()``.
        **parameters: Values of the scene's parameters.

    Raises:
        SceneError: The scene cannot be read, has an incompatible option, or a parameter is unknown
            or out of range.

    Warns:
        UserWarning: What MuJoCo warns of as it reads the file, such as a part's lost option.
    """
    path = scene_path(path_or_name)
    if fault := name_fault(path, "MuJoCo"):
        raise SceneError(f"cannot read scene '{path}': {fault}")
    if path.suffix.lower() in _MESHES:
        raise SceneError(
            f"scene '{path}' is a mesh; write an MJCF file that names it in <mesh name=… file=…/>"
        )
    try:
        sources = collect_sources(path)  # first: it refuses what MuJoCo must not open
        check_text(sources)
        with quiet() as told:
            # with a relative path MuJoCo looks for files beside a part in a wrong folder
            spec = mujoco.MjSpec.from_file(str(path.absolute()))
    except (ValueError, OSError, MemoryError, mujoco.FatalError) as error:
        raise SceneError(f"cannot read scene '{path}': {clause(error)}") from None
    check_options(spec)
    check_numbers(sources)
    values = apply_parameters(spec, path, parameters)
    whole = warnings_of_reading(spec)
    firsts = {text.partition("\n")[0] for text in whole}
    for text in dict.fromkeys([*whole, *(line for line in told if line not in firsts)]):
        warnings.warn(f"MuJoCo: {'; '.join(text.splitlines())}", stacklevel=3)
    return SceneSource(path, spec, sources, values)


def spec_source(spec: mujoco.MjSpec) -> SceneSource:
    """Returns a specification as a scene for ``compile_scene``.

    Its path is that of ``MODELNAME.xml`` in ``MjSpec.modelfiledir``; no file needs to exist there.

    Raises:
        SceneError: MuJoCo cannot write the specification, a number of it is not finite, or it has
            an incompatible option.
    """
    # MuJoCo opens no file with a backslash in its name, and systems none of over 255 bytes
    name = spec.modelname.replace("\\", "_").encode()[-200:].decode(errors="ignore")
    path = Path(spec.modelfiledir) / f"{name or 'scene'}.xml"
    with _refused(path):
        spec = copy_of(spec)
    with suppress(ValueError, mujoco.FatalError):  # the compilation of the scene gives the reason
        for body in spec.bodies[1:]:
            if body.explicitinertial or (body.mass > 0.0 and not body.geoms):
                spec.adopt_inertial(body)  # one that a program set is not written otherwise
        model = spec.compile()
        check_finite(model)
        _name_folders(spec, model)
    with _refused(path):
        sources = collect_sources(path, spec.to_xml().encode())
    held = {
        name: data.encode() if isinstance(data, str) else data for name, data in spec.assets.items()
    }
    sources = with_assets(sources, held)
    check_numbers(sources)
    check_options(spec)
    return SceneSource(path, spec, sources, {})


def _name_folders(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Writes the whole path of each asset of a part that was attached from another folder.

    MuJoCo finds such a file beside the part, but writes its name alone. ``model`` is the compiled
    specification.
    """
    for elements, places, folder in (
        (spec.meshes, model.mesh_pathadr, spec.meshdir),
        (spec.hfields, model.hfield_pathadr, spec.meshdir),
        (spec.textures, model.tex_pathadr, spec.texturedir),
        (spec.skins, model.skin_pathadr, spec.meshdir),
    ):
        for element in elements:
            start = int(places[element.id])
            found = Path(model.paths[start:].partition(b"\0")[0].decode())
            own = Path(spec.modelfiledir, folder, element.file)
            if start >= 0 and found.is_file() and found.absolute() != own.absolute():
                element.file = str(found.absolute())


def _written(source: SceneSource) -> SceneSource:
    """Returns a specification as it is read back from its recorded sources."""
    main, *assets = source.sources
    remark = (
        "; that is the specification as MuJoCo writes it, and a run records it so: where a name is "
        "repeated, attach the part with a prefix"
    )
    with _refused(source.path, remark):
        spec = mujoco.MjSpec.from_string(
            main.data.decode(), assets={asset.name: asset.data for asset in assets}
        )
    spec.modelfiledir = main.name.rpartition("/")[0]
    return replace(source, spec=spec)


def plain_model(source: SceneSource) -> mujoco.MjModel:
    """Compiles a scene without handle and coupling, so that it needs no grip.

    An integrator that MuJoCo refuses for this scene is replaced, as the bridge does.
    """
    with _refused(source.path):
        spec = copy_of(source.spec)
    _limit_memory(spec)
    with suppress(ValueError):
        return _compiled(spec)[0]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    with _refused(source.path):
        return _compiled(spec)[0]


def _limit_memory(spec: mujoco.MjSpec) -> tuple[SceneChange, ...]:
    """Reduces a memory beyond ``MAX_MEMORY``, before MuJoCo reserves it to compile."""
    before, rows = spec.memory, max(spec.njmax, spec.nconmax)
    if before <= MAX_MEMORY and rows <= MAX_ROWS:
        return ()
    spec.memory, spec.nstack, spec.njmax, spec.nconmax = MAX_MEMORY, -1, -1, -1
    asked = format_si(before, "B") if before > MAX_MEMORY else f"for {rows} rows"
    return (SceneChange(f"memory: {asked} → {_memory(MAX_MEMORY)}", "memory"),)


def _compiled(spec: mujoco.MjSpec) -> tuple[mujoco.MjModel, tuple[SceneChange, ...]]:
    """Compiles a scene with the least memory or more; returns the model and the change."""
    model = spec.compile()
    if model.narena >= MIN_MEMORY:
        return model, ()
    before, spec.memory, spec.nstack, spec.njmax = model.narena, -1, -1, -1
    model = spec.compile()
    words = f"memory: {format_si(before, 'B')} → {_memory(model.narena)}"
    return model, (SceneChange(words, "memory"),)


def _memory(size: int) -> str:
    """Returns a size in bytes, and as <size> takes it, in whole 2^20 bytes."""
    return f'{format_si(size, "B")} (memory="{math.ceil(size / (1 << 20))}M")'


MIN_MEMORY = 13 << 20
"""Memory in bytes that MuJoCo gives the smallest scene by default, for contacts and constraints. A
scene with less in its file gets the default, because a full memory drops contacts."""

MAX_MEMORY = 128 << 20
"""Memory in bytes that a scene gets at most. Each copy of its state reserves as much, and an audit
has a limit of memory. It holds 3000 rows of constraints with all their products, ten times what a
step of 1 ms has time for, and a run whose contacts need more is ended (``kernel.codes``)."""

MAX_ROWS = 1000
"""Largest ``njmax`` or ``nconmax`` that is kept; MuJoCo reserves 50 MB for 1000 and 3 GB for 8000,
as old files ask for. More rows get ``MAX_MEMORY``."""


def compile_scene(
    source: SceneSource,
    grip: str | Sequence[str] | None = None,
    *,
    as_is: bool = False,
    warns: bool = True,
    checks_start: bool = True,
    stacklevel: int = 2,
) -> Scene:
    """Adds handle and coupling to a scene that was read, and compiles it.

    Args:
        source: Result of ``read_scene``, possibly with a changed specification; it is not modified.
        grip: Grip or grips, as for ``load_scene``.
        as_is: If true, a scene that must be changed to be felt is refused.
        warns: If true, deviations of the run from the file are issued as warnings.
        checks_start: If true, a start that is not finite is refused.
        stacklevel: Stack level of the warnings.

    Raises:
        SceneError: The scene cannot be compiled or put behind a device.

    Warns:
        UserWarning: The run deviates from the file in a detail.
    """
    path = source.path
    with _refused(path):
        spec = copy_of(source.spec)
    if grip is None:
        grip = own_grips(source) or "grip"
    grips = (grip,) if isinstance(grip, str) else tuple(grip)
    if not grips:
        raise SceneError(f"no grip is named for scene '{path}'; name one per hand")
    refuse_callbacks()
    changes = (*set_options(spec, as_is=as_is), *_limit_memory(spec))
    with _refused(path):
        about_grip = [said for each in grips for said in add_grip(spec, each)]
    attach_handles(spec, grips)
    with _refused(path):
        model, sized = _compiled(spec)
        changes += sized
        if not as_is and (excluded := exclude_nested(spec, model, grips[0])):
            changes, model = changes + excluded, spec.compile()
        concerns = [each + MAY_BE_ACTIVE for each in unmetered_work(model).values()]
        concerns += [*filter(None, [gradientless_flexes(model)]), *mixed_forms(model), *about_grip]
        held = list[str]()
        for each in dict.fromkeys(grips):
            check_model(model, each)
        for each in dict.fromkeys(grips):
            replaced, holding = take_over_mocap(spec, model, each, as_is=as_is)
            changes, held = changes + replaced, [*held, *holding]
        concerns += [f"{each}; to let it go write {LET_GO}" for each in held]
        model, started, remaining = _start_set(spec, model, source, as_is=as_is)
        changes, concerns = changes + started, [*concerns, *remaining]
        seat_handle(model, grips[0])
        data, values = mujoco.MjData(model), dict(source.parameters)
        scene = Scene(
            path, grips[0], model, data, source.sources, values, changes, as_is, _spec=spec
        )
        scene.other_grips, scene.held = grips[1:], tuple(held)
        scene.reset()
        for each in dict.fromkeys(grips):
            scene.differences += limit_motors_alone(model, scene.data, each, as_is=as_is)
        scene.differences += announce_gravity_compensation(model)
    if checks_start:
        check_start(scene.data, grips[0])
    if as_is:
        refuse_overlap(model, scene.data, grips[0])
    else:
        scene.differences += announce_overlaps(model, scene.data)
    if warns:
        for concern in concerns:
            warnings.warn(SceneWarning(path, concern), stacklevel=stacklevel)
    return scene


def _start_set(
    spec: mujoco.MjSpec, model: mujoco.MjModel, source: SceneSource, *, as_is: bool
) -> tuple[mujoco.MjModel, tuple[SceneChange, ...], tuple[str, ...]]:
    """Puts the start on the constraints, in keyframe ``home``; returns changes and concerns.

    A scene without this keyframe gets one if its start is moved.
    """
    start, has_keyframe = start_on_constraints(model, is_moved=not as_is), find_start(model) >= 0
    if start.positions is not None:
        if not has_keyframe:
            spec.add_key(name=START_KEYFRAME)
            model = spec.compile()
        model.key_qpos[find_start(model)] = start.positions
    held = hold_servos(model) if has_keyframe and not as_is else ()
    only = SceneChange("start: MuJoCo's initial pose → the only keyframe", "only keyframe")
    first = (only,) if has_keyframe and not model.key(find_start(model)).name else ()
    return model, first + start.changes + held, start.remaining


@contextmanager
def _refused(path: Path, remark: str = "") -> Iterator[None]:
    """Converts MuJoCo's errors during compilation into a SceneError that names the scene."""
    try:
        yield
    except (ValueError, OSError, MemoryError, mujoco.FatalError) as error:
        words = folder_words(error) if isinstance(error, OSError) else ""
        words = words or _found_nowhere(path, error)
        raise SceneError(f"cannot compile scene '{path}': {words}{remark}") from None


def _found_nowhere(path: Path, error: Exception) -> str:
    """Returns MuJoCo's words; of a file that it does not find, with the folder it looked in."""
    if found := re.match("Error: Error opening file '(.*)'", str(error)):  # MuJoCo's own
        places = f"'{path.resolve().parent}' and its meshdir or texturedir, if it names one"
        with suppress(OSError):
            if "'package:" in str(error):
                places += (
                    '; MuJoCo resolves no package://, but <mujoco><compiler strippath="true" '
                    'meshdir="FOLDER"/></mujoco> in <robot> finds the bare names in FOLDER'
                )
            elif b"<include" in path.read_bytes():  # a part's names are told as absolute paths
                places += (
                    '; for the files of a part <compiler meshdir="FOLDER"/> behind its <include> '
                    "counts, with FOLDER seen from here"
                )
            elif re.match(r"[/\\]|\w:[/\\]", found[1]):
                return f"{clause(error)}, an absolute path; write it relative to the scene's file"
        return f"{clause(error)}, looked for in {places}"
    return clause(error)

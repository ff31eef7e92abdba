"""Loads an MJCF scene and puts a handle and a coupling into it."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np

from hapticbridge.coupling import Coupling
from hapticbridge.errors import SceneError
from hapticbridge.kernel.state import COUPLING_ACTUATORS, HANDLE, WELD_NAME
from hapticbridge.scene.attach import attach_handle, seat_handle, set_options
from hapticbridge.scene.checks import check_model, check_numbers, check_options, check_start
from hapticbridge.scene.library import scene_path
from hapticbridge.scene.parameters import apply_parameters
from hapticbridge.scene.source import SourceFile, collect_sources
from hapticbridge.scene.weld import add_weld, carry_over, set_weld_gains

START_KEYFRAME = "home"


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


@dataclass(slots=True)
class Scene:
    """A compiled scene with its handle, ready to be stepped.

    Attributes:
        path: The MJCF file.
        grip: Name of the site on the tool.
        model: MuJoCo's model, with the bridge's handle and coupling in it.
        data: Its state.
        sources: The original bytes of the file, its includes and its assets.
        parameters: Value of each of the scene's parameters, in the unit that its file names.
    """

    path: Path
    grip: str
    model: mujoco.MjModel
    data: mujoco.MjData
    sources: tuple[SourceFile, ...]
    parameters: dict[str, float] = field(default_factory=dict)

    _spec: mujoco.MjSpec | None = None
    _is_claimed: bool = False
    _reach: float = 0.0

    def claim(self) -> None:
        """Reserves the scene for one bridge: two would move the same tool.

        Raises:
            SceneError: Another bridge has it.
        """
        if self._is_claimed:
            raise SceneError(f"scene '{self.name}' is in use by another bridge; load it again")
        self._is_claimed = True

    def release(self) -> None:
        """Lets another bridge have the scene."""
        self._is_claimed = False

    @property
    def name(self) -> str:
        """The file's name without its ending."""
        return self.path.stem

    def reset(self) -> None:
        """Puts the scene to keyframe ``home`` if it has one, else ``qpos0``; handle at the grip."""
        model, data = self.model, self.data
        key = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, START_KEYFRAME)
        if key >= 0:
            mujoco.mj_resetDataKeyframe(model, data, key)
        else:
            mujoco.mj_resetData(model, data)
        # the model has it there too, unless its start was changed since it was loaded
        mujoco.mj_kinematics(model, data)
        handle = model.body_mocapid[model.body(HANDLE).id]
        data.mocap_pos[handle] = data.site(self.grip).xpos
        data.mocap_quat[handle] = data.site_xquat[model.site(self.grip).id]
        mujoco.mj_forward(model, data)

    def grip_pose(self) -> tuple[float, ...]:
        """Returns the grip's pose (x, y, z, qw, qx, qy, qz) in the world frame, in m."""
        site_id = self.model.site(self.grip).id
        position, quaternion = self.data.site_xpos[site_id], self.data.site_xquat[site_id]
        sign = 1.0 if quaternion[0] >= 0 else -1.0
        return tuple(float(value) for value in (*position, *(sign * quaternion)))

    def set_timestep(self, period: float, substeps: int = 1) -> None:
        """Sets MuJoCo's timestep to period / substeps, in s.

        Raises:
            SceneError: The period is not finite and positive, or there is no whole substep.
        """
        if not np.isfinite(period) or period <= 0:
            raise SceneError(f"period is {period!r} s; it must be finite and > 0")
        if substeps < 1:
            raise SceneError(f"substeps is {substeps}; it must be 1 or more")
        self.model.opt.timestep = period / substeps

    def set_reach(self, distance: float) -> None:
        """Lets MuJoCo find contacts, without a force, from a distance in m before they touch.

        It is added to the gaps that the scene's file gives.
        """
        if distance == self._reach:
            return
        more, self._reach = distance - self._reach, distance
        self.model.geom_gap += more
        self.model.pair_gap += more
        self.model.flex_gap += more

    def set_coupling(self, coupling: Coupling) -> None:
        """Sets the gains of the coupling's actuators; needs no compilation."""
        self.set_gains(
            (coupling.damping, coupling.stiffness, coupling.damping),
            (
                coupling.rotational_damping,
                coupling.rotational_stiffness,
                coupling.rotational_damping,
            ),
        )

    def set_gains(
        self, force: tuple[float, float, float], torque: tuple[float, float, float]
    ) -> None:
        """Sets factor of the control, stiffness and damping of the coupling's actuators.

        Args:
            force: Of the three that push, in SI units per metre and metre per second.
            torque: Of the three that turn, in SI units per rad and rad per second.
        """
        for axis, name in enumerate(COUPLING_ACTUATORS):
            gain, stiffness, damping = force if axis < 3 else torque  # forces come first
            actuator_id = self.model.actuator(name).id
            self.model.actuator_gainprm[actuator_id, 0] = gain
            self.model.actuator_biasprm[actuator_id, 1] = -stiffness
            self.model.actuator_biasprm[actuator_id, 2] = -damping

    def set_weld(self, coupling: Coupling | None) -> None:
        """Welds the grip to the handle with K and B as ``solref``, or (None) takes the weld off.

        A weld changes the model's size, so ``model`` and ``data`` become new ones; what was changed
        in the old model is carried over. Without a weld before and after, nothing changes.

        Raises:
            SceneError: The scene was not made by ``load_scene``, or has a constraint of that name.
        """
        has_weld = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_EQUALITY, WELD_NAME) >= 0
        if has_weld != (coupling is not None):
            if self._spec is None:
                raise SceneError("only a scene from load_scene can be welded to its handle")
            spec = self._spec.copy()
            if coupling is not None:
                add_weld(spec, self.grip)
            model = _compiled(spec, self.sources)
            carry_over(self.model, model)
            self.model, self.data = model, mujoco.MjData(model)
        if coupling is not None:
            set_weld_gains(self.model, coupling)


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
        raise SceneError(f"cannot read scene '{path}': {_sentence(error)}") from None
    concerns = check_options(spec)
    check_numbers(sources)
    values = apply_parameters(spec, path, parameters)
    return SceneSource(path, spec, sources, values, tuple(concerns))


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
    try:
        model = _compiled(spec, source.sources)
        concerns = [*source.concerns, *check_model(model, grip)]
        seat_handle(model, grip)
        data, values = mujoco.MjData(model), dict(source.parameters)
        scene = Scene(path, grip, model, data, source.sources, values, spec)
        scene.reset()
    except (ValueError, OSError, MemoryError, mujoco.FatalError) as error:
        raise SceneError(f"cannot compile scene '{path}': {_sentence(error)}") from None
    if checks_start:
        check_start(model, scene.data, grip)
    if warns:
        for concern in concerns:
            warnings.warn(f"scene '{path}': {concern}", UserWarning, stacklevel=stacklevel)
    return scene


def _compiled(spec: mujoco.MjSpec, sources: tuple[SourceFile, ...]) -> mujoco.MjModel:
    """Compiles a scene from the bytes of its files instead of from their places.

    A compiled model names the files of its meshes and textures; with their places it would differ
    from folder to folder, and a recording would tell where its user keeps what. Files outside the
    scene's own folder, and whatever MuJoCo finds only by itself, are taken from where they are.
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
    (r"could not find decoder.*", "its name must end in .xml"),
    (r"(engine error: Could not allocate memory)", r"\1; ask for less in <size>"),
)
"""How MuJoCo words an error, and how it reads as part of a sentence."""


def _sentence(error: Exception) -> str:
    text = " ".join(str(error).split())
    for pattern, wording in _WORDING:
        text = re.sub(pattern, wording, text)
    return text or type(error).__name__

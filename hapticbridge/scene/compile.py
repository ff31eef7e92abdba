"""Compilation of a scene from the bytes of its files."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np

from hapticbridge.kernel.codes import coupling_ids, handle_ids
from hapticbridge.kernel.mujoco_c import quiet
from hapticbridge.scene.treatment import SceneChange

# Custom texts and numbers of a scene (``<custom>`` in MJCF), by name


def custom_text(model: mujoco.MjModel, name: str) -> str:
    """Returns the custom text of a name; empty if the scene has none.

    The bridge uses the text ``about``, a sentence that describes the scene, and ``grip_axis``, the
    joint that a device's grip axis moves. ``grips`` are the grips that several hands hold, and
    ``pulse`` is the pulse of the tool's blows (``demand.pulse``).
    """
    text_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXT, name)
    if text_id < 0:
        return ""
    start, size = model.text_adr[text_id], model.text_size[text_id]
    return bytes(model.text_data[start : start + size - 1]).decode()


def custom_numbers(model: mujoco.MjModel, name: str) -> tuple[float, ...]:
    """Returns the custom numbers of a name, finite or not; empty if the scene has none.

    The bridge uses ``picture``, the time in s on the hand path at which the scene is drawn. It also
    uses ``simulated_hand``, the hand that follows the path (``device.simulated.device``).
    """
    number_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, name)
    if number_id < 0:
        return ()
    start, size = model.numeric_adr[number_id], model.numeric_size[number_id]
    return tuple(model.numeric_data[start : start + size].tolist())


PROGRAM_CREDIT = "another_programs_credit"
"""Custom number of a scene that another program steps: what it may give to a hand, in J."""


def unfused_model(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compiles a copy in which bodies without joints are not fused with their parents.

    Each body of the specification is then one of the model, with its own mass. MuJoCo fuses those
    of a URDF, and those of a scene with ``fusestatic``. A free joint below one of them becomes a
    ball joint, as MuJoCo takes no free joint there.
    """
    copy = spec.copy()
    if copy.compiler.fusestatic:
        copy.compiler.fusestatic = False
        for joint in copy.joints:
            if joint.type == mujoco.mjtJoint.mjJNT_FREE and joint.parent.parent.id:
                joint.type = mujoco.mjtJoint.mjJNT_BALL
        for key in list(copy.keys):  # they have the size of the free joints
            copy.delete(key)
    return copy.compile()


# Start of a scene, with the handle at the grip

START_KEYFRAME = "home"
"""Name of the keyframe that a scene starts from. A scene's only keyframe is one too if it has no
name and is at rest; without either a scene starts from ``qpos0``."""


def handles(model: mujoco.MjModel, grip: str) -> tuple[tuple[int, int], ...]:
    """Returns the ids of body and grip's site of every handle; ``grip`` is that of the first."""
    first, *others = handle_ids(model).items()
    found = [(first[1], int(model.site(grip).id))]
    for hand, body_id in others:
        found.append((body_id, int(model.actuator_trnid[coupling_ids(model, hand)[0], 0])))
    return tuple(found)


def find_start(model: mujoco.MjModel) -> int:
    """Returns the id of the keyframe that a scene starts from, or -1."""
    return start_among([model.key(key) for key in range(model.nkey)])


def start_among(keyframes: Sequence[Any]) -> int:
    """Returns the index of the start among all keyframes of a scene or specification, or -1."""
    if len(keyframes) == 1 and not keyframes[0].name and not np.any(keyframes[0].qvel):
        return 0
    names = [keyframe.name for keyframe in keyframes]
    return names.index(START_KEYFRAME) if START_KEYFRAME in names else -1


def reset(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Resets the data to the start, without a computation."""
    if (key := find_start(model)) >= 0:
        mujoco.mj_resetDataKeyframe(model, data, key)
    else:
        mujoco.mj_resetData(model, data)


def go_to_start(model: mujoco.MjModel, data: mujoco.MjData, grip: str) -> None:
    """Resets the data to the start, with the handle at the grip, and calls ``mj_forward``."""
    reset(model, data)
    # the model's own handle pose may be outdated if its start was changed after loading
    mujoco.mj_kinematics(model, data)
    for body_id, site_id in handles(model, grip):
        data.mocap_pos[model.body_mocapid[body_id]] = data.site_xpos[site_id]
        data.mocap_quat[model.body_mocapid[body_id]] = data.site_xquat[site_id]
    with quiet():
        mujoco.mj_forward(model, data)


def seat_handle(model: mujoco.MjModel, grip: str) -> None:
    """Places every handle at its grip, in ``qpos0`` and in every keyframe of a compiled model."""
    data = mujoco.MjData(model)
    placed = handles(model, grip)
    mujoco.mj_kinematics(model, data)
    for body_id, site_id in placed:
        model.body_pos[body_id] = data.site_xpos[site_id]
        model.body_quat[body_id] = data.site_xquat[site_id]
    for key in range(model.nkey):
        mujoco.mj_resetDataKeyframe(model, data, key)
        mujoco.mj_kinematics(model, data)
        for body_id, site_id in placed:
            mocap_id = int(model.body_mocapid[body_id])
            model.key_mpos[key].reshape(-1, 3)[mocap_id] = data.site_xpos[site_id]
            model.key_mquat[key].reshape(-1, 4)[mocap_id] = data.site_xquat[site_id]


def hold_servos(model: mujoco.MjModel) -> tuple[SceneChange, ...]:
    """Aims the position servos at their pose in the start's keyframe if this has no controls.

    MuJoCo reads missing controls as zeros, so that the servos would fling the scene out of the pose
    that the keyframe describes.

    Returns:
        The change, as ``name: old → new``; nothing if no servo was to leave its pose.
    """
    key = find_start(model)
    if key < 0 or np.any(model.key_ctrl[key]) or np.any(model.key_act[key]):
        return ()
    data, moved = mujoco.MjData(model), []
    mujoco.mj_resetDataKeyframe(model, data, key)
    mujoco.mj_fwdPosition(model, data)
    for actuator in range(model.nactuator):
        control, output = model.actuator_ctrladr[actuator], model.actuator_outadr[actuator]
        if _is_servo(model, actuator):
            target = data.actuator_length[output]
            if model.actuator_ctrllimited[control]:
                target = np.clip(target, *model.actuator_ctrlrange[control])
            if abs(target) > SERVO_ERROR:
                model.key_ctrl[key, control] = target
                moved.append(model.actuator(actuator).name or str(actuator))
    count = f"{len(moved)} servo{'s' if len(moved) > 1 else ''}"
    if not moved:
        return ()
    name = f"keyframe '{START_KEYFRAME}'" if model.key(key).name else "the only keyframe"
    words = f"ctrl of {count} in {name}: 0 → its pose"
    return (SceneChange(words, "servos"),)


def _is_servo(model: mujoco.MjModel, actuator: int) -> bool:
    """Returns True for a position servo, whose force is k (u − l) at rest."""
    gain = float(model.actuator_gainprm[actuator, 0])
    return bool(
        gain > 0.0
        and model.actuator_biasprm[actuator, 1] == -gain
        and model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_FIXED
        and model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE
        and model.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_NONE
        and model.actuator_trntype[actuator] != mujoco.mjtTrn.mjTRN_SITE
    )


SERVO_ERROR = 1e-6
"""Smallest distance in m or rad between a servo's pose and zero that is worth a change."""


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
    (
        r"Schema violation: (unrecognized element \(element 'composite'.*?\))",
        r"\1: MuJoCo has none any more; <flexcomp> and <replicate> do much of it, or an older "
        "MuJoCo saves the scene with all its bodies (mj_saveLastXML)",
    ),
    (r"(engine error: Could not allocate memory)", r"\1; reduce the numbers in <size>"),
)
"""Patterns of MuJoCo's error messages, and their wording after a colon."""


_LONGEST = 1000  # of a message, which may quote a whole file


def clause(error: Exception) -> str:
    """Returns MuJoCo's error message, worded to follow a colon."""
    text = " ".join(str(error)[:_LONGEST].split())
    for pattern, wording in _WORDING:
        text = re.sub(pattern, wording, text)
    return text or type(error).__name__

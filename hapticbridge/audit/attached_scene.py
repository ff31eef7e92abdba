"""Checks of the attached scene against the metadata."""

from __future__ import annotations

import hashlib

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.jsonable import read_json
from hapticbridge.kernel.names import COUPLING_ACTUATORS
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.provenance import MODEL_ATTACHMENT, STARTS, meta_start, processor, start_of
from hapticbridge.recording import RecordingFile
from hapticbridge.rendering import check_prepared, method_named

FOREIGN_TOLERANCE = 1e-9
"""Allowed difference on another processor, relative to a field's largest value; other vector
instructions round differently. A larger tolerance would hide tampering, a smaller one would refuse
honest recordings."""


def attached_model(recording: RecordingFile, parameters: RunParameters) -> mujoco.MjModel:
    """Loads the attached model and checks it against the metadata.

    Raises:
        RecordingError: It contradicts the metadata or cannot be loaded.
    """
    content = recording.attachments[MODEL_ATTACHMENT]
    if hashlib.sha256(content).hexdigest() != recording.meta.get("scene_sha256"):
        raise RecordingError("the attached model is not the one of scene_sha256")
    try:
        model = mujoco.MjModel.from_binary_path(
            MODEL_ATTACHMENT, assets={MODEL_ATTACHMENT: content}
        )
    except ValueError as error:
        raise RecordingError(f"the attached model cannot be loaded: {error}") from None
    for name in (*COUPLING_ACTUATORS, parameters.grip):
        kind = mujoco.mjtObj.mjOBJ_SITE if name == parameters.grip else mujoco.mjtObj.mjOBJ_ACTUATOR
        if mujoco.mj_name2id(model, kind, name) < 0:
            raise RecordingError(f"the attached model has no '{name}'")
    method = method_named(recording.meta.get("method", ""))
    step = parameters.period / parameters.substeps
    forces, torques = method.gains(parameters.coupling, step)
    for axis, name in enumerate(COUPLING_ACTUATORS):
        actuator_id = model.actuator(name).id
        factor, stiffness, damping = forces if axis < 3 else torques
        bias = model.actuator_biasprm[actuator_id].tolist()
        gain = float(model.actuator_gainprm[actuator_id, 0])
        if (bias[1], bias[2], gain) != (-stiffness, -damping, factor):
            raise RecordingError(
                f"the attached model's coupling has K = {-bias[1]!r}, B = {gain!r} in {name}, "
                f"the metadata say {stiffness!r}, {factor!r}"
            )
    try:
        check_prepared(model, parameters, method)
    except HapticBridgeError as error:
        raise RecordingError(f"the attached model does not fit the metadata: {error}") from None
    if model.opt.timestep != parameters.period / parameters.substeps:
        raise RecordingError(
            f"the attached model's timestep is {model.opt.timestep!r} s, the metadata's period "
            f"{parameters.period!r} s with {parameters.substeps} substeps"
        )
    return model


def check_start(recording: RecordingFile, state: NDArray[np.void]) -> None:
    """Refuses metadata that contradict the start of the attached scene.

    Raises:
        RecordingError: They do.
    """
    for name in STARTS:
        recorded = meta_start(recording.meta, name)
        present = start_of(state, name)
        if not np.allclose(recorded, present, rtol=FOREIGN_TOLERANCE, atol=FOREIGN_TOLERANCE) or (
            is_same_processor(recording) and recorded != present
        ):
            raise RecordingError(
                f"metadata '{name}' is {recorded}, the attached scene starts with {present}"
            )


def is_same_processor(recording: RecordingFile) -> bool:
    """Returns True if the recording's processor model is this one or not stated."""
    try:
        return bool(read_json(recording.meta["host"])["processor"] == processor())
    except (KeyError, TypeError, ValueError):
        return True

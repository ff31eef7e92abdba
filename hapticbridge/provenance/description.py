"""Run description in a recording, and run parameters read back from it.

Metadata are strings; their numbers read back to the same double.
"""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping
from datetime import UTC, datetime

from hapticbridge.coupling import Coupling
from hapticbridge.device import DeviceInfo
from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.kernel.guarding import UNGUARDED, Guarding
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.scheme import WELD
from hapticbridge.kernel.state import Binding
from hapticbridge.provenance.metadata import meta_count, meta_float, meta_numbers
from hapticbridge.provenance.start import (
    STARTS,
    STATE_ATTACHMENT,
    compiled_model,
    start_of,
    start_state,
)
from hapticbridge.provenance.versions import processor, versions
from hapticbridge.recording import Attachment
from hapticbridge.rendering import Method, method_named
from hapticbridge.scene import Scene

MODEL_ATTACHMENT = "model.mjb"
SOURCE_PREFIX = "scene/"

_MID_RUN = "mid-run"
"""Value of metadata ``began`` in recordings of earlier versions that begin during a run."""

_FLOATS = ("scale", "force_scale", "force_limit", "torque_limit", "contact_stiffness")
_POSES = ("device_origin", "handle_origin", "device_start")
_GAINS = ("stiffness", "damping", "rotational_stiffness", "rotational_damping")


def attachments(scene: Scene) -> list[Attachment]:
    """Returns the scene's sources, compiled model and start state as attachments.

    Call it after the scene was prepared and reset, because gains and timestep are part of the
    model.
    """
    kept = [
        Attachment(SOURCE_PREFIX + source.name, "application/octet-stream", source.data)
        for source in scene.sources
    ]
    model = compiled_model(scene.model)
    state = start_state(scene.model, scene.data).astype("<f8").tobytes()
    kept.append(Attachment(MODEL_ATTACHMENT, "application/octet-stream", model))
    kept.append(Attachment(STATE_ATTACHMENT, "application/octet-stream", state))
    return kept


def describe_run(
    scene: Scene,
    parameters: RunParameters,
    binding: Binding,
    *,
    method: str,
    device: DeviceInfo,
    clock: str,
) -> dict[str, str]:
    """Returns the recording's metadata; ``parameters_of`` is the inverse."""
    coupling = parameters.coupling
    felt = parameters.felt
    meta = {name: repr(float(getattr(parameters, name))) for name in _FLOATS}
    meta |= {name: repr(float(getattr(coupling, name))) for name in _GAINS}
    meta |= {name: json.dumps(getattr(parameters, name)) for name in (*_POSES, "axes")}
    for name, count in STARTS.items():
        start = start_of(binding.state, name)
        meta[name] = json.dumps(start if count > 1 else start[0])
    return meta | {
        "period_s": repr(parameters.period),
        "substeps": str(parameters.substeps),
        "ramp_ticks": str(parameters.ramp_ticks),
        "guard": parameters.guarding.to_json(),
        "method": method,
        "felt": json.dumps(felt and [getattr(felt, name) for name in _GAINS]),
        "discretization": method_named(method).discretization,
        "grip": parameters.grip,
        "clock": clock,
        "device": device.to_json(),
        "scene": scene.name,
        "scene_file": scene.path.name,
        "scene_parameters": json.dumps(scene.parameters),
        "scene_sha256": hashlib.sha256(compiled_model(scene.model)).hexdigest(),
        "versions": json.dumps(versions(), sort_keys=True),
        "host": json.dumps(
            {"system": platform.system(), "machine": platform.machine(), "processor": processor()}
        ),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def _felt(meta: Mapping[str, str], method: Method) -> Coupling | None:
    """Returns a weld's measured coupling; None for other methods."""
    if method.scheme != WELD:
        return None
    return Coupling(*meta_numbers(meta, "felt", len(_GAINS)))


def parameters_of(meta: Mapping[str, str]) -> RunParameters:
    """Returns the parameters of a recorded run.

    Raises:
        RecordingError: A value is missing or out of range.
    """
    if meta.get("began") == _MID_RUN:
        raise RecordingError(
            "the recording begins in mid-run, which only earlier versions of hapticbridge recorded "
            "and judged; 'hapticbridge export' still reads its ticks"
        )
    try:
        method = method_named(meta.get("method", ""))
        device = None if method.has_law else DeviceInfo.from_json(meta.get("device", ""))
        burning, rotational = (None, None) if device is None else device.burning_damping
        return RunParameters(
            grip=meta.get("grip", ""),
            period=meta_float(meta, "period_s"),
            substeps=meta_count(meta, "substeps"),
            coupling=Coupling(**{name: meta_float(meta, name) for name in _GAINS}),
            ramp_ticks=meta_count(meta, "ramp_ticks"),
            axes=meta_numbers(meta, "axes", 9),
            scale=meta_float(meta, "scale"),
            force_scale=meta_float(meta, "force_scale"),
            force_limit=meta_float(meta, "force_limit"),
            torque_limit=meta_float(meta, "torque_limit"),
            device_origin=meta_numbers(meta, "device_origin", 7),
            handle_origin=meta_numbers(meta, "handle_origin", 7),
            device_start=meta_numbers(meta, "device_start", 7),
            scheme=method.scheme,
            felt=_felt(meta, method),
            contact_stiffness=meta_float(meta, "contact_stiffness"),
            device_damping=burning,
            device_rotational_damping=rotational,
            guarding=Guarding.from_json(meta["guard"]) if "guard" in meta else UNGUARDED,
        )
    except RecordingError:
        raise
    except HapticBridgeError as error:
        raise RecordingError(f"the recording's metadata are out of range: {error}") from None

"""Start of a run: MuJoCo's state, compiled model, and energies."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import RecordingError

STATE_ATTACHMENT = "start_state.f64"

STARTS = {"handle_start": 7, "tool_start": 7, "start_kinetic": 1, "start_potential": 1}
"""Start values of the energy balance, with their number of elements: poses in m, energies in J."""

_STORED = {"start_kinetic": "kinetic", "start_potential": "potential"}
_STATE = mujoco.mjtState.mjSTATE_INTEGRATION


def compiled_model(model: mujoco.MjModel) -> bytes:
    """Returns the bytes of ``mj_saveModel``, equal in every compilation of one scene."""
    buffer = np.zeros(mujoco.mj_sizeModel(model), dtype=np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def start_state(model: mujoco.MjModel, data: mujoco.MjData) -> NDArray[np.float64]:
    """Returns the full state on which MuJoCo's next step depends."""
    state = np.zeros(mujoco.mj_stateSize(model, _STATE))
    mujoco.mj_getState(model, data, state, _STATE)
    return state


def restore_state(model: mujoco.MjModel, data: mujoco.MjData, state: bytes) -> None:
    """Sets data to a state from ``start_state``.

    Raises:
        RecordingError: The bytes are not a state of this model.
    """
    expected = 8 * mujoco.mj_stateSize(model, _STATE)
    if len(state) != expected:
        raise RecordingError(
            f"attachment '{STATE_ATTACHMENT}' has {len(state)} bytes; the attached model needs "
            f"{expected}"
        )
    mujoco.mj_resetData(model, data)
    mujoco.mj_setState(model, data, np.frombuffer(state, dtype="<f8").astype(np.float64), _STATE)
    mujoco.mj_forward(model, data)
    # mj_forward runs the solver and changes the warm start, so the state is set again
    mujoco.mj_setState(model, data, np.frombuffer(state, dtype="<f8").astype(np.float64), _STATE)


def start_of(state: NDArray[np.void], name: str) -> list[float]:
    """Returns one of ``STARTS`` from the kernel's state before the first tick."""
    if name in _STORED:
        return [float(state[_STORED[name]][0])]
    body = name.removesuffix("_start")
    pose = (*state[f"{body}_position"][0], *state[f"{body}_quaternion"][0])
    return [float(value) for value in pose]

"""Inputs of the scene during a run.

An input is a list of plain writes into MuJoCo's data. The bridge applies them, the recording keeps
them, and a re-simulation applies them again at the recorded tick.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from hapticbridge.errors import SceneError, choices
from hapticbridge.kernel.codes import HANDLE, added_actuators, hand_count, name_of_hand
from hapticbridge.units import format_count

Write = tuple[str, int, list[float]]
"""Field of ``mjData``, index of the first number in it, and the numbers."""

_FIELDS = ("ctrl", "qfrc_applied", "xfrc_applied", "mocap_pos", "mocap_quat")


def input_writes(
    model: mujoco.MjModel,
    *,
    ctrl: Mapping[str, ArrayLike] | None = None,
    mocap: Mapping[str, ArrayLike] | None = None,
    joint_force: Mapping[str, ArrayLike] | None = None,
    body_wrench: Mapping[str, ArrayLike] | None = None,
) -> list[Write]:
    """Translates inputs by name into writes.

    Args:
        model: The scene's model.
        ctrl: Controls by actuator of the scene.
        mocap: Poses (x, y, z[, qw, qx, qy, qz]) in m by mocap body of the scene.
        joint_force: Generalised forces by joint, in N or N m per degree of freedom.
        body_wrench: Wrenches (force, torque) in N and N m by body, in the world frame about its
            centre of mass.

    Raises:
        SceneError: A name does not exist, belongs to the bridge, or has the wrong number of values.
    """
    inputs = {"ctrl": ctrl, "mocap": mocap, "joint_force": joint_force, "body_wrench": body_wrench}
    for kind, values in inputs.items():
        if values is not None and not isinstance(values, Mapping):
            raise SceneError(
                f"{kind} is {values!r:.80}; it must be values by name: {kind}={{'NAME': …}}"
            )
    writes: list[Write] = []
    actuators = [model.actuator(i).name for i in range(model.nactuator)]
    added = {actuators[i] for i in added_actuators(model)}
    own = [name for name in actuators if name not in added]
    for name, value in (ctrl or {}).items():
        actuator_id = _index("actuator", name, own, actuators)
        count = int(model.actuator_ctrlnum[actuator_id])
        numbers = _numbers(f"control of actuator '{name}'", value, (count,))
        writes.append(("ctrl", int(model.actuator_ctrladr[actuator_id]), numbers))
    bodies = [model.body(i).name for i in range(model.nbody)]
    handles = {name_of_hand(HANDLE, hand) for hand in range(hand_count(model))}
    movable = [bodies[i] for i in range(model.nbody) if model.body_mocapid[i] >= 0]
    for name, value in (mocap or {}).items():
        body_id = _index("mocap body", name, [n for n in movable if n not in handles], bodies)
        mocap_id = int(model.body_mocapid[body_id])
        numbers = _numbers(f"pose of mocap body '{name}'", value, (3, 7))
        writes.append(("mocap_pos", 3 * mocap_id, numbers[:3]))
        if len(numbers) == 7:
            norm = float(np.linalg.norm(numbers[3:]))
            if abs(norm - 1.0) > 1e-3:
                raise SceneError(
                    f"quaternion of mocap body '{name}' has norm {norm:g}; it must be 1"
                )
            writes.append(("mocap_quat", 4 * mocap_id, [q / norm for q in numbers[3:]]))
    joints = [model.joint(i).name for i in range(model.njnt)]
    for name, value in (joint_force or {}).items():
        joint_id = _index("joint", name, joints, joints)
        first = int(model.jnt_dofadr[joint_id])
        count = int(np.count_nonzero(model.dof_jntid == joint_id))
        numbers = _numbers(f"force of joint '{name}'", value, (count,))
        writes.append(("qfrc_applied", first, numbers))
    for name, value in (body_wrench or {}).items():
        body_id = _index("body", name, [n for n in bodies[1:] if n not in handles], bodies)
        numbers = _numbers(f"wrench of body '{name}'", value, (6,))
        writes.append(("xfrc_applied", 6 * body_id, numbers))
    return writes


def _index(kind: str, name: str, valid: list[str], everything: list[str]) -> int:
    if name not in valid:
        listed = choices(n for n in valid if n)
        raise SceneError(f"the scene has no {kind} '{name}' to set; there are: {listed}")
    return everything.index(name)


def _numbers(what: str, value: ArrayLike, counts: tuple[int, ...]) -> list[float]:
    try:
        array = np.atleast_1d(np.asarray(value, dtype=np.float64)).ravel()
    except (TypeError, ValueError):
        raise SceneError(f"{what} is {value!r:.80}; it must be numbers") from None
    # MuJoCo treats a larger control as a failure and ignores all controls, also the coupling's
    if array.size not in counts or not np.all(np.abs(array) <= mujoco.mjMAXVAL):
        *some, last = counts
        expected = "".join(f"{count} or " for count in some) + format_count(last, "finite number")
        raise SceneError(
            f"{what} is {array.tolist()}; it must be {expected} up to {mujoco.mjMAXVAL:g}"
        )
    return [float(number) for number in array]


def applied_writes(data: mujoco.MjData, writes: Sequence[Sequence[Any]]) -> Callable[[], None]:
    """Returns a function that applies writes from ``input_writes`` or from a recorded event.

    Raises:
        SceneError: A write names another field or exceeds it.
    """
    located = []
    for field, first, numbers in writes:
        if field not in _FIELDS:
            raise SceneError(f"an input names field '{field}'; inputs are {choices(_FIELDS)}")
        target = getattr(data, field).reshape(-1)
        if not 0 <= first <= first + len(numbers) <= target.size:
            raise SceneError(
                f"an input writes {field}[{first}:{first + len(numbers)}] of {target.size} numbers"
            )
        located.append((target[first : first + len(numbers)], np.array(numbers, np.float64)))

    def apply() -> None:
        for target, numbers in located:
            target[:] = numbers

    return apply

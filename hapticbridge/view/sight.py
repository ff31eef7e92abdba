"""What the page shows of one instant: numbers alone, made by the run and drawn by the page."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.view.geometry import Tendons

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Sight:
    """One instant of a run.

    Attributes:
        time: Of the run's clock in s, when the tick was due.
        places: Where each body is, (nbody, 3) in m.
        turns: How each is turned, quaternions (nbody, 4).
        handle: Where the handle is, (3,) in m.
        handle_turn: How it is turned, a quaternion (4,).
        grip: Where the grip on the tool is, (3,) in m.
        force: On the tool, (3,) in N; the hand feels the opposite.
        contact_places: Shape (n, 3) in m.
        contact_forces: In the world frame, (n, 3) in N.
        tendons: The straight pieces of each that is shown, (m, 2, 3) in m.
    """

    time: float
    places: Array
    turns: Array
    handle: Array
    handle_turn: Array
    grip: Array
    force: Array
    contact_places: Array
    contact_forces: Array
    tendons: tuple[NDArray[np.float32], ...] = ()

    @classmethod
    def of(
        cls,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        row: NDArray[np.void],
        tendons: Tendons,
        contacts: Array,
    ) -> Sight:
        """Looks at a scene.

        Args:
            model: The scene.
            data: Positions after the tick; the poses of bodies are computed here.
            row: Of the tick, one element of ``TICK_DTYPE``.
            tendons: The scene's.
            contacts: Position in m and force in N of each contact, (n, 2, 3).
        """
        mujoco.mj_kinematics(model, data)
        return cls(
            time=1e-9 * float(row["deadline_ns"][0]),
            places=data.xpos.copy(),
            turns=data.xquat.copy(),
            handle=row["handle_position"][0].copy(),
            handle_turn=row["handle_quaternion"][0].copy(),
            grip=row["tool_position"][0].copy(),
            force=row["wrench_on_tool"][0, :3].copy(),
            contact_places=contacts[:, 0],
            contact_forces=contacts[:, 1],
            tendons=tendons.pieces(data),
        )

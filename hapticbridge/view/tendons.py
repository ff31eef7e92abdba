"""Where a scene's tendons run, and how they look."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MOST_PIECES = 10_000
"""Straight pieces of all tendons, as many as MuJoCo's own renderer draws of anything; a tendon
around a pulley has some ten. 1.5 MB."""


class Tendons:
    """The tendons that MuJoCo draws: in groups that are shown, and not those of joints alone.

    MuJoCo says itself where they run, around what they are wrapped and how they sag.

    Args:
        model: The scene.

    Attributes:
        widths: Of each, its diameter in m, (n,).
        colours: Of each, red, green, blue and opacity from 0 to 1, (n, 4).
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model, self._shown = model, list[int]()
        self._scene: mujoco.MjvScene | None = None
        self.widths, self.colours = np.zeros(0), np.zeros((0, 4))
        if not model.ntendon:
            return
        self._scene = mujoco.MjvScene(model, MOST_PIECES)
        self._camera, self._option = mujoco.MjvCamera(), mujoco.MjvOption()
        # nothing but tendons, which takes microseconds
        option = self._option
        for groups in (option.geomgroup, option.sitegroup, option.flexgroup, option.skingroup):
            groups[:] = 0
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        found = {int(piece.objid): piece for piece in self._drawn(data)}
        self._shown = sorted(found)
        first = [found[tendon] for tendon in self._shown]
        self.widths = np.array([2.0 * piece.size[0] for piece in first])
        self.colours = np.array([piece.rgba for piece in first], np.float64).reshape(-1, 4)

    def pieces(self, data: mujoco.MjData) -> tuple[NDArray[np.float32], ...]:
        """Returns the straight pieces of each tendon, (m, 2, 3) in m.

        Args:
            data: With bodies in place (``mj_kinematics``); what depends on them is refreshed.
        """
        found: dict[int, list[Array]] = {tendon: [] for tendon in self._shown}
        for piece in self._drawn(data) if self._shown else ():
            # a capsule along its third axis, from end to end
            half = piece.size[2] * piece.mat[:, 2]
            found[int(piece.objid)].append(np.stack([piece.pos - half, piece.pos + half]))
        return tuple(np.array(each, np.float32).reshape(-1, 2, 3) for each in found.values())

    def _drawn(self, data: mujoco.MjData) -> list[mujoco.MjvGeom]:
        """Returns what MuJoCo would draw of tendons."""
        assert self._scene is not None
        mujoco.mj_comPos(self._model, data)
        mujoco.mj_tendon(self._model, data)
        every = int(mujoco.mjtCatBit.mjCAT_ALL)
        mujoco.mjv_updateScene(
            self._model, data, self._option, None, self._camera, every, self._scene
        )
        kind = int(mujoco.mjtObj.mjOBJ_TENDON)
        return [geom for geom in self._scene.geoms[: self._scene.ngeom] if geom.objtype == kind]

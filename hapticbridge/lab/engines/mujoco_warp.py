"""MuJoCo Warp on the processor: MuJoCo's own models and contacts in single precision.

It is written for thousands of scenes at once on a graphics card. Here it steps one, as a hand needs
it, so that almost all of its cost is that of launching its kernels.

References:
    MuJoCo Warp, https://github.com/google-deepmind/mujoco_warp
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version

import mujoco
import mujoco_warp
import numpy as np
import warp
from numpy.typing import NDArray

from hapticbridge.kernel.pose import Vector
from hapticbridge.lab.engines import base
from hapticbridge.lab.engines.mujoco import SETTINGS, TOOL, MujocoSimulation

MAX_CONTACTS, MAX_ROWS = 200, 1000
"""Contacts and rows of constraints that a scene may have; the library drops those beyond."""


_SETTINGS: Mapping[str, base.Advised] = {
    **SETTINGS,
    "diagexact": base.Advised("not supported", "MuJoCo documentation, MuJoCo Warp"),
    "device": base.Advised("cpu", "MuJoCo documentation, MuJoCo Warp"),
    "precision": base.Advised("single (the only one)", "MuJoCo documentation, MuJoCo Warp"),
}


class MujocoWarpSimulation(MujocoSimulation):
    """A task in MuJoCo Warp; its state is copied to MuJoCo's after every step."""

    def __init__(self, task: base.Task, timestep: float) -> None:
        super().__init__(task, timestep)
        warp.config.quiet = True
        self._model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_DIAGEXACT)
        with warp.ScopedDevice("cpu"):
            self._on_device = mujoco_warp.put_model(self._model)
            self._state = mujoco_warp.put_data(
                self._model, self._data, nconmax=MAX_CONTACTS, njmax=MAX_ROWS
            )

    def advance(self, force: Vector, torque: Vector) -> None:
        """Sets a force in N and a torque in N m at the centre of mass, and steps."""
        state = self._state
        # on the processor these are views
        state.xfrc_applied.numpy()[0, TOOL] = (*force, *torque)
        with warp.ScopedDevice("cpu"):
            mujoco_warp.step(self._on_device, state)
        self._position.flat[:] = state.qpos.numpy()[0]
        self._velocity.flat[:] = state.qvel.numpy()[0]

    def contacts(self) -> base.Contacts:
        """Returns the contacts of the last step."""
        state = self._state
        distances: NDArray[np.float32] = state.contact.dist.numpy()[: int(state.nacon.numpy()[0])]
        return base.Contacts.from_depths(-float(distance) for distance in distances)


def engines() -> tuple[base.Engine, ...]:
    """Returns the engines of this module."""
    warp_version = version("mujoco-warp")
    return (base.Engine("mujoco_warp", warp_version, _SETTINGS, MujocoWarpSimulation),)

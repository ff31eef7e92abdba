"""A recorded run on MuJoCo's stage: the scene, the handle, the coupling and the forces."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticbridge.audit.rerun import Rerun, obstacle
from hapticbridge.errors import RecordingError
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.provenance import parameters_of
from hapticbridge.recording import RecordingFile, Timeline, open_recording

PLACE = 1e-4
"""How far in m the tool of the run simulated again may be from where the record says: less than a
pixel of any picture here. Beyond it the picture would not be of this run."""

LONGEST_ARROW = 0.8
"""Of the scene's extent, without unit: how long the arrow of the largest force is drawn."""

LEAST_REFERENCE = 0.1
"""N: a run with smaller forces is drawn as if they were small, not blown up to the longest."""

CONTACT_SIZE = 0.4
"""Of MuJoCo's default size of a contact's disc, which would hide a tool that touches often."""

_PALE, _RED = np.array([0.75, 0.87, 0.98]), np.array([0.70, 0.15, 0.12])
# pale to dark as well, which the colour-blind see
_GHOST = (0.1, 0.37, 0.71, 0.45)
_HAND = (0.90, 0.38, 0.0, 1.0)


def force_colour(force: float, reference: float) -> NDArray[np.float64]:
    """Returns the colour of a spring that pulls: pale blue at rest, red from a reference force on.

    Args:
        force: Its size in N.
        reference: In N, > 0.

    Returns:
        Red, green and blue from 0 to 1, (3,).
    """
    share = min(abs(force) / reference, 1.0)
    return np.asarray((1.0 - share) * _PALE + share * _RED)


class Stage:
    """A recorded run that can be looked at tick by tick, forwards.

    Args:
        path: The recording.

    Attributes:
        recording: It, without its ticks.
        parameters: Of the run.
        model: The scene.
        data: Its state at the tick last shown, with contacts as they were solved.
        row: The record of that tick, one element of ``TICK_DTYPE``.
        passed: The records since the tick shown before, that one not among them.
        reference: The largest force on the tool in the run, in N, or ``LEAST_REFERENCE``.

    Raises:
        RecordingError: It is no recording, or cannot be simulated again here.
    """

    def __init__(self, path: str | Path) -> None:
        self.recording: RecordingFile = open_recording(path)
        reason = obstacle(self.recording)
        if not self.recording.count:
            reason = "it holds no tick"
        if reason:
            raise RecordingError(f"'{path}' cannot be drawn: {reason}")
        self.parameters: RunParameters = parameters_of(self.recording.meta)
        self._run = Rerun(self.recording, self.parameters)
        self.model = self._run.model
        self.data = mujoco.MjData(self.model)
        self._rest = self.recording.blocks()
        self._block = next(self._rest)
        self._at = 0  # in the block
        self.row = self.passed = self._block[:1]
        forces = (block["wrench_on_tool"][:, :3] for block in self.recording.blocks())
        largest = (float(np.linalg.norm(force, axis=1).max()) for force in forces)
        self.reference = max(LEAST_REFERENCE, *largest)
        self._line = Timeline(self.recording.blocks(), self.parameters.period)
        self._scale_contact_forces()

    @property
    def duration(self) -> float:
        """Of the run in s of its clock, missed deadlines among it."""
        return self._line.duration

    @property
    def slack(self) -> float:
        """What the environment may have created by the tick shown, in J."""
        return self._run.slack

    def tick_at(self, time: float) -> int:
        """Returns the tick that is shown at a time in s from the start: the one due nearest to it.

        Raises:
            RecordingError: The run does not last so long.
        """
        if not 0 <= time <= self.duration:
            raise RecordingError(
                f"there is nothing at {time!r} s; the recording lasts from 0 to {self.duration:g} s"
            )
        return self._line.row_at(time)

    def show(self, tick: int) -> None:
        """Simulates up to a tick, the present one or a later one.

        Raises:
            RecordingError: The run, simulated again, is another one.
        """
        passed = []
        while self._run.done <= tick:
            if self._at == len(self._block):
                self._block, self._at = next(self._rest), 0
            end = min(len(self._block), self._at + tick + 1 - self._run.done)
            recorded = self._block[self._at : end]
            again = self._run.add(recorded)
            self._refuse_another_run(recorded, again)
            passed.append(recorded)
            self._at, self.row = end, recorded[-1:]
        self.passed = np.concatenate(passed) if passed else self.row
        mujoco.mj_copyData(self.data, self.model, self._run.data)
        # contacts stay as the tick solved them; only what is drawn is brought to its end
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        mujoco.mj_flex(self.model, self.data)
        mujoco.mj_tendon(self.model, self.data)

    def _refuse_another_run(self, recorded: NDArray[np.void], again: NDArray[np.void]) -> None:
        off = np.abs(recorded["tool_position"][: len(again)] - again["tool_position"]).max(axis=1)
        if len(again) < len(recorded) or not (off <= PLACE).all():
            tick = int(recorded["tick"][0]) + int(np.argmax(np.append(~(off <= PLACE), True)))
            raise RecordingError(
                f"'{self.recording.path}' cannot be drawn: simulated again, the tool is not where "
                f"the record of tick {tick} says; 'hapticbridge audit' tells more"
            )

    def _scale_contact_forces(self) -> None:
        longest = LONGEST_ARROW * self.model.stat.extent / self.reference
        self.model.vis.map.force = longest * self.model.stat.meanmass
        self.model.vis.scale.contactwidth *= CONTACT_SIZE
        self.model.vis.scale.contactheight *= CONTACT_SIZE

    def add_coupling(self, scene: mujoco.MjvScene) -> None:
        """Draws handle, coupling and the force in the hand into a scene made from ``data``."""
        row, size = self.row[0], 0.015 * self.model.stat.extent
        handle, tool = row["handle_position"], row["tool_position"]
        force = row["wrench_on_tool"][:3]
        strength = float(np.linalg.norm(force))
        colour = (*force_colour(strength, self.reference), 1.0)
        _add(scene, mujoco.mjtGeom.mjGEOM_SPHERE, _GHOST, position=handle, size=size)
        if np.linalg.norm(handle - tool) > 0:
            capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
            _add(scene, capsule, colour, between=(tool, handle), size=0.3 * size)
        if strength > 0:
            tip = handle - force * (LONGEST_ARROW * self.model.stat.extent / self.reference)
            arrow = mujoco.mjtGeom.mjGEOM_ARROW
            _add(scene, arrow, _HAND, between=(handle, tip), size=0.5 * size)


def _add(
    scene: mujoco.MjvScene,
    kind: mujoco.mjtGeom,
    colour: ArrayLike,
    *,
    size: float,
    position: ArrayLike = (0.0, 0.0, 0.0),
    between: tuple[ArrayLike, ArrayLike] | None = None,
) -> None:
    if scene.ngeom >= scene.maxgeom:
        return
    geom = scene.geoms[scene.ngeom]
    mujoco.mjv_initGeom(
        geom,
        kind,
        np.full(3, size),
        np.asarray(position, dtype=np.float64),
        np.eye(3).ravel(),
        np.asarray(colour, dtype=np.float32),
    )
    if between is not None:
        start, end = (np.asarray(point, dtype=np.float64) for point in between)
        mujoco.mjv_connector(geom, kind, size, start, end)
    geom.category = mujoco.mjtCatBit.mjCAT_DECOR
    scene.ngeom += 1

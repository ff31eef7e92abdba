"""Recorded run simulated again and drawn: stage, camera, frames of a film."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from hapticbridge.audit.events import AuditedRun
from hapticbridge.audit.replay import Resimulator, obstacle
from hapticbridge.device import DeviceInfo
from hapticbridge.errors import HapticBridgeError, RecordingError
from hapticbridge.files import limit_words
from hapticbridge.kernel.codes import held_body
from hapticbridge.kernel.parameters import ROUNDING, RunParameters
from hapticbridge.kernel.record import Timeline, force_on_hand
from hapticbridge.recording import RecordingFile
from hapticbridge.recording.reader import open_hands
from hapticbridge.recording.ring import MAX_CONTACTS
from hapticbridge.replay.blow import NewestBlow, newest_blow
from hapticbridge.scene.checks import coupled_sensors, early_sensors

PLACE = 1e-4
"""Largest distance in m between the tool, simulated again, and its record. It is less than a pixel.
Beyond it the picture would show another run, and is refused."""

MAX_ARROW = 0.8
"""Length of the arrow of the largest force, as a share of the scene's extent. A longer one leaves
the picture."""

MIN_REFERENCE = 0.1
"""Force in N at which the arrow has its full length in a run with smaller forces. Such forces are
drawn small."""

SHADOW = 2048
"""Largest side of the shadow map in pixels. On two busy cores without a graphics card, MuJoCo's
4096 made 5.5 frames of 800 x 600 a second and this makes 8.5; less makes shadows' edges coarser."""

TOOL_ALPHA = 0.5
"""Opacity of moving bodies, 0 to 1. Grip, handle and spring are inside the tool and must be seen
through it; below 0.4 the tool itself is hard to see."""

FREE = -1
"""MuJoCo's number of the free camera, as the scene's file sets it."""

QUALITY = 15
"""Constant rate factor of H.264, 0 (best) to 51. At 15 the coupling's thin lines stay sharp."""

Frame = NDArray[np.uint8]

_PALE, _RED = np.array([0.75, 0.87, 0.98]), np.array([0.70, 0.15, 0.12])
# pale to dark as well, for colour-blind readers
_GHOST = (0.1, 0.37, 0.71, 0.45)
_HAND = (0.90, 0.38, 0.0, 1.0)
_CONTACT = (0.30, 0.82, 0.88, 1.0)
_BLOW = (0.98, 0.80, 0.10, 0.8)


# Forces and their owners: on the hand, on the tool, in contacts


def is_held(meta: Mapping[str, str]) -> bool:
    """Returns True if a hand feels the force of the run's device."""
    return not DeviceInfo.from_json(meta.get("device", "")).is_prescribed


def peak_forces(rows: NDArray[np.void], axes: ArrayLike) -> tuple[float, float]:
    """Returns the largest force on the hand and on the tool in some records, in N."""
    hand, tool = force_on_hand(rows, axes), rows["wrench_on_tool"][:, :3]
    return float(np.linalg.norm(hand, axis=1).max()), float(np.linalg.norm(tool, axis=1).max())


def contacts_of(
    model: mujoco.MjModel, data: mujoco.MjData, parameters: RunParameters, *, of_tool: bool = False
) -> NDArray[np.float64]:
    """Returns position in m and force in N of contacts in the world frame, (n, 2, 3).

    Contacts without a force are left out: MuJoCo also lists pairs within their geoms' gap. A tool
    without mass has none, because MuJoCo solves for no force there. ``of_tool`` leaves out those
    that the tool, rigid with the grip, has no part in.
    """
    contacts: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []
    wrench, tool = np.zeros(6), model.body_weldid[held_body(model, parameters.grip)]
    for index in range(data.ncon if parameters.properties.has_tool_mass else 0):
        if of_tool and tool not in model.body_weldid[model.geom_bodyid[data.contact.geom[index]]]:
            continue
        mujoco.mj_contactForce(model, data, index, wrench)
        if wrench[:3].any() and len(contacts) < MAX_CONTACTS:
            frame = data.contact.frame[index].reshape(3, 3)
            contacts.append((data.contact.pos[index].copy(), frame.T @ wrench[:3]))
    return np.array(contacts, dtype=np.float64).reshape(len(contacts), 2, 3)


def place_of_blow(contacts: NDArray[np.float64], row: NDArray[np.void]) -> NDArray[np.float64]:
    """Returns the position in m of the contact with the largest force, (3,).

    Args:
        contacts: Position in m and force in N of each contact, (n, 2, 3).
        row: Record of the tick; without a contact it gives the position of the grip.
    """
    if not len(contacts):
        return np.array(row["tool_position"], dtype=np.float64)
    return np.asarray(contacts[np.linalg.norm(contacts[:, 1], axis=1).argmax(), 0])


def force_colour(force: float, reference: float) -> NDArray[np.float64]:
    """Returns the colour of a spring that pulls: pale blue at rest, red from a reference force on.

    Args:
        force: Magnitude of its force in N.
        reference: Reference force in N, > 0.

    Returns:
        Red, green and blue from 0 to 1, (3,).
    """
    share = min(abs(force) / reference, 1.0)
    return np.asarray((1.0 - share) * _PALE + share * _RED)


class Stage:
    """Recorded run that is simulated again tick by tick, forwards.

    Args:
        path: The recording, or the file that was opened.
        on_compiled: Called after the scene was compiled, before it is simulated.

    Attributes:
        recording: The recording without its ticks.
        parameters: Parameters of the run.
        model: The scene.
        data: State at the tick last shown, with contacts as they were solved.
        row: Record of that tick, one element of ``TICK_DTYPE``; of several hands, the first's.
        rows: Records of that tick, one per hand.
        passed: Records after the tick shown before and before this one.
        blow: Newest blow of the tool up to that tick; None before the first.
        hand_force: Force of the device on the hand at that tick, (3,) in N in the scene's frame;
            zero for a prescribed motion, which no hand feels.
        hand_reference: Largest force on the hand in the run, in N, or ``MIN_REFERENCE``.
        tool_reference: Largest force on the tool in the run, in N, or ``MIN_REFERENCE``.

    Raises:
        RecordingError: The file is no recording, or cannot be simulated again here.
    """

    def __init__(
        self, path: str | Path | RecordingFile, on_compiled: Callable[[], object] | None = None
    ) -> None:
        hands: tuple[RecordingFile, ...]
        if isinstance(path, RecordingFile):
            hands = open_hands(path.path) if path.has_several_hands else (path,)
        else:
            hands = open_hands(path)
        opened = hands[0]
        self.recording: RecordingFile = opened
        reason = obstacle(self.recording)
        if not self.recording.count:
            reason = "it is empty: it holds no tick"
        if reason:
            raise RecordingError(f"'{opened.path}' cannot be drawn: {reason}")
        self._hands = tuple(AuditedRun.of(each).parameters for each in hands)
        self.parameters: RunParameters = self._hands[0]
        others = list(zip(hands[1:], self._hands[1:], strict=True))
        self._run = Resimulator(self.recording, self.parameters, others=others)
        if on_compiled is not None:
            on_compiled()
        self.model = self._run.model
        _light(self.model)
        tell_apart(self.model, *(own.grip for own in self._hands))
        self.data = mujoco.MjData(self.model)
        self._rest = _blocks_of(hands)
        self._block = next(self._rest)
        self._at = 0  # index within the block
        self.rows = self._block[0]
        self.row = self.passed = self._block[:1, 0]
        self.blow: NewestBlow | None = None
        self._is_held = [is_held(each.meta) for each in hands]
        hand, tool = zip(
            *(
                peak_forces(block, own.axes)
                for each, own in zip(hands, self._hands, strict=True)
                if not own.is_joint
                for block in each.blocks()
            ),
            strict=True,
        )
        self.hand_reference = max(MIN_REFERENCE, *hand)
        self.tool_reference = max(MIN_REFERENCE, *tool)
        self._line = Timeline(self.recording.blocks(), self.parameters.period)

    @property
    def duration(self) -> float:
        """Duration of the run in s of its clock, missed deadlines included."""
        return self._line.duration

    @property
    def slack(self) -> float:
        """Energy in J that the environment may have created up to the tick shown."""
        return self._run.slack

    def tick_at(self, time: float) -> int:
        """Returns the tick whose due time is nearest to a time in s from the start.

        Raises:
            RecordingError: The run is shorter.
        """
        if not 0 <= time <= self.duration:
            raise RecordingError(
                f"there is nothing at {time!r} s; the recording lasts from 0 to {self.duration:g} s"
            )
        return self._line.row_at(time)

    def show(self, tick: int) -> None:
        """Simulates up to a tick, the present one or a later one.

        Raises:
            RecordingError: The tool, simulated again, is not at its recorded place.
        """
        passed = []
        while self._run.done <= tick:
            if self._at == len(self._block):
                self._block, self._at = next(self._rest), 0
            end = min(len(self._block), self._at + tick + 1 - self._run.done)
            recorded = self._block[self._at : end]
            # the scene is at a blow's contact in the tick of the blow alone
            end = self._at + _first(recorded[:, 0]["blow_energy"] > 0.0)
            recorded = recorded[: end - self._at]
            again = self._run.add(recorded if self.recording.has_several_hands else recorded[:, 0])
            self._refuse_another_run(recorded, again.reshape(-1, len(self._hands)))
            passed.append(recorded[:, 0])
            contacts = contacts_of(self.model, self._run.data, self.parameters, of_tool=True)
            place = place_of_blow(contacts, recorded[-1, 0])
            self.blow = newest_blow(self.blow, recorded[:, 0], place)
            self._at, self.rows, self.row = end, recorded[-1], recorded[-1:, 0]
        self.passed = np.concatenate(passed) if passed else self.row
        mujoco.mj_copyData(self.data, self.model, self._run.data)
        # contacts stay as the tick solved them; only the drawn quantities are brought to its end
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        mujoco.mj_flex(self.model, self.data)
        mujoco.mj_tendon(self.model, self.data)

    def _refuse_another_run(self, recorded: NDArray[np.void], again: NDArray[np.void]) -> None:
        off = np.abs(recorded["tool_position"][: len(again)] - again["tool_position"])
        off = off.reshape(len(again), -1).max(axis=1)
        if len(again) < len(recorded) or not (off <= PLACE).all():
            tick = int(recorded["tick"][0, 0]) + int(np.argmax(np.append(~(off <= PLACE), True)))
            raise RecordingError(
                f"'{self.recording.path}' cannot be drawn: simulated again, the tool is not where "
                f"the record of tick {tick} says; 'hapticbridge audit' tells more"
            )

    @property
    def hand_force(self) -> NDArray[np.float64]:
        """Force of the device on the hand at the tick shown."""
        return self._force_on(0)

    def _force_on(self, hand: int) -> NDArray[np.float64]:
        force = force_on_hand(self.rows[hand : hand + 1], self._hands[hand].axes)[0]
        return np.asarray(force * self._is_held[hand])

    @property
    def grips(self) -> tuple[str, ...]:
        """Grips of the hands; a joint has no place in the scene."""
        return tuple(own.grip for own in self._hands if not own.is_joint)

    def odd_readings(self) -> dict[str, list[str]]:
        """Returns the names of the sensors' numbers that are not what the file alone would give.

        Those of ``coupled`` include the coupling's pull, those of ``early`` contacts seen ahead.
        """
        names, model = sensor_names(self.model), self.model
        odd = {
            "coupled": coupled_sensors(model, *(own.grip for own in self._hands)),
            "early": early_sensors(model),
        }
        return {
            why: [
                names[int(model.sensor_adr[sensor]) + k]
                for sensor in sensors
                for k in range(int(model.sensor_dim[sensor]))
            ]
            for why, sensors in odd.items()
        }

    def hands(self) -> Iterator[tuple[NDArray[np.void], NDArray[np.float64]]]:
        """Yields the record (1,) of each hand at a grip, and the force on it in N, (3,)."""
        for hand, own in enumerate(self._hands):
            if not own.is_joint:
                yield self.rows[hand : hand + 1], self._force_on(hand)

    def contacts(self) -> NDArray[np.float64]:
        """Returns the contacts of the tick shown that carry a force; see ``contacts_of``."""
        return contacts_of(self.model, self.data, self.parameters)

    def add_contacts(self, scene: mujoco.MjvScene) -> None:
        """Draws the contacts that carry a force into a scene made from ``data``."""
        size, extent = 0.006 * self.model.stat.extent, self.model.stat.extent
        contacts = self.contacts()
        strongest = np.linalg.norm(contacts[:, 1], axis=1).max(initial=self.tool_reference)
        for place, force in contacts:
            _add(scene, mujoco.mjtGeom.mjGEOM_SPHERE, _CONTACT, position=place, size=size)
            tip = place + force * (MAX_ARROW * extent / strongest)
            _add(scene, mujoco.mjtGeom.mjGEOM_ARROW, _CONTACT, between=(place, tip), size=size)

    def add_blow(self, scene: mujoco.MjvScene) -> None:
        """Draws the place of the newest blow, with its energy and pulse, for ``SHOWN``."""
        if self.blow is None or not self.blow.is_marked(1e-9 * float(self.row["deadline_ns"][0])):
            return
        size = 0.02 * self.model.stat.extent
        sphere = mujoco.mjtGeom.mjGEOM_SPHERE
        mark = _add(scene, sphere, _BLOW, position=self.blow.place, size=size)
        if mark is not None:  # MuJoCo's letters are those of ASCII
            mark.label = self.blow.words.replace("µ", "u")

    def add_coupling(self, scene: mujoco.MjvScene) -> None:
        """Draws handle, coupling and the force on each hand into a scene made from ``data``.

        A joint that is held has no handle in the scene.
        """
        for hand, own in enumerate(self._hands):
            if not own.is_joint:
                self._add_coupling_of(hand, scene)

    def _add_coupling_of(self, hand: int, scene: mujoco.MjvScene) -> None:
        row, size = self.rows[hand], 0.015 * self.model.stat.extent
        handle, tool, force = row["handle_position"], row["tool_position"], self._force_on(hand)
        pull = float(np.linalg.norm(row["wrench_on_tool"][:3]))
        colour = (*force_colour(pull, self.tool_reference), 1.0)
        _add(scene, mujoco.mjtGeom.mjGEOM_SPHERE, _GHOST, position=handle, size=size)
        if np.linalg.norm(handle - tool) > 0:
            capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
            _add(scene, capsule, colour, between=(tool, handle), size=0.3 * size)
        if force.any():
            tip = handle + force * (MAX_ARROW * self.model.stat.extent / self.hand_reference)
            arrow = mujoco.mjtGeom.mjGEOM_ARROW
            _add(scene, arrow, _HAND, between=(handle, tip), size=0.5 * size)


def _first(is_true: NDArray[np.bool_]) -> int:
    """Returns the length up to and with the first true one; the whole length if there is none."""
    return int(is_true.argmax()) + 1 if is_true.any() else len(is_true)


HEADLIGHT_AMBIENT, HEADLIGHT_DIFFUSE = 0.4, 0.6
"""Light from the camera on a scene without lights, 0 to 1 in each colour. MuJoCo's own, 0.1 and
0.4, is meant to be added to lights, and leaves such a scene dark."""


def _blocks_of(hands: Sequence[RecordingFile]) -> Iterator[NDArray[np.void]]:
    """Yields the records of all hands in blocks, (n, hands)."""
    for blocks in zip(*(hand.blocks() for hand in hands), strict=True):
        yield np.stack(blocks, axis=1)


def _light(model: mujoco.MjModel) -> None:
    """Lights a scene that has no light of its own and no setting of the headlight."""
    headlight = model.vis.headlight
    is_usual = np.allclose(headlight.ambient, 0.1) and np.allclose(headlight.diffuse, 0.4)
    if not model.nlight and is_usual:
        headlight.ambient[:] = HEADLIGHT_AMBIENT
        headlight.diffuse[:] = HEADLIGHT_DIFFUSE


COLOURLESS = 0.5, 0.5, 0.5, 1.0
"""MuJoCo's colour of a geom that the scene gives none: red, green, blue and opacity, 0 to 1."""

TOOL_COLOUR, MOVING_COLOUR, FIXED_COLOUR = (0.8, 0.5, 0.25), (0.5, 0.65, 0.55), (0.6, 0.62, 0.65)
"""Colours of colourless geoms on the tool, on other moving bodies and on fixed ones, 0 to 1.
Without them, tool and floor are grey on grey."""


def sensor_names(model: mujoco.MjModel) -> list[str]:
    """Returns a name of each number that a scene's sensors give, all different.

    None has a slash, which separates groups in HDF5.
    """
    names: list[str] = []
    for sensor, size in enumerate(model.sensor_dim.tolist()):
        name = (model.sensor(sensor).name or str(sensor)).replace("/", "_")
        for number in [f"{name}_{k}" for k in range(size)] if size > 1 else [name]:
            count = sum(each.partition("~")[0] == number for each in names)
            names.append(f"{number}~{count}" if count else number)
    return names


def tell_apart(model: mujoco.MjModel, *grips: str) -> None:
    """Colours the geoms to which the scene gives neither colour nor material.

    ``grips`` are the names of what the hands hold. Only the drawing depends on the colours.
    """
    tools = [int(model.body_weldid[held_body(model, grip)]) for grip in grips]
    for geom in range(model.ngeom):
        if model.geom_matid[geom] >= 0 or not np.allclose(model.geom_rgba[geom], COLOURLESS):
            continue
        body = int(model.body_weldid[model.geom_bodyid[geom]])
        moving = MOVING_COLOUR if body else FIXED_COLOUR
        model.geom_rgba[geom, :3] = TOOL_COLOUR if body in tools else moving


GLOW = 0.6
"""Share of its own colour that handle, coupling, force and contacts have in the dark, 0 to 1."""


def _add(
    scene: mujoco.MjvScene,
    kind: mujoco.mjtGeom,
    colour: ArrayLike,
    *,
    size: float,
    position: ArrayLike = (0.0, 0.0, 0.0),
    between: tuple[ArrayLike, ArrayLike] | None = None,
) -> mujoco.MjvGeom | None:
    """Draws a shape; returns None if the scene is full."""
    if scene.ngeom >= scene.maxgeom:
        return None
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
    geom.emission = GLOW
    scene.ngeom += 1
    return geom


class Camera:
    """MuJoCo's free camera on a stage, as the scene's file sets it, or a camera of the scene.

    Args:
        stage: The run.
        size: Width and height of a frame in pixels.
        name: A camera of the scene; None for the free one.
        has_forces: True draws handle, coupling, forces and contacts, and bodies that show them.

    Raises:
        RecordingError: The scene has no camera of that name.
    """

    def __init__(
        self,
        stage: Stage,
        size: tuple[int, int],
        name: str | None = None,
        *,
        has_forces: bool = True,
    ) -> None:
        self._stage, self._has_forces = stage, has_forces
        width, height = size
        model = stage.model
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        self._camera = FREE if name is None else _camera_id(stage, name)
        self._shown = mujoco.MjvOption()
        shadows = model.vis.quality
        shadows.shadowsize = min(shadows.shadowsize, SHADOW)
        # grip and handle are points in the model, without a shape to see
        self._shown.sitegroup[:] = 0
        if has_forces:
            model.vis.map.alpha = TOOL_ALPHA
            self._shown.flags[mujoco.mjtVisFlag.mjVIS_TRANSPARENT] = True
        self.renderer = mujoco.Renderer(model, height, width)

    def frame(self, tick: int) -> Frame:
        """Returns the picture of a tick, (height, width, 3)."""
        self._stage.show(tick)
        self.renderer.update_scene(self._stage.data, self._camera, self._shown)
        if self._has_forces:
            self._stage.add_contacts(self.renderer.scene)
            self._stage.add_blow(self.renderer.scene)
            self._stage.add_coupling(self.renderer.scene)
        return np.array(self.renderer.render(), dtype=np.uint8)


def _camera_id(stage: Stage, name: str) -> int:
    model = stage.model
    names = [model.camera(index).name for index in range(model.ncam)]
    if name not in names:
        there = f"cameras: {', '.join(map(repr, filter(None, names)))}" if any(names) else "none"
        raise RecordingError(
            f"the scene of '{stage.recording.path}' has no camera '{name}'; it has {there}"
        )
    return names.index(name)


def film_ticks(
    stage: Stage, rate: float, start: float = 0.0, stop: float | None = None, speed: float = 1.0
) -> Iterator[int]:
    """Yields the tick of each frame of a film.

    Args:
        stage: The run.
        rate: Frames per second.
        start: Time in the run at which the film begins, in s.
        stop: Time in the run at which the film ends, in s; None for the end of the run.
        speed: Speed of the film relative to the run, without unit.

    Raises:
        RecordingError: The run is shorter.
    """
    end = stage.duration if stop is None else stop
    stage.tick_at(end), stage.tick_at(start)  # refuse before the first frame
    count = math.ceil((end - start) / speed * rate - ROUNDING)  # all that begin before the end
    for frame in range(max(1, count)):
        yield stage.tick_at(start + frame * speed / rate)


def write_film(path: str, frames: Iterator[Frame], size: tuple[int, int], fps: int) -> None:
    """Writes frames as a film (H.264).

    Args:
        path: File to write; it ends in ``.mp4``.
        frames: Pictures, (height, width, 3) each.
        size: Width and height in pixels, both even.
        fps: Frames per second.

    Raises:
        HapticBridgeError: ffmpeg does not start, or did not write all frames.
    """
    import imageio_ffmpeg  # noqa: PLC0415 - of the extra 'view', which a picture does not need

    options = ["-crf", str(QUALITY), "-movflags", "+faststart"]
    film = imageio_ffmpeg.write_frames(
        path,
        size,
        fps=fps,
        quality=None,
        codec="libx264",
        macro_block_size=2,
        output_params=options,
    )
    count = 0
    try:
        film.send(None)
        for frame in frames:
            film.send(frame.tobytes())
            count += 1
        film.close()
        written, _ = imageio_ffmpeg.count_frames_and_secs(path)
    except (OSError, RuntimeError) as error:
        reason = _refusal(path) or _first_line(error)
        raise HapticBridgeError(f"ffmpeg cannot write the film: {reason}") from None
    if written != count:
        reason = _refusal(path) or "ffmpeg gave no reason"
        raise HapticBridgeError(f"ffmpeg wrote {written} of {count} frames: {reason}")


COLOURS = 64
"""Colours of a frame in a ``.gif``. More of them make larger files, fewer show steps in shades."""


def write_animation(path: Path, frames: Iterator[Frame], fps: int) -> str:
    """Writes frames as an animated picture that begins anew at its end (GIF).

    Args:
        path: File to write.
        frames: Pictures, (height, width, 3) each, at least one.
        fps: Frames per second; each is shown for a whole number of hundredths of a second.

    Returns:
        Why it cannot be written, or an empty text.
    """
    pictures = (
        Image.fromarray(frame).quantize(COLOURS, dither=Image.Dither.NONE) for frame in frames
    )
    time = 10 * max(round(100 / fps), 2)  # in ms; browsers slow down what is shorter
    try:
        next(pictures).save(path, save_all=True, append_images=pictures, duration=time, loop=0)
    except OSError as error:
        return error.strerror or str(error)
    return ""


_FILM_BUFFER = 1 << 18
"""Bytes that ffmpeg holds back at most before it writes them to a film."""


def _refusal(path: str) -> str:
    """Returns why a file cannot grow, as on a full disk; empty if it can.

    ffmpeg's own words do not tell it.
    """
    try:
        with Path(path).open("ab") as film:
            film.write(bytes(_FILM_BUFFER))
    except OSError as error:
        return limit_words(error.errno) or error.strerror or str(error)
    return ""


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0].rstrip(":")

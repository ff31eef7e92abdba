"""Controls of a run on its page: sliders, switches, buttons, and the answers to them.

The page only sends requests. The bridge decides, whatever a browser sends. The bounds drawn here
are those of the bridge, so a slider ends where a refusal would begin.
"""

from __future__ import annotations

import contextlib
import math
import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import Any

import mujoco
import numpy as np
import viser

from hapticbridge.coupling import SYMBOLS, UNITS, Coupling
from hapticbridge.demand.methods import RunCoupling
from hapticbridge.device.mouse import REST, Drag, Pose, line_of_drag
from hapticbridge.errors import CommandError
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.run.commands import (
    INTERVAL,
    AxisCouplingLimits,
    Command,
    Couple,
    CouplingLimits,
    Mark,
    Reset,
    Stop,
    Switch,
    line_of,
)
from hapticbridge.run.request import setups_of
from hapticbridge.view.page import quoted
from hapticbridge.view.window import HAND_INTERVAL

PACE = 2.0 * INTERVAL
"""Smallest time in s between two commands to the bridge. At the bridge's own limit a delayed
command and the next one would come too close, and be refused."""

STILL = 0.5
"""Time in s after the last touch during which no slider is moved by the program. A hand may hold
it."""

FINENESS = 1e-3
"""Smallest step of a slider as a share of its largest value, rounded down to a power of ten. A
finer step cannot be felt, a coarser one can."""

_ROUNDING = 1.0 + 1e-9  # restores 2 from a bound that was computed as 1.9999999999

_WORDS = {
    "translation": ("stiffness", "damping"),
    "rotation": ("turning stiffness", "turning damping"),
}


def allowance_of(metadata: Mapping[str, str]) -> CouplingLimits:
    """Returns the coupling limits of a run's first device, from the run's metadata."""
    return setups_of(metadata)[0].coupling_limits


class Outlet:
    """Sends the page's commands and its hand to the bridge at a limited rate.

    Of each kind of command, and of the hand's poses, only the newest is sent.

    Args:
        file: Descriptor of the pipe to the bridge.
    """

    def __init__(self, file: int) -> None:
        self._file = file
        self._waiting: dict[str, Command] = {}
        self._drag: Drag | None = None
        self._has_news = threading.Condition()

    def drag(self, drag: Drag) -> None:
        """Queues the hand's pose and buttons; never waits for the bridge."""
        with self._has_news:
            self._drag = drag
            self._has_news.notify()

    def ask(self, command: Command) -> None:
        """Queues a command; never waits for the bridge."""
        with self._has_news:
            kind = type(command).__name__
            before = self._waiting.pop(kind, None)
            if isinstance(command, Switch) and isinstance(before, Switch):
                force = before.force if command.force is None else command.force
                clutch = before.clutch if command.clutch is None else command.clutch
                command = Switch(force, clutch)
            self._waiting[kind] = command
            self._has_news.notify()

    def run(self) -> None:
        """Sends commands until the bridge has closed the pipe."""
        with contextlib.suppress(OSError):
            while True:
                with self._has_news:
                    self._has_news.wait_for(lambda: self._waiting or self._drag)
                    line, pace = self._next()
                os.write(self._file, line)
                time.sleep(pace)

    def _next(self) -> tuple[bytes, float]:
        """Returns the next line and the pause after it; a stop first, the hand last."""
        if self._waiting:
            kind = "Stop" if "Stop" in self._waiting else next(iter(self._waiting))
            return line_of(self._waiting.pop(kind)), PACE
        drag, self._drag = self._drag or Drag(REST), None
        return line_of_drag(drag), HAND_INTERVAL


class Sliders:
    """Sliders of stiffness and damping along one kind of axis.

    Args:
        gui: Page to add the sliders to.
        span: Coupling limits of the device.
        want: Called after a user has moved a slider.

    Attributes:
        span: Coupling limits of the device.
    """

    def __init__(
        self, gui: viser.GuiApi, span: AxisCouplingLimits, want: Callable[[], None]
    ) -> None:
        self.span = span
        stiffness, damping = span.run.start.gains(span.axis)
        self._steps = (
            _step(max(span.max_stiffness(0.0), stiffness)),
            _step(max(span.max_damping(span.min_stiffness), damping)),
        )
        least = _up(span.min_stiffness, self._steps[0])
        most = self._ends(stiffness, damping, least)
        labels = [
            f"{word} {symbol} ({unit})"
            for word, symbol, unit in zip(
                _WORDS[span.axis], SYMBOLS[span.axis], UNITS[span.axis], strict=True
            )
        ]
        steps, k = self._steps, _between(stiffness, self._steps[0], least, most[0])
        self._stiffness = gui.add_slider(labels[0], least, most[0], steps[0], k)
        b = _between(damping, steps[1], 0.0, most[1])
        self._damping = gui.add_slider(labels[1], 0.0, most[1], steps[1], b)
        self._stiffness.on_update(by_hand(want))
        self._damping.on_update(by_hand(want))

    @property
    def value(self) -> tuple[float, float]:
        """Values of the sliders, clipped to their ranges because a browser may send any number."""
        return self._stiffness.value, self._damping.value

    def show(self, stiffness: float, damping: float) -> None:
        """Sets both sliders to a stiffness and damping."""
        self.bound(stiffness, damping)
        sliders = self._stiffness, self._damping
        for slider, value, step in zip(sliders, (stiffness, damping), self._steps, strict=True):
            slider.value = _between(value, step, slider.min, slider.max)

    def bound(self, stiffness: float, damping: float) -> None:
        """Sets the end of each slider to the limit at the other one's value."""
        self._stiffness.max, self._damping.max = self._ends(stiffness, damping, self._stiffness.min)

    def ends(self) -> str:
        """Writes the ends of the sliders beside them."""
        symbols, units = SYMBOLS[self.span.axis], UNITS[self.span.axis]
        return (
            f"{symbols[0]} ends at {self._stiffness.max:g} {units[0]}, "
            f"{symbols[1]} at {self._damping.max:g} {units[1]}"
        )

    def _ends(self, stiffness: float, damping: float, least: float) -> tuple[float, float]:
        steps, span = self._steps, self.span
        return (
            max(_down(span.max_stiffness(damping), steps[0]), least + steps[0]),
            max(_down(span.max_damping(stiffness), steps[1]), steps[1]),
        )


class Controls:
    """Controls of one run on the page.

    Args:
        server: Server of the page.
        allowance: Coupling limits of the device.
        ask: Forwards a command.
        has_several_hands: True for a run of several hands, which the page can only stop.

    Attributes:
        answer: Text element with the bridge's answer to the last request.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        allowance: CouplingLimits,
        ask: Callable[[Command], None],
        *,
        has_several_hands: bool = False,
    ) -> None:
        self._allowance, self._ask = allowance, ask
        self._touched = 0.0
        # viser calls from any number of threads: an older value must not be sent last
        self._turn = threading.Lock()
        self._sliders: tuple[Sliders, ...] = ()
        self._said = {"recording": "", "force": "", "answer": ""}
        gui, is_single = server.gui, not has_several_hands
        with gui.add_folder("control"):
            stop = gui.add_button("stop the run", color="red")
            if allowance.method.has_law and is_single:
                self._sliders = tuple(Sliders(gui, s, self._want) for s in allowance.spans)
                self._bounds = gui.add_markdown(self._ends())
            self._force = gui.add_checkbox("force", initial_value=True, visible=is_single)
            self._clutch = gui.add_checkbox(
                "clutch (the hand moves alone)", initial_value=False, visible=is_single
            )
            reset = gui.add_button("back to the start", visible=is_single)
            mark = gui.add_button("mark this moment", visible=is_single)
            self.answer = gui.add_markdown("")
        # state of the run, now or after the waiting commands
        self._gains = [allowance.start.gains(sliders.span.axis) for sliders in self._sliders]
        self._is_forced, self._is_clutched = True, False
        self._force.on_update(by_hand(lambda: self._switch(force=bool(self._force.value))))
        self._clutch.on_update(by_hand(lambda: self._switch(clutch=bool(self._clutch.value))))
        reset.on_click(lambda _: ask(Reset()))
        mark.on_click(lambda _: ask(Mark()))
        stop.on_click(lambda _: ask(Stop()))

    def _ends(self) -> str:
        ends = "; ".join(sliders.ends() for sliders in self._sliders)
        return f"{ends}. {self._allowance.reason()}"

    def _want(self) -> None:
        """Requests the values of the sliders."""
        with self._turn:
            self._touched = time.monotonic()
            try:
                self._ask(Couple(*(value for sliders in self._sliders for value in sliders.value)))
            except CommandError as error:
                self._refuse(str(error))

    def _switch(self, *, force: bool | None = None, clutch: bool | None = None) -> None:
        with self._turn:
            self._ask(Switch(force, clutch))

    def note(self, event: Mapping[str, Any]) -> None:
        """Handles an event; the controls then show the state of the run, not the request."""
        kind = event.get("event")
        if kind == "coupling" and self._sliders:
            self._take_coupling(event)
        elif kind == "switch":
            self._say("force", "" if event.get("force") else "the force is off")
            if not event.get("fading"):
                self._is_forced, self._is_clutched = bool(event["force"]), bool(event["clutch"])
                self._show_switches()
        elif kind == "reset":
            self._say("answer", "the scene is back at its start")
        elif kind == "mark":
            self._say("answer", f"marked at tick {event.get('tick')}")
        elif kind == "recording":
            path = event.get("path")
            self._say("recording", f"recording to {quoted(path)}" if path else "not recording")
        elif kind == "refused":
            self._refuse(str(event.get("reason")))

    def _take_coupling(self, event: Mapping[str, Any]) -> None:
        method, allowance = self._allowance.method, self._allowance
        law = {field.name: float(event[field.name]) for field in fields(Coupling)}
        requested = allowance.loop.requested(Coupling(**law))
        self._gains = [requested.gains(sliders.span.axis) for sliders in self._sliders]
        is_still = time.monotonic() - self._touched > STILL
        for sliders, pair in zip(self._sliders, self._gains, strict=True):
            (sliders.show if is_still else sliders.bound)(*pair)
        self._bounds.content = self._ends()
        sentences = RunCoupling.of(method, allowance.loop.h, law=Coupling(**law)).sentences()
        self._say("answer", f"goes to {'; '.join(sentences[: len(self._sliders)])}")

    def _refuse(self, reason: str) -> None:
        """Shows the reason of a refusal, and sets the controls back to the state of the run."""
        self._say("answer", f"**refused:** {quoted(reason)}")
        self._touched = -math.inf
        self._show_switches()
        if self._sliders:
            for sliders, pair in zip(self._sliders, self._gains, strict=True):
                sliders.show(*pair)
            self._bounds.content = self._ends()

    def _say(self, what: str, words: str) -> None:
        """Shows a message; the other controls stay unchanged."""
        self._said[what] = words
        self.answer.content = "  \n".join(words for words in self._said.values() if words)

    def _show_switches(self) -> None:
        self._force.value, self._clutch.value = self._is_forced, self._is_clutched


# Hand on the page, for the device ``mouse``

SIZE = 0.35
"""Size of the hand's arrows as a share of the scene's extent: beside the tool, within the
picture."""


def device_pose(
    parameters: RunParameters, position: Sequence[float], quaternion: Sequence[float]
) -> Pose:
    """Returns the pose of the device that puts the handle at a pose in the scene.

        p = p_0 + Aᵀ (h − h_0) / scale,    R = Aᵀ (R_h R_h0ᵀ) A R_0

    the inverse of ``kernel.handle.handle_pose``.

    Raises:
        ValueError: The pose is not finite, or not three and four numbers.
    """
    handle = np.asarray(position, dtype=np.float64)
    turned = np.asarray(quaternion, dtype=np.float64)
    if handle.shape != (3,) or turned.shape != (4,) or not np.isfinite([*handle, *turned]).all():
        raise ValueError("a pose is three and four finite numbers")
    axes = np.reshape(parameters.axes, (3, 3))
    start, origin = np.array(parameters.handle_origin), np.array(parameters.device_origin)
    moved = axes.T @ (handle - start[:3]) / parameters.scale + origin[:3]
    size = float(np.linalg.norm(turned))
    # by MuJoCo: the compiled functions of kernel.pose would be loaded within the first drag
    back, turn, device = np.zeros((3, 4))
    mujoco.mju_negQuat(back, start[3:])
    mujoco.mju_mulQuat(turn, turned / size, back)
    turn[1:] = axes.T @ turn[1:]  # Aᵀ R A turns as far, about the axis Aᵀ n
    mujoco.mju_mulQuat(device, turn, origin[3:])
    x, y, z, w, a, b, c = map(float, (*moved, *device))
    return x, y, z, w, a, b, c


def add_hand(
    server: viser.ViserServer,
    parameters: RunParameters,
    extent: float,
    drag: Callable[[Drag], None],
) -> None:
    """Adds arrows and rings at the handle's start, and buttons; ``drag`` is called by each."""
    start = parameters.handle_origin
    hand = server.scene.add_transform_controls(
        "/hand", scale=SIZE * extent, depth_test=False, position=start[:3], wxyz=start[3:]
    )
    server.gui.add_markdown("drag the arrows at the tool: the hand follows, and feels nothing")

    boxes = [server.gui.add_checkbox(f"hold button {k}", initial_value=False) for k in range(2)]

    def tell() -> None:
        # a browser may send anything
        with contextlib.suppress(ValueError, TypeError):
            pose = device_pose(parameters, hand.position.tolist(), hand.wxyz.tolist())
            drag(Drag(pose, sum(bool(box.value) << k for k, box in enumerate(boxes))))

    async def dragged(_: viser.TransformControlsEvent) -> None:  # in order, unlike threads
        tell()

    hand.on_update(dragged)
    for box in boxes:
        box.on_update(by_hand(tell))


def by_hand(act: Callable[[], None]) -> Callable[[viser.GuiEvent[Any]], None]:
    """Returns a callback for changes by a browser, and not by this process.

    viser reports both. A change of the run's state by other means would otherwise return to the run
    as a request.
    """

    def acts(event: viser.GuiEvent[Any]) -> None:
        if event.client_id is not None:
            act()

    return acts


def _step(most: float) -> float:
    return float(f"1e{math.floor(math.log10(FINENESS * most)):d}")


def _between(value: float, step: float, least: float, most: float) -> float:
    """Returns the slider's position next to a value."""
    return min(max(float(f"{round(value / step) * step:.12g}"), least), most)


def _up(value: float, step: float) -> float:
    return float(f"{math.ceil(value / step / _ROUNDING) * step:.12g}")


def _down(value: float, step: float) -> float:
    return float(f"{math.floor(value * _ROUNDING / step) * step:.12g}")

"""What can be asked of a run from its page: sliders, switches and buttons, and the answers.

The page only asks. What is allowed is decided by the bridge, whatever a browser sends; the bounds
drawn here are the same ones, so that a slider ends where a refusal would begin.
"""

from __future__ import annotations

import contextlib
import json
import os
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import viser

from hapticbridge.commands import Allowance, Command, Couple, Record, Reset, Switch
from hapticbridge.commands.command import Stop, line_of
from hapticbridge.commands.queue import INTERVAL
from hapticbridge.device import DeviceInfo
from hapticbridge.errors import CommandError
from hapticbridge.guard import Limits
from hapticbridge.provenance import parameters_of
from hapticbridge.rendering import method_named

SHARED = "**Anyone with this address can watch this run, stop it, and move the device.**"

PACE = 2.0 * INTERVAL
"""In s, least time between two lines to the bridge. At its own limit a line that was held up and
the next one would come too close, and be refused."""

STILL = 0.5
"""In s: for so long after the last touch a slider is not put anywhere; it may be in a hand."""

_DIGITS = 1e-3  # N s/m


def allowance_of(metadata: Mapping[str, str]) -> Allowance:
    """Returns what the device of a run allows, from the run's metadata."""
    parameters, method = parameters_of(metadata), method_named(metadata["method"])
    info, guarding = DeviceInfo.from_json(metadata["device"]), parameters.guarding
    limits = Limits(
        force=parameters.force_limit,
        torque=parameters.torque_limit,
        stretch=guarding.stretch / parameters.scale,
    )
    return Allowance(
        info=info,
        method=method,
        start=method.rendered(parameters.coupling, parameters.period / parameters.substeps),
        period=parameters.period,
        scale=parameters.scale,
        force_scale=parameters.force_scale,
        substeps=parameters.substeps,
        limits=limits,
    )


class Outlet:
    """Sends the page's commands to the bridge, slowly; of each kind the newest.

    Args:
        file: Descriptor that the bridge reads.
    """

    def __init__(self, file: int) -> None:
        self._file = file
        self._waiting: dict[str, Command] = {}
        self._has_news = threading.Condition()

    def ask(self, command: Command) -> None:
        """Takes a command; never waits for the bridge."""
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
        """Sends until the bridge is gone."""
        with contextlib.suppress(OSError):
            while True:
                with self._has_news:
                    self._has_news.wait_for(lambda: self._waiting)
                    # whoever wants to stop waits for nothing
                    kind = "Stop" if "Stop" in self._waiting else next(iter(self._waiting))
                    command = self._waiting.pop(kind)
                os.write(self._file, line_of(command))
                time.sleep(PACE)


class Controls:
    """The page's controls of one run.

    Args:
        server: Where.
        allowance: What the device allows.
        ask: Hands a command on.

    Attributes:
        answer: What became of what was asked for, in words.
    """

    def __init__(
        self, server: viser.ViserServer, allowance: Allowance, ask: Callable[[Command], None]
    ) -> None:
        self._allowance, self._ask = allowance, ask
        self._coupling = (allowance.start.stiffness, allowance.start.damping)
        self._touched = 0.0
        gui = server.gui
        with gui.add_folder("control"):
            if allowance.method.has_law:
                self._add_sliders(gui)
            force = gui.add_checkbox("force", initial_value=True)
            clutch = gui.add_checkbox("clutch (the hand moves alone)", initial_value=False)
            reset = gui.add_button("back to the start")
            self._record = gui.add_button("start recording")
            stop = gui.add_button("stop the run", color="red")
            self.answer = gui.add_markdown("")
        self._force, self._clutch, self._is_recording = force, clutch, False
        force.on_update(lambda _: ask(Switch(force=force.value)))
        clutch.on_update(lambda _: ask(Switch(clutch=clutch.value)))
        reset.on_click(lambda _: ask(Reset()))
        self._record.on_click(lambda _: ask(Record(not self._is_recording)))
        stop.on_click(lambda _: ask(Stop()))

    def _add_sliders(self, gui: viser.GuiApi) -> None:
        allowance = self._allowance
        stiffness, damping = self._coupling
        least = allowance.least_stiffness
        most = allowance.most_stiffness(damping), allowance.most_damping(stiffness)
        self._stiffness = gui.add_slider(
            "stiffness K (N/m)",
            _up(least),
            max(_down(most[0]), _up(least)),
            1.0,
            min(max(stiffness, _up(least)), max(_down(most[0]), _up(least))),
        )
        self._damping = gui.add_slider(
            "damping B (N s/m)",
            0.0,
            max(_floor(most[1]), _DIGITS),
            _DIGITS,
            min(damping, max(_floor(most[1]), _DIGITS)),
        )
        self._bounds = gui.add_markdown(self._told())
        self._stiffness.on_update(lambda _: self._want())
        self._damping.on_update(lambda _: self._want())

    def _told(self) -> str:
        return (
            f"K ends at {self._stiffness.max:g} N/m, B at {self._damping.max:g} N s/m. "
            f"{self._allowance.reason()}"
        )

    def _want(self) -> None:
        """Asks for what the sliders show, unless the run has it already."""
        asked = (float(self._stiffness.value), float(self._damping.value))
        if asked == self._coupling:
            return
        self._touched = time.monotonic()
        try:
            self._ask(Couple(*asked))
        except CommandError as error:
            self._refuse(str(error))

    def note(self, event: Mapping[str, Any]) -> None:
        """Takes an event of the run; the controls then show how it is, not what was asked for."""
        kind = event.get("event")
        if kind == "coupling" and self._allowance.method.has_law:
            method, allowance = self._allowance.method, self._allowance
            law = {name: float(event[name]) for name in ("stiffness", "damping")}
            step = allowance.period / allowance.substeps
            felt = method.rendered(replace(allowance.start, **law), step)
            if time.monotonic() - self._touched > STILL:
                self._show(felt.stiffness, felt.damping)
            else:
                self._bound(felt.stiffness, felt.damping)
            self.answer.content = f"K goes to {felt.stiffness:g} N/m, B to {felt.damping:.3g} N s/m"
        elif kind == "switch":
            self.answer.content = "" if event.get("force") else "the force is off"
        elif kind == "reset":
            self.answer.content = "the scene is back at its start"
        elif kind == "recording":
            path = event.get("path")
            self._is_recording = path is not None
            self._record.label = "stop recording" if path else "start recording"
            self.answer.content = f"recording to {path}" if path else "not recording"
        elif kind == "refused":
            self._refuse(str(event.get("reason")))

    def _refuse(self, reason: str) -> None:
        self.answer.content = f"**refused:** {json.dumps(reason, ensure_ascii=False)[1:-1]}"
        if self._allowance.method.has_law:
            self._show(*self._coupling)

    def _show(self, stiffness: float, damping: float) -> None:
        """Puts the sliders to a coupling."""
        self._bound(stiffness, damping)
        shown = (
            min(max(stiffness, self._stiffness.min), self._stiffness.max),
            min(damping, self._damping.max),
        )
        self._coupling = shown
        self._stiffness.value, self._damping.value = shown

    def _bound(self, stiffness: float, damping: float) -> None:
        """Puts the end of each slider to where the other one lets it go."""
        allowance = self._allowance
        self._stiffness.max = max(_down(allowance.most_stiffness(damping)), self._stiffness.min)
        self._damping.max = max(_floor(allowance.most_damping(stiffness)), _DIGITS)
        self._bounds.content = self._told()


def _up(value: float) -> float:
    return float(-(-value // 1.0))


def _down(value: float) -> float:
    return float(value // 1.0)


def _floor(value: float) -> float:
    return round(value // _DIGITS * _DIGITS, 3)

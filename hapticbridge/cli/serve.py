"""``hapticbridge serve``."""

from __future__ import annotations

import json
import os
import secrets
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from threading import Thread
from typing import ClassVar

from hapticbridge.arguments import option
from hapticbridge.cli.run import (
    announce,
    announce_window,
    attach_window,
    exit_code,
    is_mouse,
    open_window,
    print_summary,
    refuse_overwriting,
    warn_of_conditions,
)
from hapticbridge.cli.terminal import err, notify, working
from hapticbridge.clock import RealClock
from hapticbridge.coupling import Coupling
from hapticbridge.demand.guard import refuse_simulated_time
from hapticbridge.errors import HapticBridgeError
from hapticbridge.program.loop_process import PROGRAM_VARIABLE, TOKEN_VARIABLE
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.endpoint import CREDIT, Endpoint, GrantedClock, posted_scene, program_options
from hapticbridge.run.options import DEFAULT_OPTIONS, BridgeOptions
from hapticbridge.run.programs import prepare_run, words
from hapticbridge.signals import interrupting_on_signals

LOOK = 0.5
"""Time in s between two looks whether the program that started the loop still lives."""

BEGINS, LEAVES = "a program has begun", "the program has left; the next one may begin"
TAKES_OVER = "another program has begun, and taken the loop over"
"""Sentences on programs that come and go."""

GONE = "program that was killed"
"""Reason of a stop, in the recording."""


def _watch_parent(parent: int, leave: Callable[[], None]) -> None:
    """Ends the loop when the process that started it is gone, also before this one looked."""
    program = os.environ.get(PROGRAM_VARIABLE, "")
    while os.getppid() == parent and (not program.isdecimal() or _lives(int(program))):
        time.sleep(LOOK)
    leave()


def _lives(process: int) -> bool:
    try:
        os.kill(process, 0)
    except OSError as error:
        return isinstance(error, PermissionError)
    return True


@dataclass(frozen=True, slots=True, kw_only=True)
class Serve:
    """Run a device's loop for another program, which steps the scene.

    The program shows its tool with hapticbridge.DeviceLoop, which starts this command itself on its
    own machine. Here it is for another one: DeviceLoop("remote:HOST:PORT"). Ctrl-C ends the loop.

    Example:
        hapticbridge serve falcon --host 0.0.0.0 --port 8750 --record demo.mcap
    """

    FIRST_OPTIONS: ClassVar = (
        "device",
        "host",
        "port",
        "record",
        "credit",
        "scene_rate",
        "scale",
        "clutch",
    )

    device: str = option("simulated", metavar="DEVICE", is_positional=True)
    """A device, as for 'hapticbridge run --device'."""
    host: str = "127.0.0.1"
    """Address on which the loop listens; 0.0.0.0 for the whole network. The token proves who calls;
    what is told is not secret."""
    port: int = option(8750, least=0, most=65535)
    """Port of the datagrams (UDP); 0 takes any free one."""
    credit: float = option(CREDIT, unit="J", least=0.0, is_open=True, most=10.0)
    """Energy that the program may give to the hand beyond what the hand put in. The tool is held
    back where it would give more."""
    record: Path | None = None
    """File to record to (.mcap)."""
    overwrite: bool = False
    """Replace the recording of --record if the file exists."""
    fast: bool = False
    """Run in simulated time, which the program moves: DeviceLoop(is_simulated=True)."""
    coupling: Mapping[str, float] = option(gains_of=Coupling)
    options: BridgeOptions = DEFAULT_OPTIONS
    view: bool = False
    """Show handle and tool in a browser; the device 'mouse' needs it and has it. Needs the extra
    'view'."""
    view_port: int | None = option(None, least=0, most=65535)
    """Port of the view on this machine, by default 8080; 0 takes any free one."""
    as_json: bool = option(False, flag="json")
    """Print address and summary as JSON, and end when the program leaves."""

    def execute(self) -> int:
        """Runs the loop; returns the exit code."""
        parent = os.getppid()  # later it is another, if the program was killed in between
        refuse_overwriting(self.record, self.device, overwrite=self.overwrite)
        clock = GrantedClock() if self.fast else RealClock()
        refuse_simulated_time(self.device, clock)
        token = os.environ.get(TOKEN_VARIABLE) or secrets.token_urlsafe(18)
        if self.fast and self.options.probe:
            raise HapticBridgeError(
                "probe takes a second before the program may move simulated time; leave it out"
            )
        options = program_options(self.options)
        is_shown = not self.as_json and err.is_terminal
        is_viewed = self.view or is_mouse(self.device)
        window = open_window(self.view_port) if is_viewed else None
        with ExitStack() as stack:
            interrupts = stack.enter_context(interrupting_on_signals())
            prepare_run(lambda left: notify(words(left)))
            with working("opening the device"):
                bridge = Bridge(
                    posted_scene(self.credit),
                    self.device,
                    self.coupling,
                    replace(options, live=is_shown),
                    clock=clock,
                    recording=self.record,
                    observer=window,
                )
            attach_window(window, bridge, bridge.device)
            if self.as_json:
                warn_of_conditions(bridge.setup)
            else:
                announce(bridge.setup, self.coupling, is_method_chosen=False)
            endpoint = Endpoint(
                self.host,
                self.port,
                token.encode(),
                self._on_leave(bridge, clock),
                lambda has_taken_over: self._say(TAKES_OVER if has_taken_over else BEGINS),
            )
            with working("rehearsing the start of the run"):
                stack.enter_context(bridge)
            interrupts.hand_over(bridge.stop_on_signal)
            announce_window(window, bridge.device)
            endpoint.open(bridge)
            if self.as_json:
                leave = partial(self._on_leave(bridge, clock), GONE)
                Thread(target=_watch_parent, args=(parent, leave), daemon=True).start()
            self._tell(endpoint, token)
            error: BaseException | None = None
            try:
                bridge.run()
            except BaseException as caught:
                error = caught
                raise
            finally:
                endpoint.close(error)
                stack.close()
                summary = bridge.summary()
                print_summary(summary, bridge.scene, self.record, as_json=self.as_json)
        return exit_code(summary)

    def _on_leave(self, bridge: Bridge, clock: RealClock | GrantedClock) -> Callable[[str], None]:
        """Returns what is done when the program leaves, with the reason."""

        def leave(reason: str) -> None:
            self._say(LEAVES)
            if self.as_json:
                bridge.stop(reason)
                if isinstance(clock, GrantedClock):
                    clock.release()

        return leave

    def _say(self, words: str) -> None:
        if not self.as_json:
            notify(words)

    def _tell(self, endpoint: Endpoint, token: str) -> None:
        host, port = endpoint.address
        if self.as_json:
            print(json.dumps({"host": host, "port": port}), flush=True)
            return
        notify(f'the program connects with DeviceLoop("remote:{host}:{port}", token="{token}")')

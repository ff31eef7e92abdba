"""Signals to a command that holds a device: before, between and after what its loop heeds."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_cases import ScriptedDevice
from bridge_runs import still, sway
from cli_cases import Called

from hapticbridge.bridge import Bridge
from hapticbridge.recording import read_recording
from hapticbridge.rendering import prepare

SIGNALS = pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])


@pytest.fixture
def unheeded() -> Iterator[list[int]]:
    """What Python's own handler would have got; that would end the tests with this one."""
    got: list[int] = []
    numbers = signal.SIGINT, signal.SIGTERM
    before = {each: signal.signal(each, lambda number, _: got.append(number)) for each in numbers}
    yield got
    for each, handler in before.items():
        signal.signal(each, handler)


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> ScriptedDevice:
    device = ScriptedDevice(still)
    monkeypatch.setattr("hapticbridge.cli.run.device_for", lambda *_: device)
    return device


def signalled(name: str, do: Callable[..., Any]) -> Callable[..., Any]:
    def first(*arguments: Any, **options: Any) -> Any:
        os.kill(os.getpid(), getattr(signal, name))
        return do(*arguments, **options)

    return first


def command(path: Path) -> tuple[object, ...]:
    return ("run", "point_mass", "--fast", "--duration", 0.01, "--record", path)


@SIGNALS
def test_a_signal_while_a_run_is_prepared_is_one_word_and_the_device_is_closed(
    name: str,
    call: Called,
    device: ScriptedDevice,
    unheeded: list[int],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("hapticbridge.session.prepare", signalled(name, prepare))
    code, out, err = call(*command(tmp_path / "run.mcap"))
    assert (code, out, err.splitlines()[-1]) == (130, "", "interrupted")
    assert device.is_closed and not np.any(device.writes)
    assert not unheeded


@SIGNALS
def test_a_signal_between_opening_and_the_first_tick_ends_the_run_cleanly(
    name: str,
    call: Called,
    device: ScriptedDevice,
    unheeded: list[int],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Bridge, "run", signalled(name, Bridge.run))
    code, out, _ = call(*command(tmp_path / "run.mcap"))
    assert code == 0
    assert "0 ticks (signal)" in out
    assert device.is_closed and len(device.writes) and not np.any(device.writes)
    recording = read_recording(tmp_path / "run.mcap")
    assert not recording.is_cut
    assert recording.events[-1]["reason"] == "signal"
    assert recording.events[-1]["signal"] == name
    assert not unheeded


@SIGNALS
def test_a_second_signal_does_not_cut_short_how_a_run_is_closed(
    name: str,
    call: Called,
    device: ScriptedDevice,
    unheeded: list[int],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Bridge, "__exit__", signalled(name, Bridge.__exit__))
    code, out, _ = call(*command(tmp_path / "run.mcap"))
    assert code == 0
    assert "10 ticks (duration)" in out
    assert device.is_closed
    recording = read_recording(tmp_path / "run.mcap")
    assert not recording.is_cut and len(recording.ticks) == 10
    assert not unheeded


@SIGNALS
@pytest.mark.parametrize(
    ("module", "arguments"),
    [("identify", ("identify", "scripted")), ("zwidth", ("zwidth", "--measure", "scripted"))],
)
def test_a_signal_while_a_device_is_measured_leaves_no_force(
    name: str,
    module: str,
    arguments: tuple[str, ...],
    call: Called,
    unheeded: list[int],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It comes in the first tick that has a force."""

    def strike(count: int) -> None:
        if count and device.writes[-1].any() and not struck:
            struck.append(count)
            os.kill(os.getpid(), getattr(signal, name))

    struck: list[int] = []
    device = ScriptedDevice(sway, on_write=strike)
    monkeypatch.setattr(f"hapticbridge.cli.{module}.open_device", lambda *_, **__: device)
    code, _, err = call(*arguments)
    assert (code, err.splitlines()[-1]) == (130, "interrupted")
    assert struck
    assert not device.writes[-1].any() and device.is_closed
    assert not unheeded

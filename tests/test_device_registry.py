"""A device that was opened and is then refused is let go, so that the next run can have it."""

from __future__ import annotations

from dataclasses import replace

import pytest
from cli_cases import Called

from hapticbridge.cli import run
from hapticbridge.demand.guard import Limits
from hapticbridge.device import SimulatedDevice
from hapticbridge.device import registry as library
from hapticbridge.device.falcon.device import DRIVER
from hapticbridge.errors import DeviceError
from hapticbridge.run import options as arrangement
from hapticbridge.run.bridge import Bridge


class Counted(SimulatedDevice):
    closed = 0

    def close(self) -> None:
        self.closed += 1
        super().close()


@pytest.mark.parametrize(
    "option", [("--force-limit", "1e6"), ("--stiffness", "1e9"), ("--clutch", "9")]
)
def test_a_run_refused_late_lets_its_device_go(
    call: Called, monkeypatch: pytest.MonkeyPatch, option: tuple[str, str]
) -> None:
    device = Counted()
    monkeypatch.setattr(run, "device_for", lambda *_: device)
    code, _, err = call("run", "point_mass", *option)
    assert (code, err.count("\n")) == (2, 1)
    assert device.closed == 1


def test_a_refused_bridge_lets_go_of_what_it_opened_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    opened, own = Counted(), Counted()
    monkeypatch.setattr(arrangement, "device_for", lambda *_, **__: opened)
    limits = Limits(force=1e6, torque=1.0)
    with pytest.raises(DeviceError, match="force limit"):
        Bridge("point_mass", "falcon", limits=limits)
    with pytest.raises(DeviceError, match="force limit"):
        Bridge("point_mass", own, limits=limits)
    assert (opened.closed, own.closed) == (1, 0)
    assert Bridge("point_mass", "falcon").device is opened
    assert opened.closed == 1


def test_a_device_whose_profile_is_broken_is_let_go(monkeypatch: pytest.MonkeyPatch) -> None:
    device = Counted()
    family = replace(DRIVER, open=lambda *_: device)
    monkeypatch.setattr(library, "driver_named", lambda _: family)

    def broken(*_: str) -> None:
        raise DeviceError("broken profile")

    monkeypatch.setattr(library, "profile_of", broken)
    with pytest.raises(DeviceError, match="broken profile"):
        library.open_device("falcon")
    assert device.closed == 1
    assert library.open_device("falcon:profile=none") is device
    assert device.closed == 1


def test_a_profile_that_is_taken_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        library, "driver_named", lambda _: replace(DRIVER, open=lambda *_: Counted())
    )
    told: list[str] = []
    library.open_device("falcon:profile=none", notify=told.append)
    assert not told
    library.open_device("falcon:profile=omega3", notify=told.append)
    assert told == ["what 'falcon' leaves out is taken from the profile 'Force Dimension omega.3'"]

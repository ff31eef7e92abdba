"""A device whose samples are old is kicked by couplings that a prompt one would bear."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from device_benches import FalconBench
from report_runs import ANVIL

from hapticbridge.audit import AuditReport, audit
from hapticbridge.coupling import Coupling
from hapticbridge.device import Hand, SimulatedDevice
from hapticbridge.kernel.record import TickFlag, has_flag
from hapticbridge.recording import read_recording
from hapticbridge.run.bridge import Bridge

RETREAT = """t,x,y,z,qw,qx,qy,qz
0,0,0,0,1,0,0,0
0.6,0,0,0,1,0,0,0
1.6,0.01,0,0,1,0,0,0
1.7,0.01,0,0,1,0,0,0
1.8,0,0,0,1,0,0,0
2.5,0,0,0,1,0,0,0
"""
"""Path: in slowly, while the force is full, and out in a tenth of a second."""

LOOSE = Hand(mass=0.01, damping=0.0, stiffness=60.0)
"""A hand that burns nothing: what the coupling creates stays and grows."""


BORNE = 700.0, 0.9
"""K in N/m and B in N s/m that 2 N s/m bear two ticks late, in every scene."""


def held_to_an_anvil(
    folder: Path,
    stiffness: float,
    damping: float = 0.05,
    delay: float | None = None,
    held: SimulatedDevice | None = None,
    controller: str | None = None,
) -> tuple[AuditReport, float]:
    """Returns the verdict, and how far the grip swings at the end in m; b = 2 N s/m, 1 kHz."""
    scene, path = folder / "anvil.xml", folder / "run.mcap"
    scene.write_text(ANVIL)
    bench = FalconBench(held or SimulatedDevice(mass=0.4, damping=2.0, hand=LOOSE))
    device = bench.opened(damping=2.0)
    if delay is not None:
        device.info = dataclasses.replace(device.info, delay=delay)
    coupling = Coupling(stiffness, damping, 0.1, 1e-4)
    clock = bench.clock(2e-4)
    options: dict[str, Any] = {"recording": path, "clock": clock, "controller": controller}
    with Bridge(scene, device, coupling, **options) as bridge:
        bridge.run(duration=2.5)
    swing = np.ptp(read_recording(path).ticks["device_position"][-500:], axis=0).max()
    return audit(path), float(swing)


def test_a_coupling_within_the_delayed_bound_stays_quiet(tmp_path: Path) -> None:
    report, swing = held_to_an_anvil(tmp_path, *BORNE)
    assert (report.verdict, report.certified) == ("passive", True)
    assert swing < 1e-3


def test_a_coupling_that_forgets_the_delay_kicks_and_the_audit_says_so(tmp_path: Path) -> None:
    # K T/2 + B = 1.55 N s/m would be borne without the delay; with it 7.5 N s/m are needed
    report, swing = held_to_an_anvil(tmp_path, 3000.0, controller="off")
    assert swing > 3e-3
    assert report.certified is False
    assert (report.verdict, report.port) == ("active", "device")
    assert report.resimulation == "bit for bit"


def test_a_device_that_hides_its_delay_is_found_by_its_swing(tmp_path: Path) -> None:
    report, swing = held_to_an_anvil(tmp_path, 3000.0, delay=0.0)
    assert swing > 3e-3
    assert (report.verdict, report.certified) == ("passive", False)
    assert has_flag(read_recording(tmp_path / "run.mcap").ticks, TickFlag.SWINGING).any()


def test_a_quick_retreat_from_a_loaded_spring_is_no_kick(tmp_path: Path) -> None:
    # the grip has left 2 ticks before its sample says so: what the spring held there is not counted
    path = tmp_path / "hand.csv"
    path.write_text(RETREAT)
    firm = Hand(mass=0.3, damping=5.0, stiffness=2000.0)
    held = SimulatedDevice(mass=0.4, damping=2.0, hand=firm, path=path)
    report, _ = held_to_an_anvil(tmp_path, *BORNE, held=held)
    assert (report.verdict, report.certified) == ("passive", True)

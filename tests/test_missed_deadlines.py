"""What the device's damper burnt is counted over the time that truly passed between two samples.

A device is pushed into a spring and comes out again in equal steps δ. The force that is held from
one sample to the next gives it ½Kδ² a step more than the spring's energy, and its damper burns
bδ²/t in the time t of a step: it is kicked where K/2 > b/t, the bound b > Kt/2 with the true t.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from audit_cases import ScriptedDevice, SlowClock
from rendering_runs import WALL

from hapticbridge.audit import AuditReport, audit
from hapticbridge.bridge import Bridge
from hapticbridge.guard import Limits
from hapticbridge.summary import Summary

T = 1e-3
B = 2.0
"""Damping of ``ScriptedDevice`` in N s/m."""
STEPS, STEP = 60, 2e-5
"""How often it steps into the spring, and again out of it, and how far in m."""

TOUCHING = WALL.replace('pos="0.07 0 0"', 'pos="0.02 0 0"')


def pushed(
    folder: Path, stiffness: float, clock: SlowClock, missed: int = 0
) -> tuple[Summary, AuditReport]:
    """Pushes a massless tool into a wall and out of it, and audits the recording."""
    scene, path = folder / "wall.xml", folder / "run.mcap"
    scene.write_text(TOUCHING)
    device = ScriptedDevice(
        lambda tick: (STEP * (STEPS - abs(tick - STEPS)), 0, 0, 1, 0, 0, 0), strength=100.0
    )
    with Bridge(
        scene,
        device,
        method="direct",
        contact_stiffness=stiffness,
        clock=clock,
        recording=path,
        limits=Limits(force=100.0, torque=5.0, ramp=0.0),
    ) as bridge:
        summary = bridge.run(2 * STEPS * T * (1 + missed))
    return summary, audit(path)


def check(summary: Summary, report: AuditReport, *, is_kicked: bool) -> None:
    assert report.resimulation == "bit for bit"
    assert summary.verdict == report.verdict == ("active" if is_kicked else "passive")
    if is_kicked:
        assert summary.fault == (report.tick, report.port)
        assert report.port == "device"


@pytest.mark.parametrize("missed", [0, 1, 2, 5])
@pytest.mark.parametrize("excess", [0.95, 1.05])
def test_a_device_is_kicked_where_k_exceeds_2b_over_the_time_of_a_hold(
    tmp_path: Path, missed: int, excess: float
) -> None:
    stiffness = excess * 2 * B / ((1 + missed) * T)
    clock = SlowClock(dict.fromkeys(range(2 * STEPS), missed))
    summary, report = pushed(tmp_path, stiffness, clock, missed)
    assert summary.skipped == 2 * STEPS * missed
    check(summary, report, is_kicked=excess > 1)
    if excess > 1:
        # step by step: ½Kδ² from the hold, bδ²/t burnt; the first step takes an unknown time
        per_step = (0.5 * stiffness - B / ((1 + missed) * T)) * STEP**2
        first = 0.5 * stiffness * STEP**2
        assert report.joules <= first + 2 * STEPS * per_step


def test_ticks_late_within_their_period_burn_less_than_even_ones(tmp_path: Path) -> None:
    """Intervals of 1.8 T and 0.2 T: the long ones burn bδ²/(1.8 T), the short ones no more than T.

    On average (1/1.8 + 1)/2 = 0.78 of b/T, so K = 0.9 · 2b/T kicks, which it does not on time.
    """
    late = dict.fromkeys(range(2, 2 * STEPS, 2), 0.8)
    check(*pushed(tmp_path, 0.9 * 2 * B / T, SlowClock({})), is_kicked=False)
    check(*pushed(tmp_path, 0.9 * 2 * B / T, SlowClock({}, late)), is_kicked=True)
    check(*pushed(tmp_path, 0.74 * 2 * B / T, SlowClock({}, late)), is_kicked=False)

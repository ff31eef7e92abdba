"""Presets of pulses, and the largest pulse that a device can answer a tap with."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from kernel_runs import T, load
from tapping import COUPLING, SPARE, parameters_of, tapping, towards, wall

from hapticbridge.cli.guide import page
from hapticbridge.coupling import Coupling
from hapticbridge.demand.pulse import (
    FORCE_FLOOR,
    PULSES,
    TAP_SPEED,
    Tap,
    pulse_of,
    tap_words,
)
from hapticbridge.device.simulated.device import SimulatedDevice
from hapticbridge.errors import HapticBridgeError
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.options import BridgeOptions
from hapticbridge.whatif.settings import Settings

MASS = 0.1
"""Mass of the tapping tool in kg."""


def parameters(**changes: Any) -> RunParameters:
    return replace(parameters_of(load(wall()), **changes), coupling=COUPLING)


@pytest.mark.parametrize("spare", [SPARE, 0.5, 0.0])
@pytest.mark.parametrize(("share", "decay"), [(1.0, 0.0125), (0.25, 0.0125), (1.0, 5e-4)])
def test_a_tap_is_answered_as_strongly_as_it_says(spare: float, share: float, decay: float) -> None:
    how: dict[str, Any] = {"pulse_damping": spare, "impact_pulses": share, "force_limit": 50.0}
    how["pulse_decay"] = decay
    taps = tapping(**how)
    for _ in range(400):
        taps.tick(towards(TAP_SPEED))
    tap = Tap.of(parameters(**how), MASS)
    blows = taps.ticks["blow_energy"]
    first = int(np.flatnonzero(blows)[0])
    assert blows[first : first + 5].sum() == pytest.approx(tap.burned, rel=0.25)
    # a blow of two ticks has forgotten its first; a second one adds to what is left of the first
    assert 0.6 < np.abs(taps.ticks["pulse"]).max() / tap.pulse < 1.3


@pytest.mark.parametrize("decay", [0.0125, 1e-3, 1e-4])
def test_a_late_device_makes_the_answer_weaker_and_the_force_limit_ends_it(decay: float) -> None:
    """The account forgets for a tick before the pulse: of a very short one nothing is left."""
    how: dict[str, Any] = {"pulse_decay": decay}
    tap = Tap.of(parameters(**how), MASS)
    assert tap.burned == pytest.approx(0.5 * MASS * TAP_SPEED**2)
    kept = tap.burned * math.exp(-T / decay)
    assert tap.pulse == pytest.approx(2.0 * math.sqrt(SPARE * kept / T))
    late = Tap.of(parameters(guarding={"stated_delay": 3 * T}, **how), MASS)
    assert late.pulse == pytest.approx(tap.pulse / 2.0)
    least = min(1.0, tap.pulse)
    assert Tap.of(parameters(force_limit=1.0, **how), MASS).pulse == pytest.approx(least)


def test_words_of_a_tap_say_what_is_spare_and_what_is_too_weak() -> None:
    felt = Tap(0.2, 1e-3, 0.3, FORCE_FLOOR)
    assert "0.3 N s/m more damping" in tap_words(felt)
    assert "too weak" not in tap_words(felt)
    unfelt = tap_words(replace(felt, spare=0.0, pulse=0.99 * FORCE_FLOOR))
    assert "too weak to be felt; the device has no damping to spare" in unfelt


def test_names_and_numbers_of_pulses() -> None:
    assert pulse_of("steel", 600.0) == PULSES["steel"]
    assert pulse_of("250,8", 500.0) == (250.0, 0.008)
    assert pulse_of("0,0.1", 1.0) == (0.0, 1e-4)
    wrong = ("gold", "250", "250,0", "-1,8", "nan,8", "1,2,3", "1e-400,1e-320", "9,0.09", "9,1001")
    for text in (*wrong, "501,8"):
        with pytest.raises(HapticBridgeError, match=r"pulse is .*; it must be one of .* HZ,MS"):
            BridgeOptions(pulse=text, impact_pulses=1.0)


@pytest.mark.parametrize(
    ("rate", "valid"),
    [(599.0, "one of 'rubber', 'wood', or HZ,MS with at most 299.5 Hz"), (59.0, "HZ,MS with at")],
)
def test_a_pulse_too_fast_for_the_rate_is_refused_with_those_that_are_not(
    rate: float, valid: str
) -> None:
    message = f"pulse is 'steel' of 300 Hz; it must be {valid}"
    with pytest.raises(HapticBridgeError, match=message):
        BridgeOptions(pulse="steel", impact_pulses=1.0, rate=rate)


def test_a_pulse_that_no_blow_gives_is_refused_and_goes_with_the_pulses() -> None:
    with pytest.raises(HapticBridgeError, match="pulse is 'steel', but impact-pulses is 0"):
        BridgeOptions(pulse="steel")
    options = BridgeOptions(pulse="steel", impact_pulses=1.0, method="lossless")
    given = Settings(coupling=Coupling(100.0, 1.0, 1.0, 0.01), options=options, scene={})
    assert given.changed({"impact_pulses": 0.0}).options.pulse == BridgeOptions().pulse
    assert given.changed({"impact_pulses": 0.5}).options.pulse == "steel"


def test_a_scene_names_its_pulse_and_the_option_overrides_it(tmp_path: Path) -> None:
    def pulse(text: str, **options: Any) -> tuple[float, float]:
        custom = f'<custom><text name="pulse" data="{text}"/></custom>'
        scene = tmp_path / "wall.xml"
        scene.write_text(wall().replace("</mujoco>", f"{custom if text else ''}</mujoco>"))
        setup = Bridge(scene, SimulatedDevice(), **options).setup
        return setup.pulse

    assert pulse("steel", impact_pulses=1.0) == PULSES["steel"]
    assert pulse("60,10", impact_pulses=1.0) == (60.0, 0.01)
    assert pulse("steel", impact_pulses=1.0, pulse="rubber") == PULSES["rubber"]
    assert pulse("", impact_pulses=1.0) == PULSES["wood"]
    assert pulse("a heart's") == PULSES["wood"]  # a run without pulses does not read it
    for named, rate, message in (
        ("gold", 1000.0, "the scene's custom text 'pulse' is 'gold'; .*; --pulse replaces it"),
        ("steel", 500.0, "the scene's custom text 'pulse' is 'steel' of 300 Hz; .* 'wood', or"),
        ("", 150.0, "the usual pulse is 'wood' of 100 Hz; it must be one of 'rubber', or HZ,MS"),
    ):
        with pytest.raises(HapticBridgeError, match=message):
            pulse(named, impact_pulses=1.0, rate=rate)


def test_the_guide_has_the_presets() -> None:
    rows = [line.split("|")[1:5] for line in page("rigid-contact").splitlines() if "| `" in line]
    found = [[cell.strip() for cell in row] for row in rows]
    assert found == [
        [f"`{name}`", f"{frequency:g}", f"{1e3 * decay:g}", f"{1 / decay:.0f}"]
        for name, (frequency, decay) in PULSES.items()
    ]


def test_the_hammer_rings_like_steel() -> None:
    assert Bridge("hammer", SimulatedDevice(), impact_pulses=1.0).setup.pulse == PULSES["steel"]

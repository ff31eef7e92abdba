"""Commands: what gets into a run, and that nothing beyond the device's bound ever does."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
from audit_cases import COUPLING, ScriptedDevice
from hypothesis import given, settings
from hypothesis import strategies as st

from hapticbridge.demand.guard import Limits
from hapticbridge.demand.loop_setting import LoopSetting
from hapticbridge.demand.methods import method_named
from hapticbridge.device import AXES
from hapticbridge.errors import CommandError
from hapticbridge.run.commands import (
    INTERVAL,
    MAX_LINE,
    MAX_WAITING,
    RESET_INTERVAL,
    Command,
    CommandQueue,
    Couple,
    CouplingLimits,
    Mark,
    Reset,
    Stop,
    Switch,
    command_of,
    line_of,
)

T = 1e-3
INFO = ScriptedDevice(lambda _: (0, 0, 0, 1, 0, 0, 0)).info
"""b = 2 N s/m: BC97 (6) gives K <= 2 b/T = 4000 N/m at B' = 0."""


def allowance(
    method: str = "implicit", scale: float = 1.0, **changes: float | None
) -> CouplingLimits:
    loop = LoopSetting(
        info=replace(INFO, **changes),  # type: ignore[arg-type] # numbers of a device alone
        law=COUPLING,
        period=T,
        scale=scale,
        force_scale=scale,
        method=method_named(method),
    )
    return CouplingLimits(loop=loop, start=COUPLING, limits=Limits(force=10.0, torque=0.5))


@pytest.mark.parametrize(
    ("method", "spent", "back"),
    # b >= K T/2 + B'; the share of K T that B' leaves of B, and what a method gives back of it
    [("implicit", 1, 0.0), ("lossless", 0, 0.5), ("compensated", 0, 1.0)],
)
def test_the_sliders_end_where_the_bound_does(method: str, spent: int, back: float) -> None:
    allowed = allowance(method)
    assert allowed.rotation is not None
    for span, device, gain, other in (
        (allowed.translation, 2.0, 1000.0, 0.5),
        (allowed.rotation, 2e-3, 1.0, 5e-4),
    ):
        stiffest = 2 * (device - spent * other) / T
        max_damped = device + (back - 0.5) * gain * T
        assert span.max_stiffness(other) == pytest.approx(stiffest, rel=1e-9)
        assert span.max_damping(gain) == pytest.approx(max_damped, rel=1e-9)
        span.check(0.9999 * stiffest, other)
        span.check(gain, 0.9999 * max_damped)
        for couple in ((1.0001 * stiffest, other), (gain, 1.0001 * max_damped)):
            with pytest.raises(CommandError, match=f"needs a device of .* {device:g}"):
                span.check(*couple)


def test_bounds_scale_with_motion_and_force_and_angles_do_not() -> None:
    assert allowance(scale=2.0).translation.max_stiffness(0.0) == pytest.approx(4000 / 4, rel=1e-9)
    for scales in ((2.0, 2.0), (2.0, 1.0), (1.0, 2.0)):
        loop = replace(allowance().loop, scale=scales[0], force_scale=scales[1])
        scaled = replace(allowance(), loop=loop).rotation
        assert scaled is not None
        most = 2 * 2e-3 / T * scales[0] / scales[1]
        assert scaled.max_stiffness(0.0) == pytest.approx(most, rel=1e-9)


def test_an_unknown_damping_is_the_one_that_the_default_coupling_takes() -> None:
    allowed = allowance(damping=None)
    span = allowed.translation
    assert span.max_stiffness(0.0) == pytest.approx(2 * span.damping / T, rel=1e-9)
    assert "(assumed; it is unknown)" in allowed.reason()
    assert "assumed" not in allowance().reason()


def test_the_softest_coupling_shows_the_whole_force_unless_the_run_began_softer() -> None:
    hard, began = allowance(), replace(COUPLING, stiffness=300.0)
    soft = replace(allowance(damping=50.0), start=began)
    # 10 N within 0.2 m, or a share of the stiffest
    for allowed, least in ((hard, max(10.0 / 0.2, 0.05 * 4000)), (soft, 300.0)):
        assert allowed.translation.min_stiffness == pytest.approx(least)
        allowed.translation.check(least, 0.0)
        with pytest.raises(CommandError, match="no longer feels"):
            allowed.translation.check(0.999 * least, 0.0)


FLAT = replace(allowance(), loop=replace(allowance().loop, info=replace(INFO, axes=AXES[:3])))


@pytest.mark.parametrize(
    ("allowed", "gains", "message"),
    [
        (allowance(), (1000.0, 0.5, 0.0, 0.0), "rotational stiffness is 0 N m/rad"),
        (allowance(), (1000.0, 0.5, 4.1, 0.0), r"rotational .* device of .* N m s/rad, .* 0\.002"),
        (allowance(), (4040.0, 0.0, 1.0, 0.0), "needs a device of"),  # each has its own bound
        (FLAT, (1000.0, 0.5, 1.0, 0.0), "'scripted' feels no torque"),
        (allowance("weld"), (1000.0, 0.0), "'weld' has no coupling law"),
        # each alone would be checked against the other's value of now, which may change until then
        (allowance(), (1000.0, 0.5, 1.0, None), "together"),
        (allowance(), (1000.0, 0.5, None, 1e-3), "together"),
        *(
            (allowance(), (1000.0, 0.5, value, 0.0), "rotational")
            for value in (math.nan, math.inf, -1.0, "x", True)
        ),
    ],
)
def test_gains_that_cannot_be_are_refused(
    allowed: CouplingLimits, gains: tuple[Any, ...], message: str
) -> None:
    with pytest.raises(CommandError, match=message):
        allowed.check(Couple(*gains))


def test_a_device_that_does_not_turn_has_no_gains_for_it() -> None:
    assert (FLAT.rotation, len(FLAT.spans)) == (None, 1)
    FLAT.check(Couple(1000.0, 0.5))


OFF, ON = Switch(force=False), Switch(force=True)


@pytest.mark.parametrize(
    ("method", "is_recorded", "offers", "message"),
    [
        ("implicit", True, [(0, OFF), (0.99 * INTERVAL, ON)], "too recent"),
        ("implicit", True, [(0, Reset()), (0.99 * RESET_INTERVAL, Reset())], "too recent"),
        ("implicit", True, [(1.0, ON)] * MAX_WAITING + [(1.0, OFF)], "it stalls"),
        ("implicit", False, [(0, Mark())], "not recorded"),
        ("direct", True, [(0, Reset())], "massless tool"),
    ],
)
def test_the_last_of_these_commands_is_refused_and_the_others_wait(
    method: str, is_recorded: bool, offers: list[tuple[float, Command]], message: str
) -> None:
    now = 100.0
    queue = CommandQueue({"grip": allowance(method)}, is_recorded=is_recorded, now=lambda: now)
    for after, command in offers[:-1]:
        now += after
        queue.offer(command, "test")
    now += offers[-1][0]
    with pytest.raises(CommandError, match=message):
        queue.offer(offers[-1][1], "test")
    assert [command for command, _ in queue.waiting] == [command for _, command in offers[:-1]]


numbers = st.floats() | st.integers() | st.booleans() | st.none() | st.text(max_size=4)


@settings(max_examples=50)
@given(
    method=st.sampled_from(["implicit", "lossless", "compensated", "explicit"]),
    stiffness=numbers | st.floats(0, 1e4),
    damping=numbers | st.floats(0, 4),
)
def test_nothing_gets_in_that_needs_more_than_the_device_has(
    method: str, stiffness: object, damping: object
) -> None:
    queue = CommandQueue({"grip": allowance(method)})
    line = b'{"command": "couple", "stiffness": %s, "damping": %s}'
    said = line % tuple(_json(value) for value in (stiffness, damping))
    try:
        queue.offer(command_of(said), "test")
    except CommandError:
        assert not queue.waiting
        return
    [(command, _)] = queue.waiting
    assert isinstance(command, Couple)
    felt = queue.limits["grip"].requested(command, COUPLING)
    used = queue.limits["grip"].law(felt)
    assert math.isfinite(used.stiffness)
    assert used.stiffness * T / 2 + used.damping <= 2.0 * (1 + 1e-8)


def _json(value: object) -> bytes:
    names = {True: b"true", False: b"false", None: b"null"}
    if isinstance(value, bool) or value is None:
        return names[value]
    return repr(value).encode() if isinstance(value, int | float) else b'"x"'


@settings(max_examples=100)
@given(st.binary(max_size=2 * MAX_LINE))
def test_any_bytes_are_a_command_or_refused(said: bytes) -> None:
    try:
        command = command_of(said)
    except CommandError:
        return
    assert command_of(line_of(command)) == command


@pytest.mark.parametrize(
    "command",
    [
        Couple(1234.5, 0.1),
        Couple(*(1e3 * math.pi * 10.0**-number for number in (0, 3, 3, 6))),
        Switch(force=False),
        Switch(clutch=True),
        Switch(),
        Reset(),
        Mark(),
        Stop(),
    ],
)
def test_a_command_reads_back_as_it_was_written(command: Command) -> None:
    assert command_of(line_of(command)) == command
    assert len(line_of(command)) <= MAX_LINE


@pytest.mark.parametrize("substeps", [1, 4])
@pytest.mark.parametrize("delay", [0.0, 1e-3])
def test_what_is_needed_is_what_the_certificate_says(substeps: int, delay: float) -> None:
    laws = method_named("implicit").law_evaluations(substeps)
    allowed = allowance(delay=delay)
    allowed = replace(allowed, loop=replace(allowed.loop, law_evaluations=laws))
    for stiffness, damping in ((200.0, 0.0), (1000.0, 0.7), (3000.0, 0.1)):
        used = allowed.law(allowed.requested(Couple(stiffness, damping), COUPLING))
        said = replace(allowed.loop, law=used).needed("translation")
        need = allowed.translation.needed(stiffness, damping)
        if substeps == 1 and not delay:
            assert need == pytest.approx(said, rel=1e-9)
        else:  # read off a table, on the safe side
            assert said * (1 - 1e-9) <= need <= 1.01 * said


def test_friction_for_the_encoders_steps_is_a_limit_of_its_own_and_named() -> None:
    """Half of the steps' condition at B' = 0: f_c >= K Δ/2, so K <= 1500 N/m."""
    allowed = allowance("lossless", resolution=2e-5, friction=0.015)
    assert allowed.translation.max_stiffness(0.0) == pytest.approx(1500.0, rel=1e-6)
    assert allowance("lossless").translation.max_stiffness(0.0) > 3000.0
    with pytest.raises(CommandError) as refused:
        allowed.check(Couple(2000.0, 0.5))
    assert str(refused.value) == (
        "stiffness 2000 N/m with damping 0.5 N s/m needs 0.02 N of friction for the encoder's "
        "steps of 20 µm; the device has 0.015 N"
    )
    assert "its friction of 15 mN for its steps of 20 µm" in allowed.reason()
    allowed.check(Couple(1400.0, 0.5))
    assert "friction" not in allowance(resolution=2e-5, friction=None).reason()


def test_without_friction_no_coupling_may_shake_more_than_the_starts() -> None:
    allowed = allowance("lossless", resolution=2e-5, friction=0.0)
    start = allowed.start
    allowed.check(Couple(start.stiffness, start.damping))
    allowed.check(Couple(0.9 * start.stiffness, start.damping))
    with pytest.raises(CommandError, match="the device has none"):
        allowed.check(Couple(1.1 * start.stiffness, start.damping))
    assert "without friction they shake any coupling" in allowed.reason()

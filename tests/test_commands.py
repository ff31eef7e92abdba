"""Commands: what gets into a run, and that nothing beyond the device's bound ever does."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from audit_cases import COUPLING, ScriptedDevice
from hypothesis import given, settings
from hypothesis import strategies as st

from hapticbridge.certificate import required_axis_damping
from hapticbridge.commands import (
    Command,
    CommandQueue,
    Couple,
    CouplingLimits,
    Mark,
    Reset,
    Switch,
    command_of,
)
from hapticbridge.commands.command import LONGEST_LINE, Stop, line_of
from hapticbridge.commands.execution import INTERVAL, MOST_WAITING, RESET_INTERVAL
from hapticbridge.errors import CommandError
from hapticbridge.guard import Limits
from hapticbridge.rendering import method_named

T = 1e-3
INFO = ScriptedDevice(lambda _: (0, 0, 0, 1, 0, 0, 0)).info
"""b = 2 N s/m: BC97 (6) gives K <= 2 b/T = 4000 N/m at B' = 0."""


def allowance(
    method: str = "implicit", scale: float = 1.0, **changes: float | None
) -> CouplingLimits:
    return CouplingLimits(
        info=replace(INFO, **changes),  # type: ignore[arg-type] # numbers of a device alone
        method=method_named(method),
        start=COUPLING,
        period=T,
        scale=scale,
        force_scale=scale,
        substeps=1,
        limits=Limits(force=10.0, torque=0.5),
    )


@pytest.mark.parametrize(
    ("method", "stiffest", "most_damped"),
    [
        # b >= K T/2 + B
        ("implicit", 2 * (2 - 0.5) / T, 2 - 1000 * T / 2),
        # B' = B - K T/2, 0 at least
        ("lossless", 2 * 2 / T, 2.0),
        # B' = B - K T, 0 at least
        ("compensated", 2 * 2 / T, 2 + 1000 * T / 2),
    ],
)
def test_the_sliders_end_where_the_bound_does(
    method: str, stiffest: float, most_damped: float
) -> None:
    allowed = allowance(method).translation
    assert allowed.most_stiffness(0.5) == pytest.approx(stiffest, rel=1e-9)
    assert allowed.most_damping(1000.0) == pytest.approx(most_damped, rel=1e-9)
    allowed.check(0.9999 * stiffest, 0.5)
    allowed.check(1000.0, 0.9999 * most_damped)
    for couple in ((1.0001 * stiffest, 0.5), (1000.0, 1.0001 * most_damped)):
        with pytest.raises(CommandError, match=r"needs a device of .* N s/m, and this one has 2"):
            allowed.check(*couple)


def test_the_bound_scales_with_motion_and_force() -> None:
    assert allowance(scale=2.0).translation.most_stiffness(0.0) == pytest.approx(4000 / 4, rel=1e-9)


def test_an_unknown_damping_is_the_one_that_the_default_coupling_takes() -> None:
    allowed = allowance(damping=None)
    span = allowed.translation
    assert span.most_stiffness(0.0) == pytest.approx(2 * span.damping / T, rel=1e-9)
    assert "(assumed; it is unknown)" in allowed.reason()
    assert "assumed" not in allowance().reason()


def test_the_softest_coupling_still_shows_the_whole_force() -> None:
    allowed = allowance().translation
    least = allowed.least_stiffness
    assert least == pytest.approx(max(10.0 / 0.2, 0.05 * 4000))  # 10 N within 0.2 m; a share
    allowed.check(least, 0.0)
    with pytest.raises(CommandError, match="no longer feels"):
        allowed.check(0.999 * least, 0.0)


def test_a_run_that_began_softer_may_stay_so() -> None:
    # else a touch of the damping alone would take the stiffness to the slider's end
    began = replace(COUPLING, stiffness=300.0)
    soft = replace(allowance(damping=50.0), start=began).translation
    assert soft.least_stiffness == 300.0
    soft.check(300.0, 1.0)
    with pytest.raises(CommandError, match="no longer feels"):
        soft.check(299.0, 1.0)


@pytest.mark.parametrize(
    ("method", "stiffest", "most_damped"),
    [
        # b_r = 2e-3 N m s/rad >= (s_f/s_h) (K_r T/2 + B_r), and B_r' as above
        ("implicit", 2 * (2e-3 - 5e-4) / T, 2e-3 - 1.0 * T / 2),
        ("lossless", 2 * 2e-3 / T, 2e-3),
        ("compensated", 2 * 2e-3 / T, 2e-3 + 1.0 * T / 2),
    ],
)
def test_turning_ends_where_its_own_bound_does(
    method: str, stiffest: float, most_damped: float
) -> None:
    allowed = allowance(method)
    assert allowed.rotation is not None
    assert allowed.rotation.most_stiffness(5e-4) == pytest.approx(stiffest, rel=1e-9)
    assert allowed.rotation.most_damping(1.0) == pytest.approx(most_damped, rel=1e-9)
    allowed.check(Couple(1000.0, 0.5, 0.9999 * stiffest, 5e-4))
    for turning in ((1.0001 * stiffest, 5e-4), (1.0, 1.0001 * most_damped)):
        with pytest.raises(CommandError, match=r"rotational .* device of .* N m s/rad, .* 0\.002"):
            allowed.check(Couple(1000.0, 0.5, *turning))
    with pytest.raises(CommandError, match="rotational stiffness is 0 N m/rad"):
        allowed.check(Couple(1000.0, 0.5, 0.0, 0.0))
    with pytest.raises(CommandError, match="needs a device of"):  # each has its own bound
        allowed.check(Couple(1.01 * 2 * 2 / T, 0.0, 1.0, 0.0))


def test_angles_are_not_scaled_and_torques_are() -> None:
    for scales in ((2.0, 2.0), (2.0, 1.0), (1.0, 2.0)):
        scaled = replace(allowance(), scale=scales[0], force_scale=scales[1]).rotation
        assert scaled is not None
        most = 2 * 2e-3 / T * scales[0] / scales[1]
        assert scaled.most_stiffness(0.0) == pytest.approx(most, rel=1e-9)


def test_a_device_that_does_not_turn_has_no_gains_for_it() -> None:
    allowed = replace(allowance(), info=replace(INFO, axes=("x", "y", "z")))
    assert allowed.rotation is None
    assert len(allowed.spans) == 1
    allowed.check(Couple(1000.0, 0.5))
    with pytest.raises(CommandError, match="'scripted' feels no torque"):
        allowed.check(Couple(1000.0, 0.5, 1.0, 0.0))


def test_turning_gains_come_together() -> None:
    # each alone would be checked against the other's value of now, which may change until then
    for turning in ((1.0, None), (None, 1e-3)):
        with pytest.raises(CommandError, match="together"):
            Couple(1000.0, 0.5, *turning)
    for value in (math.nan, math.inf, -1.0, "x", True):
        with pytest.raises(CommandError, match="rotational"):
            Couple(1000.0, 0.5, value, 0.0)  # type: ignore[arg-type] # what a wire may say


def test_without_a_coupling_law_there_is_nothing_to_change() -> None:
    with pytest.raises(CommandError, match="'weld' has no coupling law"):
        allowance("weld").check(Couple(1000.0, 0.0))


class Time:
    """Seconds that a test sets."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_commands_that_follow_too_soon_are_refused() -> None:
    time = Time()
    queue = CommandQueue(allowance(), now=time)
    queue.offer(Switch(force=False), "test")
    time.now += 0.99 * INTERVAL
    with pytest.raises(CommandError, match="too recent"):
        queue.offer(Switch(force=True), "test")
    time.now += 0.02 * INTERVAL
    queue.offer(Reset(), "test")
    time.now += 0.99 * RESET_INTERVAL
    queue.offer(Couple(1000.0, 0.5), "test")
    time.now += INTERVAL / 2
    with pytest.raises(CommandError, match="too recent"):
        queue.offer(Reset(), "test")
    assert [type(command) for command, _ in queue.waiting] == [Switch, Reset, Couple]


def test_a_loop_that_takes_nothing_is_told_nothing_more() -> None:
    time = Time()
    queue = CommandQueue(allowance(), now=time)
    for _ in range(MOST_WAITING):
        time.now += 1.0
        queue.offer(Switch(force=True), "test")
    time.now += 1.0
    with pytest.raises(CommandError, match="it stalls"):
        queue.offer(Switch(force=False), "test")
    assert len(queue.waiting) == MOST_WAITING
    assert all(command == Switch(force=True) for command, _ in queue.waiting)


def test_what_the_run_cannot_do_is_refused() -> None:
    with pytest.raises(CommandError, match="not recorded"):
        CommandQueue(allowance(), is_recorded=False).offer(Mark(), "test")
    with pytest.raises(CommandError, match="massless tool"):
        CommandQueue(allowance("direct")).offer(Reset(), "test")


numbers = st.floats() | st.integers() | st.booleans() | st.none() | st.text(max_size=4)


@settings(max_examples=100, deadline=None)
@given(
    method=st.sampled_from(["implicit", "lossless", "compensated", "explicit"]),
    stiffness=numbers | st.floats(0, 1e4),
    damping=numbers | st.floats(0, 4),
)
def test_nothing_gets_in_that_needs_more_than_the_device_has(
    method: str, stiffness: object, damping: object
) -> None:
    queue = CommandQueue(allowance(method))
    line = b'{"command": "couple", "stiffness": %s, "damping": %s}'
    said = line % tuple(_json(value) for value in (stiffness, damping))
    try:
        queue.offer(command_of(said), "test")
    except CommandError:
        assert not queue.waiting
        return
    [(command, _)] = queue.waiting
    assert isinstance(command, Couple)
    felt = queue.limits.requested(command, COUPLING)
    used = queue.limits.law(felt)
    assert math.isfinite(used.stiffness)
    assert used.stiffness * T / 2 + used.damping <= 2.0 * (1 + 1e-8)


def _json(value: object) -> bytes:
    names = {True: b"true", False: b"false", None: b"null"}
    if isinstance(value, bool) or value is None:
        return names[value]
    return repr(value).encode() if isinstance(value, int | float) else b'"x"'


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=2 * LONGEST_LINE))
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
    assert len(line_of(command)) <= LONGEST_LINE


@pytest.mark.parametrize("substeps", [1, 4])
@pytest.mark.parametrize("delay", [0.0, 1e-3])
def test_what_is_needed_is_what_the_certificate_says(substeps: int, delay: float) -> None:
    allowed = replace(allowance(delay=delay), substeps=substeps)
    for stiffness, damping in ((200.0, 0.0), (1000.0, 0.7), (3000.0, 0.1)):
        used = allowed.law(allowed.requested(Couple(stiffness, damping), COUPLING))
        laws = allowed.method.laws(substeps)
        said = required_axis_damping(allowed.info, used, T, 1.0, 1.0, laws, allowed.method)[0]
        need = allowed.translation.needed(stiffness, damping)
        if substeps == 1 and not delay:
            assert need == pytest.approx(said, rel=1e-9)
        else:  # read off a table, on the safe side
            assert said * (1 - 1e-9) <= need <= 1.01 * said

"""Silence of a device, counted in readings and not in time alone."""

from __future__ import annotations

import pytest

from hapticbridge.device.watchdog import SILENCE, SilenceDetector

PERIOD = 1e-3


@pytest.mark.parametrize("step", [PERIOD, 10 * PERIOD, 45 * PERIOD, 0.1])
def test_a_device_is_silent_after_fifty_milliseconds_at_any_rate(step: float) -> None:
    watch = SilenceDetector(3.0, step)
    verdicts = [watch.is_silent(3.0 + step * k, is_new=False) for k in range(1, 60)]
    assert SILENCE < step * (verdicts.index(True) + 1) < SILENCE + step + 1e-9
    assert all(verdicts[verdicts.index(True) :])


def test_one_sample_begins_the_count_anew() -> None:
    watch = SilenceDetector(0.0)
    for k in range(1, 200):
        assert not watch.is_silent(PERIOD * k, is_new=k % 45 == 0)


def test_a_loop_that_was_away_does_not_take_the_device_for_silent() -> None:
    watch = SilenceDetector(0.0)
    assert not watch.is_silent(0.04, is_new=False)
    assert not watch.is_silent(0.04 + 2.0 * SILENCE, is_new=False)
    # and the count goes on from there
    assert not watch.is_silent(0.04 + 2.9 * SILENCE, is_new=False)
    assert watch.is_silent(0.04 + 3.1 * SILENCE, is_new=False)


@pytest.mark.parametrize("period", [PERIOD, 0.02])
def test_a_loop_was_away_if_it_came_a_silence_late(period: float) -> None:
    watch = SilenceDetector(0.0, period)
    watch.is_silent(1.0, is_new=True)
    assert not watch.was_away(1.0 + period + 0.99 * SILENCE)
    assert watch.was_away(1.0 + period + 1.01 * SILENCE)
    watch.is_silent(2.0, is_new=False)
    assert not watch.was_away(2.0 + period)

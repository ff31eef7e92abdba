"""MuJoCo's C library as the compiled tick uses it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import mujoco
import pytest

import hapticbridge as hb
from hapticbridge.kernel.mujoco_c import copy_of, without_timers

STEP = int(mujoco.mjtTimer.mjTIMER_STEP)


class Falling:
    """A free body, and the time that MuJoCo says that its steps took."""

    def __init__(self) -> None:
        spec = mujoco.MjSpec()
        body = spec.worldbody.add_body(mass=1, inertia=[1, 1, 1], explicitinertial=True)
        body.add_freejoint()
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)

    def timed(self) -> bool:
        before = self.data.timer[STEP].duration
        mujoco.mj_step(self.model, self.data, 10)
        return bool(self.data.timer[STEP].duration > before)


def test_timers_stand_inside_and_run_again_after_the_last_of_several_uses() -> None:
    body = Falling()
    assert body.timed()
    with without_timers():
        assert not body.timed()
        with without_timers():
            assert not body.timed()
        assert not body.timed()
    assert body.timed()


def test_timers_run_again_after_an_error() -> None:
    body = Falling()
    with pytest.raises(ValueError, match="inside"), without_timers():
        raise ValueError("inside")
    assert body.timed()


def test_a_clock_of_the_program_stays() -> None:
    body, ticks = Falling(), iter(range(10_000))
    mujoco.set_mjcb_time(lambda: float(next(ticks)))
    try:
        with without_timers():
            assert body.timed()
    finally:
        mujoco.set_mjcb_time(None)
    assert body.timed()


def test_a_clock_installed_inside_stays() -> None:
    body, ticks = Falling(), iter(range(10_000))
    try:
        with without_timers():
            mujoco.set_mjcb_time(lambda: float(next(ticks)))
        next(ticks)
        body.timed()
        assert next(ticks) > 2  # MuJoCo has read it
    finally:
        mujoco.set_mjcb_time(None)


def test_a_run_reads_no_clock_in_a_step() -> None:
    scene = hb.load_scene("point_mass")
    before = scene.data.timer[STEP].duration
    with hb.Bridge(scene, "simulated", clock=hb.SimulatedClock()) as bridge:
        before = scene.data.timer[STEP].duration
        bridge.run(0.05)
        assert scene.data.timer[STEP].duration == before


def test_a_copy_is_whole_or_refused() -> None:
    lists = ("actuators", "equalities", "excludes", "pairs", "sensors", "tendons", "tuples")

    def stand_in(copied: dict[str, Any], *, refused: str = "") -> Any:
        def compiled() -> None:
            if refused:
                raise ValueError(refused)

        copy = SimpleNamespace(_address=1, **dict.fromkeys(lists, (0,)) | copied)
        return SimpleNamespace(copy=lambda: copy, compile=compiled, **dict.fromkeys(lists, (0,)))

    assert copy_of(whole := stand_in({})) is whole.copy()
    for lost in ({"sensors": ()}, {"tuples": ()}):
        with pytest.raises(ValueError, match="no such joint"):
            copy_of(stand_in(lost, refused="no such joint"))
        with pytest.raises(ValueError, match="MuJoCo cannot copy the specification"):
            copy_of(stand_in(lost))

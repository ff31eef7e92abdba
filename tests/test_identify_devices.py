"""Real drivers on emulated devices of known mechanics: what ``identify`` makes of them."""

from __future__ import annotations

import pytest
from identified_devices import identified, mechanics


@pytest.mark.parametrize("driver", ["falcon", "rawhid"])
@pytest.mark.parametrize(("seed", "axis"), [(0, "x"), (1, "y"), (2, "z")])
def test_a_device_behind_its_driver_is_measured(driver: str, seed: int, axis: str) -> None:
    true = mechanics(seed)
    fit = identified(driver, seed, axis)
    assert fit.mass.value == pytest.approx(true["mass"], rel=0.05)
    assert fit.damping.value == pytest.approx(true["damping"], rel=0.05)
    assert fit.friction.value == pytest.approx(true["friction"], rel=0.10)
    for name, value in true.items():
        estimate = getattr(fit, name)
        assert estimate.least <= value <= estimate.most


def test_a_falcons_answer_is_found_to_be_two_ticks_old() -> None:
    """One tick from question to answer, one until the next is asked: what its driver derives."""
    delay = identified("falcon", 3, "x").delay
    assert delay.value == pytest.approx(2e-3, abs=0.4e-3)
    assert delay.half_width < 0.8e-3

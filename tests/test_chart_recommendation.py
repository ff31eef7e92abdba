"""What a chart recommends, and what it says of the points that it passes over."""

from __future__ import annotations

import pytest
from chart_cases import made_up

from hapticbridge.lab.chart.output import recommendation, recommended


def test_cheapest_sound_point_is_recommended_and_the_more_accurate_of_equal_costs() -> None:
    cheap = made_up(0.010, 0.9, spread=0.1)
    better = made_up(0.0105, 0.3, method="lossless")
    dear = made_up(0.020, 0.1)
    assert recommended([cheap, better, dear]) is better
    assert recommended([cheap, dear]) is cheap


def test_points_whose_spreads_meet_cost_alike_whichever_is_disturbed() -> None:
    calm, disturbed = made_up(0.0100, 0.9), made_up(0.0110, 0.3, method="lossless", spread=0.1)
    assert recommended([calm, disturbed]) is disturbed
    apart = made_up(0.0110, 0.3, method="lossless", spread=0.05)
    assert recommended([calm, apart]) is calm


def test_usual_contact_is_recommended_where_errors_are_alike() -> None:
    odd = made_up(0.0100, 0.300, contact="2 steps", spread=0.1)
    usual = made_up(0.0101, 0.301)
    assert recommended([odd, usual]) is usual


@pytest.mark.parametrize(
    ("flawed", "said"),
    [
        (made_up(0.01, 1.5), "its error is 1.5 JND"),
        (made_up(0.01, 0.5, verdict="active"), "its environment is active"),
        (made_up(0.01, 0.5, verdict="lost contact"), "its environment is lost contact"),
        (made_up(0.6, 0.5), "it takes 60 % of a core"),
        (made_up(0.01, 0.5, method="explicit"), "it may kick on a real device"),
    ],
)
def test_flawed_point_is_not_recommended_but_named_with_its_flaw(flawed: object, said: str) -> None:
    assert recommended([flawed]) is None  # type: ignore[list-item]
    text = recommendation([flawed], "a machine")  # type: ignore[list-item]
    assert "no point does it all" in text
    assert said in text
    good = made_up(0.3, 0.9)
    assert recommended([flawed, good]) is good  # type: ignore[list-item]


def test_error_that_grows_at_a_smaller_step_is_called_luck() -> None:
    lucky, finer = made_up(0.01, 0.2), made_up(0.02, 3.0, period=5e-4)
    assert recommended([lucky, finer]) is None
    assert "it is luck" in recommendation([lucky, finer], "a machine")
    assert recommended([lucky, made_up(0.02, 0.4, period=5e-4)]) is lucky
    # another method's error at a smaller step says nothing of this one
    assert recommended([lucky, made_up(0.02, 3.0, period=5e-4, method="lossless")]) is lucky


def test_solver_that_is_cut_short_is_not_recommended() -> None:
    short = made_up(0.01, 0.2, iterations=1)
    assert recommended([short]) is None
    assert "its solver is cut short" in recommendation([short], "a machine")
    assert recommended([short, made_up(0.02, 0.3)]) is not short


def test_slower_than_a_kilohertz_is_never_recommended() -> None:
    slow = made_up(0.001, 0.1, period=2e-3)
    assert recommended([slow]) is None
    assert "nothing was tried that runs at this rate" in recommendation([slow], "a machine")
    assert recommended([slow, made_up(0.1, 0.5)]) is not slow


def test_setting_that_no_other_step_bears_out_is_recommended_last_and_said_to_be_luck() -> None:
    once = made_up(0.010, 0.1, contact="damped")
    twice = [
        made_up(0.012, 0.8, method="lossless"),
        made_up(0.02, 0.4, method="lossless", period=5e-4),
    ]
    assert recommended([once, *twice]) is twice[0]
    finer = made_up(0.02, 0.2, contact="damped", period=5e-4)
    assert recommended([once, finer, *twice]) is once
    assert "may be luck" not in recommendation([once, finer, *twice], "a machine")
    # nothing else was tried: it is said
    assert recommended([once]) is once
    assert "No other time step bears this out, so it may be luck" in recommendation([once], "m")
    # and what another step contradicts is not borne out by it
    coarser = made_up(0.005, 4.0, contact="damped", period=2e-3)
    assert recommended([once, coarser, *twice]) is twice[0]


def test_point_nearer_to_its_own_limit_than_that_is_to_others_is_not_comparable() -> None:
    apart = made_up(0.010, 0.02, method="lossless", limit_apart=0.34)
    shared = made_up(0.012, 0.3, limit_apart=0.004)
    assert not apart.is_comparable
    assert shared.is_comparable
    assert recommended([apart, shared]) is shared
    text = recommendation([apart], "a machine")
    assert "its own limit lies 0.34 JND from what most methods converge to" in text
    far = made_up(0.010, 0.5, method="lossless", limit_apart=0.34)
    assert far.is_comparable

"""A trip as recorded facts: they are read back, and a sentence that differs is damage."""

from __future__ import annotations

import pytest

from hapticbridge.demand.trip import Trip, TripCode
from hapticbridge.errors import RecordingError
from hapticbridge.kernel import codes
from hapticbridge.kernel.hand_energy import HandEnergy

TRIPS = (
    Trip(TripCode.JUMPED, 5),
    Trip(TripCode.STRETCHED, 7, hand="left"),
    Trip(TripCode.DEVICE, 9, detail="the device 'X' is gone"),
)


@pytest.mark.parametrize("trip", TRIPS, ids=lambda trip: trip.code)
def test_the_event_of_a_trip_reads_back(trip: Trip) -> None:
    event = {"event": "trip", "tick": trip.tick, **trip.details()}
    assert Trip.among([{"event": "start", "tick": 0}, event]) == trip
    assert Trip.among([{"event": "start", "tick": 0}]) is None


@pytest.mark.parametrize(
    "change", [{"code": "felt bad"}, {"hand": 3}, {"tick": "5"}, {"reason": "nothing happened"}]
)
def test_an_event_of_a_trip_that_contradicts_itself_is_refused(change: dict[str, object]) -> None:
    event = {"event": "trip", "tick": 5, **TRIPS[0].details()} | change
    with pytest.raises(RecordingError, match="event 'trip'"):
        Trip.among([event])


def test_each_result_of_the_kernel_has_a_code_and_words() -> None:
    assert Trip.of_result(codes.GAVE_ENERGY, 3, "left").hand == "left"
    assert Trip.of_result(codes.CONTACTS_FULL, 3, "left").hand == ""  # of the scene, not of a hand
    assert Trip.of_result(codes.BAD_RESULT, 3).code is TripCode.DIVERGED
    for code in TripCode:
        trip = Trip(code, 3, detail="why")
        assert trip.sentence.startswith("tick 3: ") and "{" not in trip.sentence
        assert trip.is_unsound is (code in UNSOUND)


UNSOUND = (
    *(TripCode.CONTACTS_FULL, TripCode.CONSTRAINTS_FULL),
    *(TripCode.DIVERGED, TripCode.SIMULATION),
)


@pytest.mark.parametrize("code", [TripCode.STRETCHED, TripCode.TWISTED])
def test_a_tool_that_was_pushed_away_is_not_blamed_on_the_hand_alone(code: TripCode) -> None:
    remedy = Trip(code, 3).remedy(HandEnergy(motors=33.8e3), strongest="crank")
    assert "springs, motors or inputs of the scene" in remedy
    assert remedy.endswith("motors did 33.8 kJ of work until then ('crank' pushes most)")
    applied = Trip(code, 3).remedy(HandEnergy(inputs=112.0))
    assert applied.endswith(
        "(applied forces, moved mocap bodies, belts) did 112 J of work until then"
    )
    assert "until then" not in Trip(code, 3).remedy(HandEnergy(net=0.01))

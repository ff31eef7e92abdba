"""Theory and mechanics at the ends of their range, and what is no argument at all."""

from __future__ import annotations

import datetime
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hapticbridge import theory as m
from hapticbridge import theory as p
from hapticbridge.arguments import LARGEST, SMALLEST
from hapticbridge.coupling import Coupling
from hapticbridge.demand.plots import alternatives
from hapticbridge.errors import CouplingError, HapticBridgeError, MechanicsError

T = 1e-3
COUPLING = Coupling(1000, 1, 1, 1e-3)
SIZES = np.array([SMALLEST, LARGEST, SMALLEST, LARGEST, 1e-15, 1e15, 1e-3, 0.5, 1.0, 1e3])
SCHEMES = ("backward", "tustin")
INTEGRATORS = ("implicit", "semi_implicit", "explicit")
STEPS = ("explicit", "semi_implicit", "implicit", "midpoint")


class Draw:
    """Arguments from both ends of the range, and between."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def above(self) -> float:
        return float(self.rng.choice(SIZES))

    def least(self) -> float:
        return 0.0 if self.rng.random() < 0.2 else self.above()

    def maybe(self) -> float | None:
        return None if self.rng.random() < 0.3 else self.least() or 1.0

    def signed(self, *shape: int) -> Any:
        return self.rng.choice(SIZES, shape) * self.rng.choice([-1, 1], shape)

    def name(self, names: tuple[str, ...]) -> Any:
        return str(self.rng.choice(names))

    def delay(self) -> int:
        return int(self.rng.integers(0, 4))

    def coupling(self) -> Coupling:
        return Coupling(self.above(), self.least(), self.least(), self.least())

    def grid(self) -> p.CouplingGrid:
        return p.CouplingGrid([self.above(), self.above()], [self.least(), self.least()])

    def options(self) -> dict[str, Any]:
        return {
            "discretization": self.name(SCHEMES),
            "delay": self.delay(),
            "filter_time": self.least(),
        }

    def loop(self) -> p.SampledLoop:
        return p.SampledLoop(
            self.coupling(), self.above(), self.maybe(), self.name(INTEGRATORS), **self.options()
        )

    def body(self) -> m.ImpactBody:
        return m.ImpactBody(self.above(), self.above(), self.signed(2))


def spectrum(d: Draw) -> Any:
    period = d.above()
    return p.damping_spectrum(d.grid(), period, np.array([1e-3, 1]) * np.pi / period, **d.options())


def loop(d: Draw) -> Any:
    one = d.loop()
    worst = one.worst_frequency()
    hand = p.WorstHand(d.above(), worst, one.period, complex(one.response(worst)))
    one.simulate(hand, 30)
    return [*hand.recursion(), float(one.damping_spectrum(worst))]


def region(d: Draw) -> Any:
    z = p.z_width(
        d.above(), d.above(), mass=d.maybe(), friction=d.maybe(), resolution=d.least(),
        delay=d.delay(), filter_time=d.least(), points=5,
    )  # fmt: skip
    return np.concatenate([z.limit, z.damping, [z.corner.stiffness, z.corner.damping]])


def mechanism(d: Draw) -> Any:
    limit = p.quantization_limit(d.least(), d.least(), d.least(), d.coupling(), d.above())
    return [limit.stiffness, limit.beta, limit.sigma, limit.friction_needed]


def particle(d: Draw) -> Any:
    motion = m.integrate_particle(d.above(), d.signed(4), d.above(), d.name(STEPS))
    return np.concatenate([motion.position, motion.velocity, motion.energy_gain])


def driven(d: Draw) -> Any:
    scheme = d.name(("implicit", "compensated", "midpoint"))
    motion = m.drive_mass(d.coupling(), d.above(), d.signed(4), d.above(), scheme)
    return np.concatenate([motion.position, motion.velocity, motion.energy_gain])


def held(d: Draw) -> Any:
    motion = m.drive_mass(d.coupling(), d.above(), d.signed(4), d.above(), "held")
    assert motion.energy_gain.shape == (3,)  # it may have diverged
    return 0.0


def turned(d: Draw) -> Any:
    inertia = 2 * d.above() * np.array([1, 1, 0.5])
    motion = m.integrate_rotation(inertia, d.signed(3), d.above(), 4, d.name(STEPS))
    return np.concatenate([motion.kinetic_energy, motion.angular_momentum.ravel()])


def hit(d: Draw) -> Any:
    velocity = [float(d.signed()), -d.above()]
    law = d.name(("newton", "poisson", "stronge"))
    impact = m.resolve_impact(d.body(), velocity, d.least(), 0.5, law)
    return np.concatenate([impact.impulse, impact.velocity, [impact.energy_change]])


FUNCTIONS: dict[str, Callable[[Draw], Any]] = {
    "minimum damping": lambda d: p.minimum_damping(d.grid(), d.above(), **d.options()),
    "largest stiffness": lambda d: p.maximum_stiffness(d.above(), d.above(), d.least()),
    "default coupling": lambda d: p.stiffest_coupling(d.above(), d.above(), d.above()).stiffness,
    "free device": lambda d: p.free_device_stiffness(
        d.least(), d.above(), d.above(), d.least(), delay=d.delay(), filter_time=d.least()
    ),
    "free damping": lambda d: p.free_device_damping(d.least(), d.above(), d.above()),
    "quantization": mechanism,
    "spectrum": spectrum,
    "line": lambda d: p.transmission_line_stiffness(d.above(), d.above()),
    "mass": lambda d: p.environment_minimum_damping(
        d.grid(), d.above(), d.above(), d.name(INTEGRATORS)
    ),
    "least mass": lambda d: p.minimum_mass(d.grid(), d.above(), d.name(INTEGRATORS)),
    "worst frequency": lambda d: p.worst_frequency(d.grid(), d.above(), **d.options()),
    "loop": loop,
    "z-width": region,
    "alternatives": lambda d: [
        way.needed for way in alternatives(d.coupling(), d.above(), d.least())
    ],
    "particle": particle,
    "driven mass": driven,
    "held mass": held,
    "exact mass": lambda d: abs(m.exact_mass_response(d.coupling(), d.above(), d.above())),
    "rotation": turned,
    "impact": hit,
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_numbers_that_lie_far_apart_give_a_number_or_a_sentence(name: str) -> None:
    """Warnings are errors here; inf is a number, nan is none."""
    answered = 0
    for seed in range(60):
        try:
            result = np.asarray(FUNCTIONS[name](Draw(seed)), dtype=float)
        except HapticBridgeError as error:
            assert "\n" not in str(error)
        else:
            assert not np.isnan(result).any()
            answered += 1
    assert answered > 10


def test_limit_of_stability_is_searched_over_the_whole_range() -> None:
    for seed in range(12):
        limit = p.stability_limit(Draw(seed).loop())
        assert limit >= 0


@pytest.mark.parametrize("value", [1e300, -1e31, 1e-300])
def test_a_magnitude_out_of_range_is_refused_with_the_range(value: float) -> None:
    sentence = "(between 1e-30 and 1e\\+30|must be finite and > 0)"
    with pytest.raises(CouplingError, match=sentence):
        p.CouplingGrid([1.0, value])
    with pytest.raises(MechanicsError, match=sentence):
        m.ImpactBody(value, 1, [0, 0])
    with pytest.raises(CouplingError, match=sentence):
        p.maximum_stiffness(value, T)
    if value > 0:
        with pytest.raises(CouplingError, match="coupling stiffness is"):
            p.minimum_damping(Coupling(value, 0, 0, 0), T)
        with pytest.raises(MechanicsError, match="mass is"):
            m.drive_mass(COUPLING, value, [0, 1], T, "held")


def test_what_is_smaller_than_the_range_counts_as_zero_where_zero_is_valid() -> None:
    assert p.minimum_damping(Coupling(1000, 1e-310, 0, 0), T, discretization="tustin") == 0.5
    assert p.quantization_limit(1, 1e-320, 1e-315, COUPLING, T).sigma == np.inf
    with pytest.raises(CouplingError, match="it must be finite and >= 0"):
        p.CouplingGrid(1.0, -1e-310)


@pytest.mark.parametrize(
    "value",
    [
        True, [True, False], "1", None, [1, [2]], 1j, 10**400, 10**5000, object(),
        datetime.datetime(2000, 1, 1, tzinfo=datetime.UTC), np.datetime64("2000"),
        np.full((30, 30), "a"),
    ],
    ids=lambda value: type(value).__name__,
)  # fmt: skip
def test_what_is_no_number_is_refused_in_one_line(value: Any) -> None:
    for call in (
        lambda: p.CouplingGrid(value),
        lambda: p.maximum_stiffness(value, T),
        lambda: m.ImpactBody(value, 1, [0, 0]),
    ):
        with pytest.raises(HapticBridgeError, match="must be numbers") as refused:
            call()
        assert "\n" not in str(refused.value)
        assert len(str(refused.value)) < 160


@pytest.mark.parametrize("value", [None, 3.0, {}, SimpleNamespace(stiffness=1, damping=1)])
def test_what_is_no_coupling_hand_or_body_is_refused(value: Any) -> None:
    for call in (
        lambda: p.minimum_damping(value, T),
        lambda: p.damping_spectrum(value, T, 1.0),
        lambda: p.environment_minimum_damping(value, T, 1),
        lambda: p.SampledLoop(value, T),
        lambda: m.drive_mass(value, 1, [0, 1], T, "held"),
        lambda: m.exact_mass_response(value, 1, 1),
        lambda: p.quantization_limit(1, 1, 1, value, T),
    ):
        with pytest.raises(HapticBridgeError, match=r"coupling is .*; it must be"):
            call()
    with pytest.raises(MechanicsError, match="body is"):
        m.resolve_impact(value, [0, -1], 0, 0)
    if value is not None:
        with pytest.raises(CouplingError, match="hand is"):
            p.SampledLoop(COUPLING, T).simulate(value, 10)


@pytest.mark.parametrize("name", ["forward", None, [], {}, ["backward"], np.array(["tustin"]), 1])
def test_what_is_no_name_is_refused_with_the_names(name: Any) -> None:
    for call in (
        lambda: p.minimum_damping(COUPLING, T, discretization=name),
        lambda: p.damping_spectrum(COUPLING, T, 1.0, discretization=name),
        lambda: p.worst_frequency(COUPLING, T, discretization=name),
        lambda: p.minimum_mass(COUPLING, T, name),
        lambda: p.SampledLoop(COUPLING, T, discretization=name),
        lambda: p.transmission_line_spectrum(1, T, 1.0, terminated_by=name),
        lambda: m.integrate_particle(1, [0, 1], T, name),
        lambda: m.resolve_impact(m.ImpactBody(1, 1, [0, 0]), [0, -1], 0, 0, name),
    ):
        with pytest.raises(HapticBridgeError, match="choose one of '"):
            call()


@pytest.mark.parametrize(
    ("answer", "sentence"),
    [
        (None, "must return numbers"),
        ("a", "must return numbers"),
        ([[1], [1, 2]], "must return numbers"),
        (np.nan, "not finite"),
        (np.inf, "not finite"),
        (np.ones(7), r"returned shape \(7,\)"),
    ],
)
def test_a_transfer_function_that_returns_rubbish_is_refused(answer: Any, sentence: str) -> None:
    with pytest.raises(CouplingError, match=sentence):
        p.damping_spectrum_of(lambda _: answer, T, [1.0, 2.0])
    with pytest.raises(CouplingError, match="must be a callable of z"):
        p.damping_spectrum_of(3, T, [1.0])  # type: ignore[arg-type]


def test_an_undamped_mass_at_its_resonance_answers_without_limit() -> None:
    undamped = Coupling((2 * np.pi) ** 2, 0, 0, 0)
    response = m.exact_mass_response(undamped, 1.0, [0.5, 1.0])
    assert response[0] == pytest.approx(4 / 3)
    assert np.isinf(response[1])

"""Summary of a run."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.coupling import Coupling
from hapticbridge.demand.certificate import condition_sentences
from hapticbridge.demand.certification import (
    Certification,
    Standing,
    certification_of,
    worst_certification,
)
from hapticbridge.demand.loop_setting import fresh_share
from hapticbridge.demand.methods import Method, RunCoupling, default_method, method_named
from hapticbridge.demand.own_loop import OwnLoopAccount
from hapticbridge.demand.probe import Direction, Probed
from hapticbridge.demand.pulse import balance_words
from hapticbridge.demand.timekeeping import RunTimes, Timekeeping
from hapticbridge.demand.trip import Trip
from hapticbridge.device import DeviceInfo
from hapticbridge.kernel.codes import Grip, Scheme, coupling_ids, held_body
from hapticbridge.kernel.hand_energy import INSTANT, HandEnergy
from hapticbridge.kernel.lossless import spring_at_the_end, tree_of_tool
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.record import TickFlag
from hapticbridge.units import (
    energy_rows,
    facts_html,
    format_energy,
    format_share,
    format_si,
    format_wrenches,
)

# Sentences on the effective coupling and its law


def is_always_implicit(model: mujoco.MjModel, grip: str) -> bool:
    """Returns True if a lossless coupling stays implicit because the tool is never free.

    References:
        ``kernel.lossless.ToolTree.is_never_free`` lists the causes.
    """
    return tree_of_tool(model, held_body(model, grip), coupling_ids(model)).is_never_free


def coarse_spring(model: mujoco.MjModel, grip: str, method: Method) -> str:
    """Returns the spring that makes a lossless coupling first order; empty if none does."""
    if method.scheme != Scheme.MIDPOINT:
        return ""
    tree = tree_of_tool(model, held_body(model, grip), coupling_ids(model))
    return "" if tree.is_never_free else spring_at_the_end(model, tree)


def was_never_lossless(count: int, flags: int) -> bool:
    """Returns True if no record was lossless, by the number of records and their combined flags."""
    return count > 0 and not flags & int(TickFlag.MIDPOINT)


# Energies metered by the kernel, and the environment's verdict

Environment = Literal["strict", "within slack", "active"]


@dataclass(frozen=True, slots=True)
class Ledger:
    """Energies of a run in J; all but the storage are cumulative since its start.

    E_k = S_k − S_{k−1} − (works of all ports in tick k). The environment has released no more
    energy than it received while Σ E_k <= 0, eq. (14) of Brown & Colgate (1997). The device stays
    safe while Σ E_k stays below the slack, Σ ½ (K + B'/T) ‖δx_k‖² and its rotational counterpart,
    both over the ticks below the force level.

    Attributes:
        kinetic: Present kinetic energy.
        potential: Present potential energy of gravity, its compensation, and springs.
        coupling_work: Work of the coupling on the tool, Σ f_k·δx_k + τ_k·δφ_k.
        actuator_work: Work of the scene's own actuators.
        external_work: Work of applied forces, moved mocap bodies, moving surfaces and resets.
        environment_energy: Σ E_k: energy created (> 0) or dissipated (< 0) by the simulation.
        device_energy: Energy given to the device by the wrenches sent.
        slack: Bound of Σ E_k up to which the guarantee holds.
        slack_share: Largest share of the slack used so far; 0 if always strict.
        first_unstrict: First tick at which (14) did not hold, or None.
        first_active: First tick at which the slack was exceeded, or None.
        first_device_excess: First tick at which a device without a coupling law had received more
            than its damping dissipates and the scene released, or None.
    """

    kinetic: float
    potential: float
    coupling_work: float
    actuator_work: float
    external_work: float
    environment_energy: float
    device_energy: float
    slack: float
    slack_share: float
    first_unstrict: int | None
    first_active: int | None
    first_device_excess: int | None

    @classmethod
    def from_state(cls, state: NDArray[np.void]) -> Ledger:
        """Reads the ledger from the kernel's state (``STATE_DTYPE``, one element)."""
        energy = state["energy"][0]
        values = {name: float(energy[name]) for name in (*_ENERGIES, _SHARE)}
        ticks = [int(energy[name]) for name in _TICKS]
        unstrict, active, kick = (tick if tick >= 0 else None for tick in ticks)
        return cls(**values, first_unstrict=unstrict, first_active=active, first_device_excess=kick)

    @property
    def environment(self) -> Environment:
        """``strict`` if (14) always held, ``within slack`` or ``active``."""
        if self.first_active is not None:
            return "active"
        return "strict" if self.first_unstrict is None else "within slack"

    @property
    def fault(self) -> tuple[int, str] | None:
        """Tick and port of the first fault, ``environment`` or ``device``; None if passive."""
        faults = ((self.first_active, "environment"), (self.first_device_excess, "device"))
        found = [(tick, port) for tick, port in faults if tick is not None]
        return min(found) if found else None

    def energies(self) -> dict[str, float]:
        """Returns the energies by name, in J."""
        return {name: value for name, value in asdict(self).items() if name in _ENERGIES}


_TICKS = ("first_unstrict", "first_active", "first_device_excess")
_SHARE = "slack_share"
_ENERGIES = tuple(each.name for each in fields(Ledger) if each.name not in (*_TICKS, _SHARE))


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOutcome:
    """Counters of the loop, and the end of a run.

    Attributes:
        ticks: Ticks since the bridge was opened.
        overruns: Ticks that started a period or more after their deadline.
        skipped: Skipped deadlines.
        dropped: Records lost because the recorder was too far behind.
        stopped_by: ``duration``, ``signal``, ``trip``, ``caller``, or another caller of
            ``Bridge.stop``.
        recording: The recording, or None.
        is_realtime: True if real time was requested from the system.
        start_potential: Potential energy in J before the first tick.
        trip: Stop by the guard; None without one.
        probed: Result of the probe of the hand's device; None without one.
        own_loop: Account of a loop of the device's own; None without one.
        overlap: Pairs of the scene that began inside each other and still are; empty without any.
        driver: What the hand's driver lost (``device_remark``), as a clause; empty for nothing.
        changed: Clause on fields of the model that a program changed meanwhile; empty without any.
    """

    ticks: int
    overruns: int
    skipped: int
    dropped: int
    stopped_by: str
    recording: Path | None
    is_realtime: bool
    start_potential: float
    trip: Trip | None = None
    probed: Probed | None = None
    own_loop: OwnLoopAccount | None = None
    overlap: str = ""
    driver: str = ""
    changed: str = ""

    def added_delay(self, info: DeviceInfo, period: float) -> float:
        """Returns the delay in s that the probe found beyond the stated one."""
        return self.probed.added_delay(info, period) if self.probed else 0.0


_UNJUDGED = {
    "empty": "the run ended before its first tick, so there is nothing to judge",
    "unverified": "MuJoCo could not simulate the scene to the end",
}
"""Reasons of a verdict that is neither ``passive`` nor ``active``."""


def posted_words(credit: float) -> str:
    """Returns what is known of a run in which another program steps the scene."""
    return (
        "another program stepped the scene; whatever it showed, the hand got at most what it put "
        f"in plus {format_energy(credit)}, where the device meets its condition"
    )


WELD = "the weld in its stiffest directions at the start"
"""Words for what the stiffness and damping of a run without a coupling law are those of."""

_NAME_WIDTH = 20
"""Characters of a row's name in the text of a summary, with the space after it."""

_STORAGE = "scene's storage"
"""Row of the text on the energy that the scene has given to a hand."""

_OF_A_HAND = (
    "probe",
    "driver",
    "silence",
    "peak",
    "reach",
    "scales",
    "coupling work",
    "device energy",
    "net to the hand",
    _STORAGE,
    "slack",
)
"""Rows of the text of a summary that each of several hands has of its own."""

_PEAKS = ("peak_force", "peak_torque", "peak_tool_force", "peak_tool_torque")


@dataclass(frozen=True, slots=True)
class Summary:
    """Summary of a run.

    Attributes:
        ticks: Ticks since the bridge was opened.
        duration: Time of the run's clock in s: a period for each tick and each skipped deadline.
        overruns: Ticks that started a period or more after their deadline.
        skipped: Skipped deadlines.
        dropped: Records lost because the recorder was too far behind.
        peak_force: Largest norm of the force on the hand in N; without a hand, as a prescribed
            motion has none, of the force that would be on it.
        peak_torque: Largest norm of the torque on the hand in N m.
        peak_tool_force: Largest norm of the force on the tool in N. It differs from that on the
            hand by ``force_scale``, and while the force rises or fades.
        peak_tool_torque: Largest norm of the torque on the tool in N m.
        limits_reached: Which of ``force`` and ``torque`` on the tool reached its limit.
        energies: Energies by name in J.
        environment: ``strict``, ``within slack`` or ``active``.
        slack_share: Largest share of the slack that was used.
        method: Name of the rendering method.
        about: Description of the method in a sentence.
        hazard: Hazard on a real device beyond the device condition, in a sentence; empty without
            one.
        coupling: Requested, law and effective coupling. For a weld the effective one is that of its
            stiffest axes, measured at the start.
        fault: Tick and port (``environment`` or ``device``) of the first fault, or None. A device
            that does not meet its condition behind a coupling law is judged by the audit alone.
        conditions: Device conditions, as sentences.
        certification: Verdict on the device, by its conditions and by what the run was; of several
            hands, of the worst.
        stopped_by: ``duration``, ``signal``, ``trip``, ``caller``, or another caller of
            ``Bridge.stop``.
        recording: The recording, or None.
        reach: Distance in m of the device from the origin of its frame beyond which it moved
            without handle and force; None without such a limit.
        has_hand: True if the device gives its force to a hand; a prescribed motion does not.
        start_potential: Potential energy in J before the first tick; its zero is arbitrary.
        credit: Energy in J that another program's scene may give to the hand; 0 for another scene.
        grip: Name of the grip that the hand holds.
        device: Name of the device.
        pulses: Energy in J that blows paid for pulses, work in J of the pulses, and the flags that
            ended any early; None without.
        trip: Stop by the guard; None without one.
        probe: Result of the probe of the device before the run, as a clause; empty without one.
        overlap: Pairs of the scene that began inside each other and still are; empty without any.
        driver: What the driver lost of frames and forces, as a clause; empty for nothing.
        changed: Clause on fields of the model that a program changed meanwhile; empty without any.
        hands: Summary of each hand by itself, if several hold the scene. Fault, share of the slack
            and certification of the whole are then those of all of them.
    """

    ticks: int
    duration: float
    overruns: int
    skipped: int
    dropped: int
    peak_force: float
    peak_torque: float
    peak_tool_force: float
    peak_tool_torque: float
    limits_reached: tuple[str, ...]
    energies: dict[str, float]
    environment: str
    slack_share: float
    method: str
    about: str
    hazard: str
    coupling: RunCoupling
    fault: tuple[int, str] | None
    conditions: tuple[str, ...]
    certification: Certification
    stopped_by: str
    recording: Path | None
    reach: float | None
    has_hand: bool
    start_potential: float = 0.0
    credit: float = 0.0
    grip: str = ""
    device: str = ""
    pulses: tuple[float, float, int] | None = None
    trip: Trip | None = None
    probe: str = ""
    overlap: str = ""
    driver: str = ""
    changed: str = ""
    hands: tuple[Summary, ...] = ()

    def at_record(self, record: np.void) -> Summary:
        """Returns the summary with the energies of a tick's record."""
        names = record.dtype.names or ()
        energies = {name: float(record[name]) for name in self.energies if name in names}
        return replace(self, energies=self.energies | energies)

    @staticmethod
    def of_hands(hands: tuple[Summary, ...]) -> Summary:
        """Returns the summary of a run of several hands; the rest is that of the first."""
        faults = [each.fault for each in hands if each.fault is not None]
        return replace(
            hands[0],
            hands=hands,
            fault=min(faults, default=None),
            slack_share=max(each.slack_share for each in hands),
            certification=worst_certification([each.certification for each in hands]),
        )

    def to_dict(self) -> dict[str, Any]:
        """Returns all fields by name, with the verdict; ``hands`` only where there are several."""
        values = self._values()
        for each in values["hands"]:  # the file is that of all hands
            del each["hands"], each["recording"]
        if not self.hands:
            del values["hands"], values["grip"], values["device"]
        return values

    def _values(self) -> dict[str, Any]:
        values = asdict(self) | {"verdict": self.verdict, "max_net_energy": self.max_net_energy}
        values["hands"] = [each._values() for each in self.hands]
        del values["certification"]
        return values | {"is_certified": self.is_certified} | self.certification.to_dict()

    def __str__(self) -> str:
        """Describes the run: energies, verdict, coupling, device condition and the next command."""
        return "\n".join(self._lines())

    def _repr_html_(self) -> str:
        """Returns the text as HTML, for a notebook."""
        headline, *lines = self._lines()
        names = () if self.hands else tuple(self._rows())
        return facts_html(headline, names, lines[len(names) :])

    @property
    def headline(self) -> str:
        """The verdict on the run and on its device, in a sentence."""
        if self.verdict not in ("passive", "active"):
            is_changed = self.ticks and self.changed
            reason = f"{self.changed}: no recording can repeat that"
            return f"{self.verdict}: {reason if is_changed else _UNJUDGED[self.verdict]}"
        if self.fault is not None:
            _, port = self.fault
            what = "the hand got energy for which nothing paid"
            return f"active: {'the simulation made energy' if port == 'environment' else what}"
        if self.certification.standing is Standing.NO_HAND:
            return "passive: the scene gave out no more energy than it got"
        if self.is_certified:
            if not method_named(self.method).has_guarantee:
                return f"passive this time; method {self.method} guarantees no other hand anything"
            more = f", and {format_energy(self.credit)}" if self.credit else ""
            more += self.certification.provisos
            more += ", apart from what motors and inputs gave" if self.hand_energy.limit else ""
            times = f"{self.hand_energy.times} what " if self.hand_energy.times else ""
            get, device = "no hand gets more than it puts in", "device"
            if self.hands:
                get, device = "hands together get no more than they put in", "devices"
            return (
                f"passive, and certified: on the {device} as stated {get} or {times}the scene had "
                f"stored{more}"
            )
        judged = "not certified" if self.is_certified is False else "not judged"
        return f"the scene was passive, the device is {judged}: a hand may get energy out of it"

    def _lines(self) -> Iterator[str]:
        yield self.headline
        if self.hands:
            yield from self._lines_of_hands()
            return
        for name, text in self._rows():
            yield f"{name:<{_NAME_WIDTH}}{text}"
        yield from self._verdict_lines()
        yield from self._coupling_lines()
        yield from self._device_lines()
        yield from self._last_lines()

    def _lines_of_hands(self) -> Iterator[str]:
        """Yields what all hands share, then what each has of its own."""
        for name, text in self._rows():
            if name not in _OF_A_HAND:
                yield f"{name:<{_NAME_WIDTH}}{text}"
        yield from self._verdict_lines()
        for each in self.hands:
            yield f"hand at '{each.grip}' on {each.device}:"
            for name, text in each._rows():
                is_got = name == "device energy" and each.energies["device_energy"] > INSTANT
                origin = ", put in by other hands" if is_got and not each.max_net_energy else ""
                shown = "scene and hands" if name == _STORAGE else name
                if name in _OF_A_HAND:
                    yield f"  {shown:<{_NAME_WIDTH - 2}}{text}{origin}"
            yield from (f"  {line}" for line in (*each._coupling_lines(), *each._device_lines()))
        yield from self._last_lines()

    def _verdict_lines(self) -> Iterator[str]:
        if self.verdict == "empty" or self.changed:
            return
        tick, port = self.fault or (0, "")
        used = f"at its worst tick {format_share(self.slack_share)} of the slack used"
        used = f", {used}" if self.slack_share else ""
        since = f", from tick {tick} on" if port else ""
        judged = "" if port else "environment "  # the device has a line of its own
        until = ", then the guard stopped the run" if self.trip else ""
        if self.credit and not port:
            yield f"{self.verdict}{until}: {posted_words(self.credit)}"
            return
        yield f"{judged}{self.verdict} ({port or self.environment}){until}{since}{used}"
        if self.method != default_method().name:
            yield f"method {self.method}: {self.about}"

    def _coupling_lines(self) -> Iterator[str]:
        sentences = self.coupling.sentences()
        if self.coupling.law is not None:
            yield sentences[0]
        else:
            of = f": {WELD}" if self.coupling.effective else ""
            yield from (f"{sentence}{of}" for sentence in sentences)

    def _last_lines(self) -> Iterator[str]:
        if hint := self.timekeeping.hint:
            yield hint
        if self.recording is not None:
            yield f"next: hapticbridge audit {shlex.quote(str(self.recording))}"

    def _rows(self) -> Iterator[tuple[str, str]]:
        """Yields name and text of what was counted and measured."""
        yield "ran", f"{self.duration:.3f} s, {self.ticks} ticks ({self.stopped_by})"
        skipped = f" ({self.skipped} deadlines skipped)" if self.skipped else ""
        if self.overlap:
            yield "overlap", f"{self.overlap} still; the scene began so"
        yield "overruns", f"{self.overruns}{skipped}, records dropped {self.dropped}"
        if self.probe:
            yield "probe", self.probe
        if self.driver:
            yield "driver", self.driver
        if own_loop := self.certification.own_loop:
            yield "device's loop", own_loop.words
        if remark := self.timekeeping.remark:
            yield "time kept", remark
        if silence := self.timekeeping.silence:
            yield "silence", silence.sentence
        hand = self.peak_force, self.peak_torque
        tool = self.peak_tool_force, self.peak_tool_torque
        reached = " and ".join(f"{name} limit" for name in self.limits_reached)
        reached = f" ({reached} reached)" if reached else ""
        peak = format_wrenches(hand if self.has_hand else None, tool)
        if Grip.from_text(self.grip).is_joint:
            peak = f"{format_si(self.peak_force, 'N')} on the fingers"
        yield "peak", peak + reached
        if self.pulses is not None:
            yield "pulses", balance_words(*self.pulses)
        if self.reach is not None:
            yield "reach", f"{format_si(self.reach, 'm')}; beyond, no handle and no force"
        yield from self._energy_rows()

    def _energy_rows(self) -> Iterator[tuple[str, str]]:
        if scales := self.hand_energy.scales:
            yield "scales", scales
        for name, text in energy_rows(self.energies, self.start_potential, self.credit):
            remark = ", what the program may still give to the hand" if name == "tank" else ""
            if name == "device energy" and not self.has_hand:
                remark = ", of forces that were not felt"
            yield name, text + remark
        so_far = "with the tick that tripped, " if self.trip else ""  # the record is without it
        if self.max_net_energy > INSTANT:
            yield "net to the hand", so_far + self.hand_energy.sentence
        elif not self.credit and (release := self.hand_energy.release):
            yield _STORAGE, release
        if blur := self.hand_energy.blur:
            yield "encoder steps", so_far + blur

    @property
    def max_net_energy(self) -> float:
        """Largest net energy to the hand in J (``HandEnergy.net``)."""
        return max((each.hand_energy.net for each in self.hands), default=self.hand_energy.net)

    def _device_lines(self) -> Iterator[str]:
        """Yields if the device bears the coupling at the time that the run kept."""
        certification = self.certification
        if certification.is_by_time:
            yield f"device not certified: {certification.reason}"
            return
        yield certification.words
        if certification.verdict or certification.standing is Standing.NO_HAND:
            return
        yield from self.conditions
        if method_named(self.method).has_law:
            yield "only --energy-limit bounds what the hand gets"

    @property
    def is_certified(self) -> bool | None:
        """True if the device bears the coupling as the run was; None if that is unknown."""
        return self.certification.verdict

    @property
    def timekeeping(self) -> Timekeeping:
        """Time that the run kept, and the device conditions at this time."""
        return self.certification.kept

    @property
    def hand_energy(self) -> HandEnergy:
        """Energy that the hand got and what paid for it; of several, of the one that decides."""
        return self.certification.energy

    @property
    def verdict(self) -> str:
        """``passive`` (strict or within slack, without a metered kick), or ``active``.

        It is ``unverified`` if a program changed the scene other than by an input, MuJoCo dropped
        contacts or its numbers were bad, and ``empty`` if the run held no tick.
        """
        if not self.ticks:
            return "empty"
        if self.changed:
            return "unverified"
        if self.fault is not None:
            return "active"
        return "unverified" if self.trip and self.trip.is_unsound else "passive"

    @classmethod
    def from_state(
        cls,
        state: NDArray[np.void],
        parameters: RunParameters,
        info: DeviceInfo,
        method: Method,
        requested: Coupling,
        outcome: RunOutcome,
    ) -> Summary:
        """Builds the summary of a run from the kernel's state and the loop's counters."""
        ledger = Ledger.from_state(state)
        timing = state["timing"][0]
        due, new = outcome.ticks + outcome.skipped, int(state["guard"]["fresh"][0])
        times = RunTimes(
            ticks=outcome.ticks,
            fresh=fresh_share(info, parameters.period, new, due),
            new_samples=new,
            due=due,
            mean_delay=float(timing["delays"]) / max(outcome.ticks, 1)
            + outcome.added_delay(info, parameters.period),
            mean_jitter=float(timing["jitter"]) / max(outcome.ticks, 1),
            delay_energy=float(timing["max_uncovered"]),
            is_realtime=outcome.is_realtime,
            flags=int(state["watch"]["flags"][0]),
            has_tripped=outcome.trip is not None,
            scene_steps=int(state["shown"]["scene_step"][0]),
            scene_silence=parameters.period * int(state["shown"]["longest_silence"][0]),
            silence=float(state["guard"]["longest_silence"][0]),
            silent_tick=int(state["guard"]["silent_tick"][0]),
            unanswered=outcome.probed.axes(Direction.UNKNOWN) if outcome.probed else "",
            has_created=ledger.first_unstrict is not None,
        )
        peaks: dict[str, Any] = {name: float(state["loop"][name][0]) for name in _PEAKS}
        hand = HandEnergy() if info.is_prescribed else hand_energy(state, parameters)
        certification = certification_of(info, parameters, method, times, hand, outcome.own_loop)
        return cls(
            ticks=outcome.ticks,
            duration=(outcome.ticks + outcome.skipped) * parameters.period,
            overruns=outcome.overruns,
            skipped=outcome.skipped,
            dropped=outcome.dropped,
            **peaks,
            limits_reached=tuple(
                kind
                for kind, limit in zip(("force", "torque"), state["level"]["level"][0], strict=True)
                if state["loop"][f"peak_tool_{kind}"][0] >= limit * (1.0 - 1e-9)
            ),
            energies=ledger.energies(),
            environment=ledger.environment,
            slack_share=ledger.slack_share,
            method=method.name,
            about=method.about,
            hazard=method.hazard,
            coupling=RunCoupling.of_run(
                method,
                requested,
                parameters,
                was_never_lossless=outcome.ticks > 0 and not state["lossless"]["ticks"][0],
            ),
            fault=_fault(ledger, state, certification),
            conditions=condition_sentences(info, parameters, method),
            certification=certification,
            stopped_by=outcome.stopped_by,
            recording=outcome.recording,
            reach=parameters.guarding.reach if parameters.guarding.reach < math.inf else None,
            has_hand=not info.is_prescribed,
            start_potential=outcome.start_potential,
            credit=parameters.credit,
            trip=outcome.trip,
            probe=outcome.probed.words if outcome.probed else "",
            overlap=outcome.overlap,
            driver=outcome.driver,
            changed=outcome.changed,
            grip=parameters.grip,
            device=info.name,
            pulses=(
                parameters.force_scale / parameters.scale * float(state["impact"]["taken"][0]),
                float(state["impact"]["work"][0]),
                int(state["impact"]["ended_by"][0]),
            )
            if parameters.impact_pulses
            else None,
        )


def _fault(
    ledger: Ledger, state: NDArray[np.void], certification: Certification
) -> tuple[int, str] | None:
    """Returns the ledger's first fault, or unpaid energy of a device that meets its condition."""
    unpaid = int(state["observer"]["first_unpaid"][0])
    if unpaid < 0 or not certification.is_borne:
        return ledger.fault
    return min((unpaid, "device"), ledger.fault or (unpaid, "device"))


def hand_energy(state: NDArray[np.void], parameters: RunParameters) -> HandEnergy:
    """Reads the energy of a hand from the kernel's state."""
    observer = state["observer"][0]
    return HandEnergy(
        net=float(observer["max_guarded_energy"]),
        hidden=float(observer["hidden_energy"]),
        unpaid=float(observer["max_unpaid_energy"]),
        springs=float(observer["springs"]),
        scene=float(observer["released"]),
        motors=float(observer["peak_motor_work"]),
        inputs=float(observer["peak_input_work"]),
        gross=float(observer["max_hand_energy"]),
        ratio=parameters.energy_ratio,
    )

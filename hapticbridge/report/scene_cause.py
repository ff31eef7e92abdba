"""Likely cause of energy that a scene created, by rules on the run simulated again."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.audit import AuditReport
from hapticbridge.audit.events import AuditedRun
from hapticbridge.audit.motion import turn_between
from hapticbridge.audit.replay import Agreement, Resimulator
from hapticbridge.demand.methods import Method
from hapticbridge.errors import RecordingError
from hapticbridge.kernel.elastic import unstored_energy
from hapticbridge.recording import Recording
from hapticbridge.recording.reader import BLOCK
from hapticbridge.report.cause import MOST, SAFE_METHOD, WINDOW, Cause, method_cause
from hapticbridge.report.evidence import Evidence
from hapticbridge.scene.checks import Pump, may_move, pump_powers, unmetered_work
from hapticbridge.scene.contacts import Concern, check_contacts, geom_name, set_as_suggested
from hapticbridge.scene.handle import constraint_rows, mocap_of
from hapticbridge.scene.physics import (
    STEADY_WAY,
    TendonWatch,
    jump_behind,
    storing_flex,
    unstored_words,
)
from hapticbridge.scene.scene import iteration_limit
from hapticbridge.scene.start import constraint_name
from hapticbridge.units import format_count, format_energy, format_number

REPEATED = (Agreement.EXACT, Agreement.NEAR)
"""Agreements of a run whose motion can be simulated again."""

FAST_TURN = 0.02
"""Rotation of a body in rad per tick above which its gyroscopic torque is suspected. At 1 kHz, 50
rad/s created 0.05 J in a second under a coupling of translation alone (measured). A smaller value
suspects hands, which turn at 10 rad/s; a larger one misses such cases."""


def cause_in_environment(evidence: Evidence, report: AuditReport, window: slice) -> Cause:
    """Returns the likely cause of energy created in the environment in a window of ticks.

    The records and the scene's settings tell it if the run cannot be simulated again.
    """
    if evidence.model is not None and report.agreement in REPEATED:
        with suppress(RecordingError):
            return _Search(evidence, evidence.model, report, window).cause()
    share, where = _share_in_contact(evidence, window)
    if share < MOST:
        return _cause_without_contact(evidence, window, where)
    concerns = [] if evidence.parameters.is_rigid else _concerns(evidence, None)[:1]
    return _concern_cause(concerns, where) or Cause(
        "unknown",
        f"{where}; which of them did it shows where the run is simulated again",
        "audit it with the versions that recorded it",
    )


def _gained(evidence: Evidence, window: slice) -> NDArray[np.float64]:
    """Returns the energy in J that was created in each tick of a window, (n,), without losses."""
    return np.asarray(np.diff(evidence.created, prepend=0.0)[window].clip(min=0.0))


def _share_in_contact(evidence: Evidence, window: slice) -> tuple[float, str]:
    """Returns the share of the energy that was created in ticks with contact, and in words."""
    gained = _gained(evidence, window)
    touches = (evidence.ticks["contacts"] > 0)[window]
    share = float(gained[touches].sum() / gained.sum()) if gained.sum() > 0 else 0.0
    return share, f"{share:.0%} of the energy created until then came in ticks with contact"


def _concerns(evidence: Evidence, pairs: Collection[frozenset[int]] | None) -> list[Concern]:
    """Returns concerns about the contacts that touched; about all contacts if unknown."""
    if evidence.model is None:
        return []
    return check_contacts(evidence.model, evidence.parameters.grip, only=pairs)


def _concern_cause(concerns: Sequence[Concern], where: str) -> Cause | None:
    if not concerns:
        return None
    changes = "; ".join(dict.fromkeys(each.change for each in concerns))
    return Cause("contact setting", f"{where}; {concerns[0].words}", f"write {changes}")


def _cause_without_contact(
    evidence: Evidence,
    window: slice,
    where: str,
    faster_body: Callable[[float], tuple[str, float] | None] = lambda _: None,
) -> Cause:
    method, turned = evidence.method, _largest_turn(evidence, window)
    if method.hazard:
        return method_cause(method, f"{where}; ")
    body = faster_body(max(2.0 * turned, FAST_TURN))
    what, turned = body or ("the tool", turned)
    if turned > FAST_TURN:
        return Cause(
            "rate",
            f"{where}; {what} turned by up to {format_number(turned, 2)} rad a tick "
            f"({format_number(turned / evidence.parameters.period, 3)} rad/s), and MuJoCo "
            "takes forces of such a motion from the start of a step, which may create it",
            f"raise the rate, or turn {what} slower",
        )
    return Cause(
        "unknown",
        f"{where}; method '{method.name}' is not known to create energy without contact",
        "look for a joint or motor that pumps with 'hapticbridge check SCENE', or try a higher "
        "rate with 'hapticbridge audit FILE --what-if rate=…'",
    )


def _largest_turn(evidence: Evidence, window: slice) -> float:
    """Returns the tool's largest rotation in one tick, in rad."""
    quaternion = evidence.ticks["tool_quaternion"][max(window.start - 1, 0) : window.stop + 1]
    return float(
        np.linalg.norm(turn_between(quaternion[:-1], quaternion[1:]), axis=1).max(initial=0.0)
    )


def _rigid_change(method: Method) -> str:
    """Returns the change of a run with the scene's contacts that makes them rigid."""
    return "leave out --contact scene" if method.can_be_rigid else SAFE_METHOD


# Ticks of a run, simulated again

Part = TypeVar("Part")


@dataclass(frozen=True, slots=True)
class RepeatedRun:
    """Ticks of a run, simulated again.

    Attributes:
        recording: The run.
        model: Its scene.
        window: The ticks.
    """

    recording: Recording
    model: mujoco.MjModel
    window: slice

    def until_start(self, events: list[dict[str, Any]] | None = None) -> Resimulator:
        """Returns the run at the start of the window, with other events in place of its own.

        Raises:
            RecordingError: It cannot be simulated.
        """
        recording, end = self.recording, self.window.start
        if events is not None:
            recording = replace(recording, events=events)
        run = Resimulator(recording, AuditedRun.of(recording).parameters)
        for begin in range(0, end, BLOCK):
            run.add(recording.ticks[begin : min(begin + BLOCK, end)])
        return run

    def __iter__(self) -> Iterator[Resimulator]:
        """Yields the run after each tick of the window; raises as ``until_start``."""
        run = self.until_start()
        for tick in range(self.window.start, self.window.stop):
            run.add(self.recording.ticks[tick : tick + 1])
            yield run

    def works(self, powers: Callable[[mujoco.MjData], dict[Part, float]]) -> dict[Part, float]:
        """Returns the work in J of each part of the scene, by its power in W in each tick.

        It is empty if there is no such part. Raises as ``until_start``.
        """
        works = defaultdict[Part, float](float)
        if not powers(mujoco.MjData(self.model)):
            return {}
        period = AuditedRun.of(self.recording).parameters.period
        for run in self:
            for part, power in powers(run.data).items():
                works[part] += period * power
        return works

    def hardest_pump(self, grips: Sequence[str] = ()) -> tuple[Pump | None, float]:
        """Returns the pump that did most work, and this work in J; raises as ``until_start``.

        Only those count that might move the tools of ``grips`` then; all of them if it is empty.
        """
        powers = pump_powers(self.model)

        def given(data: mujoco.MjData) -> dict[Pump, float]:
            met = data.contact.geom.tolist()
            return {
                pump: power if may_move(pump, data, grips, met) else 0.0  # it may be infinite
                for pump, power in powers(data).items()
            }

        works = self.works(given)
        pump = max(works, key=lambda each: works[each], default=None)
        return pump, 0.0 if pump is None else works[pump]


def pump_cause(pump: Pump, work: float, where: str) -> Cause:
    """Returns a pump as the cause, by its work in J."""
    did = f"it did {format_energy(work)} of work in the {WINDOW:g} s before"
    return Cause("pump", f"{pump.words}; {did}; {where}", f"write {pump.change}")


# Powers of what a scene does


def _unmetered_powers(names: Iterable[str], data: mujoco.MjData) -> dict[str, float]:
    """Returns the powers in W of what no port meters, by the names of ``unmetered_work``."""
    told = data.qfrc_spring + data.qfrc_damper + data.qfrc_gravcomp
    told += data.qfrc_fluid + data.qfrc_adhesion
    forces = {
        "wind": data.qfrc_fluid,
        "adhesion": data.qfrc_adhesion,
        "plugin": data.qfrc_passive - told,
    }
    return {name: float(forces[name] @ data.qvel) for name in names}


def _constraint_powers(data: mujoco.MjData) -> dict[str, float]:
    """Returns the powers in W of equalities, dry friction and limits, by their names.

    They are f·(J q̇), with the forces f and rows J of a step and the mean q̇ of its speeds.
    """
    powers, found = _row_powers(data), {"": 0.0}
    for row in np.flatnonzero(~_is_contact(data)).tolist():
        name = constraint_name(data.model, data, row)
        found[name] = found.get(name, 0.0) + float(powers[row])
    return found


def _contact_powers(data: mujoco.MjData) -> dict[frozenset[int], float]:
    """Returns the powers in W of contacts by their geoms, as ``_constraint_powers``."""
    powers, found = _row_powers(data), {frozenset[int](): 0.0}
    for row in np.flatnonzero(_is_contact(data)).tolist():
        pair = frozenset(data.contact.geom[data.efc_id[row]].tolist())
        found[pair] = found.get(pair, 0.0) + float(powers[row])
    return found


def _row_powers(data: mujoco.MjData) -> NDArray[np.float64]:
    speeds = data.qvel - 0.5 * data.model.opt.timestep * data.qacc
    return np.asarray(data.efc_force * (constraint_rows(data) @ speeds))


def _is_contact(data: mujoco.MjData) -> NDArray[np.bool_]:
    first = mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS.value
    return np.asarray(data.efc_type >= first)


def _iterate(model: mujoco.MjModel, limit: int) -> None:
    model.opt.iterations = limit


def _without(moves: list[dict[str, Any]], events: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns the events of a run whose mocap bodies stay in place instead of some moves."""
    return [
        event | {"writes": [w for w in event["writes"] if not str(w[0]).startswith("mocap_")]}
        if any(event is move for move in moves)
        else event
        for event in events
    ]


# Search with the run simulated again

Pairs = dict[frozenset[int], float]
"""Share of the energy created while two geoms touched, by pair."""

ALONE = 3
"""Number of pairs of geoms that are tried as the cause one by one, before all of them. Each takes
another simulation of the run; those with most work come first."""


class _Search:
    """Search for what created energy in a window of a run, which is simulated again.

    Every method raises RecordingError if it cannot be.
    """

    def __init__(
        self, evidence: Evidence, model: mujoco.MjModel, report: AuditReport, window: slice
    ) -> None:
        self._evidence, self._model, self._report, self._window = evidence, model, report, window
        self._run = RepeatedRun(evidence.recording, model, window)
        self._is_rigid = evidence.parameters.is_rigid
        self._gained = _gained(evidence, window)
        self._least = MOST * float(self._gained.sum())
        self._before = float(evidence.created[window.start - 1]) if window.start else 0.0
        # less what was lost meanwhile
        self._created = float(evidence.created[window.stop - 1]) - self._before

    def cause(self) -> Cause:
        """Returns the likely cause, by the first rule that finds one."""
        share, in_contact = _share_in_contact(self._evidence, self._window)
        pairs = self._touched_pairs() if share >= MOST else None
        where = in_contact + (self._pair_words(pairs) if pairs else "")
        cause = self._inputs_cause(where) if self._can_push(pairs) else None
        cause = cause or self._cause_of_scene(where)
        cause = cause or self._solver_cause()
        cause = cause or self._flex_cause()
        cause = cause or self._jump_cause()
        if pairs is not None:
            cause = cause or self._contact_cause(pairs, in_contact)
            where += ", but contacts did little work"
        cause = cause or self._constraint_cause()
        return cause or _cause_without_contact(
            self._evidence, self._window, where, self._faster_body
        )

    def _is_behind(
        self,
        *,
        change: Callable[[mujoco.MjModel], None] = lambda _: None,
        events: list[dict[str, Any]] | None = None,
    ) -> bool:
        """Returns True if the same motion creates less than half of the energy without a suspect.

        Until the window the run stays as it was.

        Args:
            change: Takes the suspect out of the scene.
            events: Events of a run without it; None for the recorded ones.
        """
        run = self._run.until_start(events)
        change(run.model)
        try:
            rows = run.add(self._run.recording.ticks[self._window])
        except RecordingError:
            return False
        if len(rows) < self._window.stop - self._window.start:  # it was stopped
            return False
        left = float(rows["environment_energy"][-1]) - self._before
        return left < (1.0 - MOST) * self._created

    def _touched_pairs(self) -> Pairs:
        """Returns the geoms that touched, those with most energy first.

        A record counts contacts without naming them.
        """
        total = float(self._gained.sum())
        found: defaultdict[frozenset[int], float] = defaultdict(float)
        for run, energy in zip(self._run, self._gained.tolist(), strict=True):
            contact = run.data.contact
            touching = contact.geom[contact.efc_address >= 0].tolist()
            for pair in {frozenset(geoms) for geoms in touching}:
                found[pair] += energy / total
        return dict(sorted(found.items(), key=lambda item: -item[1]))

    def _pair_words(self, pairs: Pairs) -> str:
        pair, share = next(iter(pairs.items()))
        touching = " touched ".join(geom_name(self._model, geom) for geom in sorted(pair))
        others = format_count(len(pairs) - 1, "other pair")
        more = f" ({others} touched, too)" if len(pairs) > 1 else ""
        return f", {share:.0%} while {touching}{more}"

    def _can_push(self, pairs: Pairs | None) -> bool:
        """Returns True if a mocap body was tied to or touched anything meanwhile."""
        model = self._model
        if any(mocap_of(model, i) for i in np.flatnonzero(model.eq_active0).tolist()):
            return True
        is_driven = model.body_mocapid[model.body_rootid[model.geom_bodyid]] >= 0
        return any(is_driven[geom] for pair in pairs or () for geom in pair)

    def _inputs_cause(self, where: str) -> Cause | None:
        """Returns moved mocap bodies as the cause, if little is created where they stand still."""
        moves, events = self._moves(), self._evidence.events
        # gave and took as one sum: the energy that a moved body creates is an error of this work
        steps = np.abs(np.diff(self._evidence.ticks["external_work"], prepend=0.0))
        work = float(steps[self._window].sum())
        if not moves or work <= self._least or not self._is_behind(events=_without(moves, events)):
            return None
        return Cause(
            "inputs",
            f"mocap bodies were moved {len(moves)} times in the {WINDOW:g} s before, and inputs "
            f"gave and took {format_energy(work)}; {where}; MuJoCo damps their contacts and welds "
            "against rest, so a fast move creates energy",
            "move them slower",
        )

    def _moves(self) -> list[dict[str, Any]]:
        """Returns the inputs that moved mocap bodies."""
        return [
            event
            for event in self._evidence.events
            if event.get("event") == "input"
            and isinstance(event.get("tick"), int)
            and self._window.start <= event["tick"] < self._window.stop
            and "mocap_" in str(event.get("writes"))  # a damaged event may have any shape
        ]

    def _contact_cause(self, pairs: Pairs, where: str) -> Cause | None:
        """Returns contacts as the cause: those that create little with the settings recommended.

        If none does, it is what contacts did, if their work is most of the energy.
        """
        evidence, works = self._evidence, self._run.works(_contact_powers)
        hardest = sorted(pairs, key=lambda pair: -works.get(pair, 0.0))
        # rigid contacts do not have those settings
        suspects = [pair for pair in hardest if not self._is_rigid and _concerns(evidence, [pair])]
        for tried in [*([pair] for pair in suspects[:ALONE]), suspects]:
            if tried and self._is_behind(change=partial(set_as_suggested, pairs=tried)):
                named = self._pair_words({tried[0]: pairs[tried[0]]} | pairs)
                return _concern_cause(_concerns(evidence, tried), where + named)
        where += self._pair_words(pairs) if pairs else ""
        work = sum(works.values())
        if work <= MOST * self._created:
            return None
        usual = "the contacts are set as recommended"
        if suspects:
            usual = "with the settings recommended they do so, too"
        did = f"{where}; contacts did {format_energy(work)} of work in the {WINDOW:g} s before"
        if evidence.method.hazard:
            return method_cause(evidence.method, f"{did}; ")
        if self._is_rigid:
            return Cause("unknown", did, "lower the stiffness, or raise the rate")
        remedy = f"{_rigid_change(evidence.method)}, or lower the stiffness"
        return Cause("unknown", f"{did}; {usual}", remedy)

    def _cause_of_scene(self, where: str) -> Cause | None:
        """Returns what the scene itself does beside any contact, if its work is most of the energy.

        This is a pump, or work without a port.
        """
        found = list[tuple[float, Cause]]()
        pump, work = self._run.hardest_pump()
        # a motor's work is no creation, until its motion is beyond all measure
        if pump is not None and (pump.kind == "joint" or self._report.trip is not None):
            found.append((work, pump_cause(pump, work, where)))
        clauses = unmetered_work(self._model)
        for name, did in self._run.works(partial(_unmetered_powers, clauses)).items():
            words = f"{clauses[name]}: {format_energy(did)} in the {WINDOW:g} s before; {where}"
            cause = Cause("unmetered work", words, f"remove {name}, or make it weaker")
            found.append((did, cause))
        found = [each for each in found if each[0] > self._least]
        return max(found, key=lambda each: each[0])[1] if found else None

    def _jump_cause(self) -> Cause | None:
        """Returns a tendon that jumps as the cause, if its jumps brought most of the energy.

        A jump of length stretches the tendon's spring, or breaks its limit or constraint, without
        any work. Where its moment arms jump, a step takes the force of one side for that of the
        other.
        """
        if not self._model.ntendon:
            return None
        watch = TendonWatch(self._model)
        found = jump_behind([watch.jumps(run.data) for run in self._run], self._gained)
        if found is None:
            return None
        tendon, share, jump = found
        name = self._model.tendon(tendon).name or str(tendon)
        return Cause(
            "jumping tendon",
            f"{share:.0%} of the energy created until then came as the {jump.quantity} of "
            f"tendon '{name}' jumped, by up to {jump.size} in one tick: its way round a geom "
            "changed",
            f"write {STEADY_WAY}",
        )

    def _solver_cause(self) -> Cause | None:
        """Returns the solver as the cause, if it creates little with more iterations."""
        limit = iteration_limit(self._model, is_rigid=self._is_rigid)
        is_full = self._evidence.ticks["solver_iterations"][self._window] >= limit
        stopped, change = float(self._gained[is_full].sum()), partial(_iterate, limit=10 * limit)
        if not stopped or stopped < self._least or not self._is_behind(change=change):
            return None
        return Cause(
            "solver",
            f"{stopped / float(self._gained.sum()):.0%} of the energy created until then came in "
            "ticks in which MuJoCo's solver stopped at its limit of "
            f"{format_count(limit, 'iteration')}: its forces are not those of the contacts and "
            "constraints",
            f'write <option iterations="{10 * limit}">',
        )

    def _flex_cause(self) -> Cause | None:
        """Returns a flex as the cause, if most of the energy is what it gave without storing it."""
        if not self._model.nflex:
            return None
        from_tick = slice(max(self._window.start - 1, 0), self._window.stop)
        whole = replace(self._run, window=from_tick)
        sums = [unstored_energy(run.binding.state[0]) for run in whole]
        given = sums[-1] - (sums[0] if self._window.start else 0.0)
        if given <= self._least:
            return None
        parameters = self._evidence.parameters
        remedy = storing_flex(self._model, parameters.period / parameters.substeps)
        return Cause("bottomless flex", unstored_words(self._model, given), remedy)

    def _constraint_cause(self) -> Cause | None:
        """Returns a soft equality or limit as the cause, if its work is most of the energy.

        MuJoCo's own constraint is a spring, whose energy no meter knows.
        """
        if self._is_rigid:
            return None
        works = self._run.works(_constraint_powers)
        name = max(works, key=lambda each: works[each], default="")
        if not name or works[name] <= MOST * self._created:
            return None
        return Cause(
            "constraint",
            f"{name} did {format_energy(works[name])} of work in the {WINDOW:g} s before: with the "
            "scene's own contacts it is a spring, whose energy no meter knows",
            f"{_rigid_change(self._evidence.method)}: rigid contacts hold it without a spring",
        )

    def _faster_body(self, turned: float) -> tuple[str, float] | None:
        """Returns the body that turned most in a tick, and by how many rad, if more than a turn."""
        speeds = [np.linalg.norm(run.data.cvel[:, :3], axis=1) for run in self._run]
        largest = np.nan_to_num(np.max(speeds, axis=0)) * self._evidence.parameters.period
        body = int(np.argmax(largest))
        if largest[body] <= turned:
            return None
        return f"body '{self._model.body(body).name or body}'", float(largest[body])

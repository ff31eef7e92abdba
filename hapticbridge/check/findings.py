"""Findings on a scene: the table of the rules, and those on options, start and own motion."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import mujoco

from hapticbridge.check.case import SceneUnderCheck
from hapticbridge.check.constraint_faults import constraint_faults
from hapticbridge.check.contact_faults import (
    contact_faults,
    margin_faults,
    shape_faults,
    start_faults,
)
from hapticbridge.check.geometry_faults import grip_faults, mesh_faults, workspace_faults
from hapticbridge.check.mass_faults import mass_faults
from hapticbridge.check.run_faults import run_faults
from hapticbridge.errors import choices
from hapticbridge.run.fidelity import NO_MEASURE, fidelity
from hapticbridge.scene import compile_scene
from hapticbridge.scene.checks import (
    MAY_BE_ACTIVE,
    coupled_sensors,
    early_sensors,
    first_pump,
    unmetered_work,
)
from hapticbridge.scene.compile import START_KEYFRAME, start_among
from hapticbridge.scene.fault import Fault
from hapticbridge.scene.first_faults import (
    UNITS,
    angle_faults,
    motor_faults,
    pump_faults,
    unit_faults,
    urdf_faults,
)
from hapticbridge.scene.physics import OWN_VERTICES, gradientless_flexes
from hapticbridge.scene.treatment import Treatment
from hapticbridge.units import format_count

# Faults of options, start, and motion without a hand

_SAME_STEP = 1e-9  # relative: 0.001 as 1/1000


def option_faults(case: SceneUnderCheck) -> Iterator[Fault]:
    """Yields a time step that is not the run's, and concerns from loading the scene.

    Integrator and solver are replaced without harm, so that they are no faults. Time step and start
    have faults of their own.
    """
    option, places = case.source.spec.option, case.places
    step = float(option.timestep)
    if not case.has_chosen_period and abs(step - case.period) > _SAME_STEP * case.period:
        yield Fault(
            "time step",
            places.option("timestep"),
            f"the scene has a time step of {1e3 * step:g} ms; it runs at {1e3 * case.period:g} ms, "
            f"one step per tick at {1 / case.period:g} Hz, and its contacts change with it",
            f"{places.option_change('timestep', f'{case.period:g}')}, or check with --rate "
            f"{1 / step:g}",
        )
    for change in (*case.differences, *case.carried_weight()):
        if change.subject not in ("time step", "integrator", "solver", "overlap"):
            words = change.words if change.treatment.is_rigid else change  # the rest is the remedy
            yield Fault(
                "changed",
                places.setting(change.treatment.settings),
                f"the scene runs with a change, {words}, because {change.treatment.why}",
                _OF_SUBJECT.get(change.subject) or _instead(change.treatment),
            )
    for name, concern in unmetered_work(case.model).items():
        place = places.with_attribute(name) or places.option(name)
        yield Fault("unmetered work", place, concern + MAY_BE_ACTIVE, f"remove {name}")
    if concern := gradientless_flexes(case.model):
        place = places.with_attribute("dof") or places.option("timestep")
        yield Fault("flex without energy", place, concern, OWN_VERTICES)


APART = "a start (pos, or keyframe 'home') with parts apart, limits kept and constraints closed"
"""Change of a scene whose start a run moves. A tool in a height field may be moved far, out of its
side or its base, and not to the place that was meant."""

_OF_SUBJECT = {
    "start": APART,
    "weight": 'gravcomp="1" in the bodies of the tool, or less mass',
    "adhesion": "run with --method implicit, which sees no contact ahead",
    "joint's gravity compensation": 'gravcomp="0" in the bodies it carries, where it shall not',
    "nested parts": "an <exclude> of their bodies in the file's <contact>",
    "memory": "that memory in <size>, in place of njmax, nconmax and nstack",
    "only keyframe": f'name="{START_KEYFRAME}" in that <key>',
    "servos": "the pose as ctrl in that <key>",
}
"""Ways to make a change in the file that is more than a new value."""


def _instead(treatment: Treatment) -> str:
    """Returns how a run goes without a change that no file can make needless."""
    if treatment.is_rigid:
        return "run with --contact scene, which keeps it"
    return "run --as-is, which refuses the scene"


def own_motion_faults(case: SceneUnderCheck) -> Iterator[Fault]:
    """Yields findings on a scene that moves by itself otherwise than its file says."""
    if case.refused or first_pump(case.model) is not None:
        return  # the file's own scene does not compile, or a pump moves it without bound
    scene = compile_scene(case.source, case.scene.grip, warns=False, checks_start=False)
    found = fidelity(case.source, scene, case.setting)
    place = case.places.option("timestep")
    if found is None:
        change = "a time step, gains or limits with which it does not"
        yield Fault("time step matters", place, NO_MEASURE, change)
        return
    if found.deviations:
        change = found.advice(case.setting) or "nothing that was tried mends it"
        kind = "divergence" if math.isinf(found.size) else "own motion"
        yield Fault(kind, place, str(found), change)
    if found.doubt:
        change = "a shorter time step, with which the places no longer change"
        yield Fault("time step matters", place, found.doubt, change)


def keyframe_faults(case: SceneUnderCheck) -> Iterator[Fault]:
    """Yields a fault if the scene has keyframes but no start among them."""
    keyframes = list(case.source.spec.keys)
    if keyframes and start_among(keyframes) < 0:
        names = [str(keyframe.name) for keyframe in keyframes]
        listed = choices(name or "one without a name" for name in names)
        place = case.places.named("key", names[0])
        name = f'name="{START_KEYFRAME}"'
        own = f'<key {name} qpos="…"/> in a <keyframe> of {place.file}'
        yield Fault(
            "keyframe",
            place,
            f"the scene has keyframes ({listed}), but none is called '{START_KEYFRAME}': it starts "
            "at MuJoCo's initial pose instead",
            name if place.line else f"{own}: those of an attached model get a prefix",
        )


def sensor_faults(case: SceneUnderCheck) -> Iterator[Fault]:
    """Yields sensors that read the coupling's pull or contacts ahead, as in ``checks``."""
    model = case.model
    for sensor in coupled_sensors(model, case.scene.grip):
        name, tag = str(model.sensor(sensor).name), _FORCE_SENSORS[int(model.sensor_type[sensor])]
        place, pull = "carries the grip", "the coupling's pull on the tool"
        mend = "nothing; subtract the wrench on the tool, about its site and along its axes"
        if tag == "jointactuatorfrc":
            place = "is of a joint that moves the grip"
            pull += ", half of it or, near contact, all"
            mend = '<actuatorfrc actuator="…"/> for each of the joint\'s own actuators instead'
        yield Fault(
            "force sensor",
            case.places.named(tag, name),
            f"sensor '{name or sensor}' {place}: its readings include {pull}, which MuJoCo takes "
            "for a motor's, and a real sensor there would not",
            mend,
        )
    for sensor in early_sensors(model):
        name = str(model.sensor(sensor).name)
        yield Fault(
            "contact sensor",
            case.places.named("contact", name),
            f"sensor '{name or sensor}' also finds contacts that a run sees ahead, some mm before "
            "the parts touch; they carry no force",
            'nothing; or data="force" reduce="netforce", which is 0 until they touch',
        )


_FORCE_SENSORS = {
    int(mujoco.mjtSensor.mjSENS_FORCE): "force",
    int(mujoco.mjtSensor.mjSENS_TORQUE): "torque",
    int(mujoco.mjtSensor.mjSENS_JOINTACTFRC): "jointactuatorfrc",
}
"""Elements of the sensors that may read the coupling's pull."""


# Rules by which a scene is judged

RULES = (
    urdf_faults,
    option_faults,
    own_motion_faults,
    keyframe_faults,
    sensor_faults,
    mass_faults,
    unit_faults,
    pump_faults,
    motor_faults,
    angle_faults,
    mesh_faults,
    grip_faults,
    workspace_faults,
    start_faults,
    contact_faults,
    shape_faults,
    margin_faults,
    constraint_faults,
    run_faults,
)
"""Functions that yield the faults of one subject, in the best order for mending."""


def find_faults(case: SceneUnderCheck) -> tuple[Fault, ...]:
    """Returns all faults of a scene from ``open_case``; the scene is reset.

    A tool in wrong units has faults of every kind, so that these wait until it is mended.
    """
    faults = [fault for rule in RULES for fault in rule(case)]
    units = [fault for fault in faults if fault.kind == UNITS]
    if not units or len(faults) == len(units):
        return tuple(faults)
    more = len(faults) - len(units)
    verb = "waits" if more == 1 else "wait"
    waiting = f"; {format_count(more, 'more finding')} {verb} until this is mended"
    return tuple(replace(fault, sentence=fault.sentence + waiting) for fault in units)

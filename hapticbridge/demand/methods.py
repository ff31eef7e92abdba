"""Rendering methods: description, registry, preparation of a scene, and the coupling's three names.

To add a method of the product that uses an existing path of the wrench, add a ``Method`` here and
to ``METHODS``. For a new path, ``Scheme.MIDPOINT`` (``kernel.lossless``) is the example:

1. ``kernel.codes``: a number of ``Scheme`` with its ``SchemeProperties``; in ``kernel.parameters``,
   ``SLOW_SCHEMES`` if its scene may step beside the loop.
2. A module in ``kernel`` with the steps and the sub-record of the scheme; ``kernel.state`` binds
   the sub-record and resets it.
3. ``kernel.tick``: a branch in ``before_step`` and ``_evaluate``, and in ``close_tick`` if the
   balance needs more. A test fails while a scheme has no branch.
4. ``audit.motion.wrench_by_law``: its law, by which the audit computes every wrench again.

``lab.methods`` has the recipe for a method that exists only to be compared.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from importlib import import_module
from typing import Any, Literal

import mujoco
import numpy as np

from hapticbridge.arguments import Arguments
from hapticbridge.coupling import SYMBOLS, UNITS, Axis, Coupling
from hapticbridge.device.base import AXES, DeviceInfo
from hapticbridge.errors import DeviceError, HapticBridgeError, SceneError, choices
from hapticbridge.kernel.codes import (
    WELD_NAME,
    Grip,
    Scheme,
    added_id,
)
from hapticbridge.kernel.law import GainRule, implicit_gains
from hapticbridge.kernel.lossless import REACH
from hapticbridge.kernel.parameters import SLOW_SCHEMES, RunParameters, checked_substeps
from hapticbridge.kernel.pose import IDENTITY_POSE
from hapticbridge.scene import Scene
from hapticbridge.scene.checks import check_metered, refuse_overlap
from hapticbridge.scene.contacts import warn_of_contacts
from hapticbridge.scene.handle import measured_weld
from hapticbridge.scene.scene import has_rigid_contact
from hapticbridge.theory.bounds import (
    IMPLICIT_SHARE,
    MIDPOINT_SHARE,
    effective_damping,
    law_damping,
)
from hapticbridge.units import format_number

Contact = Literal["rigid", "scene"]
RIGID: Contact = "rigid"
SCENE: Contact = "scene"
CONTACTS = (RIGID, SCENE)
"""Contacts by name: rigid and strictly passive (``kernel.rigid_contact``), or MuJoCo's with the
scene's own settings."""


@dataclass(frozen=True, slots=True)
class Method:
    """A rendering method: all of it besides the steps of its scheme in the kernel.

    Attributes:
        name: Name for ``--method`` and the recording's metadata.
        about: Description in one sentence.
        hazard: Hazard on a real device beyond the device condition, in one sentence; empty without
            one.
        scheme: Path of the wrench to the tool.
        integrator: MuJoCo's integrator by its MJCF name.
        discretization: Discretisation of the coupling's damper in the bounds; ``none`` without a
            law.
        gains: Gains of the coupling's actuators. The scheme ``MIDPOINT`` needs ``implicit_gains``.
        check: Refuses a scene that the method cannot render, by model and name of the grip; None if
            it renders any.
        reach: Distance in m between surfaces at which a contact exists before it acts.
        warns: True to warn of contacts that may create energy; False if the coupling does too.
        compensated_share: Share of K h that is subtracted from the requested damping because the
            integration adds it; no unit.
        added_share: Share of K h that the integration adds to the damping, subtracted or not; None
            if it adds another amount or removes some.
        is_rigid: True if contacts are rigid and strictly passive (``kernel.rigid_contact``), which
            needs the integrator ``discrete`` and a coupling law; False for those of the scene.
    """

    name: str
    about: str
    hazard: str
    scheme: Scheme
    integrator: str
    discretization: str = "backward"
    gains: GainRule = implicit_gains
    check: Callable[[mujoco.MjModel, str], None] | None = None
    reach: float = 0.0
    warns: bool = True
    compensated_share: float = 0.0
    added_share: float | None = None
    is_rigid: bool = False

    def __post_init__(self) -> None:
        if self.scheme == Scheme.MIDPOINT and self.gains is not implicit_gains:
            raise HapticBridgeError(
                f"method '{self.name}' has gains of its own; the kernel takes a lossless "
                "coupling's from kernel.law.implicit_gains"
            )

    @property
    def step(self) -> Callable[[Any, Any], None]:
        """MuJoCo's step through the Python bindings, with the contacts of the scene."""
        step: Callable[[Any, Any], None] = (
            mujoco.mj_step if self.has_coupling else mujoco.mj_fwdPosition
        )
        return step

    @property
    def can_be_rigid(self) -> bool:
        """True if contacts can be rigid: MuJoCo solves the coupling's law together with them."""
        properties = self.scheme.properties
        return self.integrator == "discrete" and properties.has_law and not properties.holds_wrench

    @property
    def can_be_slow(self) -> bool:
        """True if the scene can step in a slower loop than the bridge's (``slow_scene``)."""
        return self.scheme in SLOW_SCHEMES

    def refuse_slow(self) -> None:
        """Refuses a scene that steps in a slower loop, for a method that cannot have one.

        Raises:
            HapticBridgeError: The message lists the methods with a guarantee that can.
        """
        if not self.can_be_slow:
            able = [name for name, each in guaranteed_methods().items() if each.can_be_slow]
            raise HapticBridgeError(
                f"method '{self.name}' has no scene slower than the loop; take one of "
                f"{choices(able)}"
            )

    @property
    def has_guarantee(self) -> bool:
        """True if nothing beyond the device condition may make it kick on a real device."""
        return not self.hazard

    @property
    def contact(self) -> Contact:
        """Contact by its name in ``CONTACTS``."""
        return RIGID if self.is_rigid else SCENE

    def with_contact(self, contact: str | None) -> Method:
        """Returns the method with a contact of ``CONTACTS``; None is rigid where the method can.

        Raises:
            SceneError: The name is unknown, or the method cannot have rigid contacts.
        """
        if contact is not None and contact not in CONTACTS:
            raise SceneError(f"no contact is called '{contact}'; contacts: {choices(CONTACTS)}")
        if contact == RIGID and not self.can_be_rigid:
            able = [method.name for method in METHODS.values() if method.can_be_rigid]
            raise SceneError(
                f"method '{self.name}' has the contacts of the scene; rigid contacts need one of "
                f"{choices(able)}"
            )
        return replace(self, is_rigid=self.can_be_rigid if contact is None else contact == RIGID)

    def law_evaluations(self, substeps: int) -> int:
        """Returns the evaluations of the tool's wrench per tick."""
        return self.scheme.properties.law_evaluations(substeps)

    @property
    def has_law(self) -> bool:
        """True if the coupling law gives the wrench, so that the device condition proves safety."""
        return self.scheme.properties.has_law

    @property
    def meters_inputs(self) -> bool:
        """True if the work of applied forces and moved mocap bodies is metered."""
        return self.integrator != "RK4" and self.has_coupling

    @property
    def has_coupling(self) -> bool:
        """True if an elastic coupling lies between handle and tool."""
        return self.scheme.properties.has_tool_mass

    @property
    def is_weld(self) -> bool:
        """True if an equality constraint of MuJoCo is the coupling."""
        return self.scheme == Scheme.WELD

    def law_coupling(self, coupling: Coupling, timestep: float) -> Coupling:
        """Returns the law's coupling for a requested one: B' = max(B − compensated_share K h, 0).

        The integration adds compensated_share K h again; rotation follows the same rule. The device
        needs b >= K T/2 + B', so the subtracted damping allows more stiffness. ``timestep`` is
        MuJoCo's h in s.

        Raises:
            CouplingError: The time step is not finite and > 0.

        References:
            ``theory.bounds``.
        """
        return _with_damping(coupling, timestep, self.compensated_share, law_damping)

    def requested_coupling(self, law: Coupling, timestep: float) -> Coupling:
        """Returns the requested coupling for the law's one: B = B' + compensated_share K h.

        It is also the effective coupling, except for methods that do not subtract their own damping
        (``added_share``).
        """
        return _with_damping(law, timestep, self.compensated_share, effective_damping)


def _with_damping(
    coupling: Coupling, timestep: float, share: float, damping: Callable[..., float]
) -> Coupling:
    """Returns a coupling with other damping by a function of K, B, time step and share."""
    if share == 0.0:
        return coupling
    return replace(
        coupling,
        damping=damping(*coupling.gains("translation"), timestep, share),
        rotational_damping=damping(*coupling.gains("rotation"), timestep, share),
    )


def require_hazard_consent(method: Method, *, is_real: bool, i_know: bool) -> None:
    """Refuses a hazardous method on a device with motors without the user's consent.

    Raises:
        DeviceError: The message names the hazard and the way to consent.
    """
    if is_real and method.hazard and not i_know:
        raise DeviceError(
            f"method '{method.name}' on a real device: {method.hazard}; use 'implicit', or consent "
            "with --i-know (Bridge(i_know=True))"
        )


# Coupling of a run under its three names


@dataclass(frozen=True, slots=True)
class RunCoupling:
    """Coupling of a run: as requested, in the law, and effective at the hand.

    Attributes:
        requested: K and B that the user asked for; None if unknown.
        law: K and B of the law, whose B counts in the device condition b >= K T/2 + B. It is
            smaller than the requested B if the integration adds damping by itself. None without a
            coupling law.
        effective: K and B that a hand meets away from contact, to first order in the time step;
            None if the method gives no number. Known before a run, and equal after it.
        near_contact: K and B of a lossless coupling that was implicit in each tick, because the
            tool was always near a contact, or held by friction or a constraint; else None.
        remark: Where K and B are meant, if not at the tool; or empty.
    """

    requested: Coupling | None
    law: Coupling | None
    effective: Coupling | None
    near_contact: Coupling | None = None
    remark: str = ""

    @classmethod
    def of(
        cls,
        method: Method,
        timestep: float,
        requested: Coupling | None = None,
        *,
        law: Coupling | None = None,
        measured: Coupling | None = None,
        is_always_implicit: bool = False,
    ) -> RunCoupling:
        """Completes the three couplings from the requested one, or from the law's.

            B_effective = B_law + added_share K h

        Args:
            method: The rendering method.
            timestep: MuJoCo's h in s.
            requested: The requested coupling; None if unknown.
            law: K and B of the law; None computes it from ``requested``.
            measured: Effective coupling of a weld.
            is_always_implicit: True if a lossless coupling is implicit in every tick, because the
                tool is never free or always near a contact. It then acts as ``implicit``.
        """
        if not method.has_law:
            return cls(requested, None, measured)
        if law is None:
            if requested is None:
                raise HapticBridgeError("a coupling needs its requested or its law's gains")
            law = method.law_coupling(requested, timestep)
        if method.added_share is None:
            return cls(requested, law, None)
        is_implicit = is_always_implicit and method.scheme == Scheme.MIDPOINT
        return cls(
            requested,
            law,
            _with_damping(law, timestep, method.added_share, effective_damping),
            _with_damping(law, timestep, IMPLICIT_SHARE, effective_damping)
            if is_implicit
            else None,
        )

    @classmethod
    def of_run(
        cls,
        method: Method,
        requested: Coupling,
        run: RunParameters,
        *,
        was_never_lossless: bool,
    ) -> RunCoupling:
        """Returns the coupling of a run as its hand feels it.

        ``was_never_lossless`` is True if no tick of the run was lossless.
        """
        coupling = cls.of(
            method,
            run.timestep,
            requested,
            law=run.coupling,
            measured=run.effective,
            is_always_implicit=was_never_lossless and not run.scene_ticks,
        )
        return coupling.felt_at(run.grip, run.scale, run.force_scale, is_apart=run.is_apart)

    def felt_at(
        self, grip: str, scale: float, force_scale: float, *, is_apart: bool = False
    ) -> RunCoupling:
        """Returns the coupling as a hand feels it: for a joint, at the fingers in N/m and N s/m.

            K_fingers = scale · force_scale · K

        A loop of the device's own (``is_apart``) adds no damping to the law's. Any other coupling
        stays as it is.
        """
        if is_apart:
            return replace(self, effective=self.law, near_contact=None, remark="in its own loop")
        if not Grip.from_text(grip).is_joint:
            return self
        ratio = scale * force_scale

        def at_fingers(own: Coupling | None) -> Coupling | None:
            return own and Coupling(ratio * own.stiffness, ratio * own.damping, 0.0, 0.0)

        return RunCoupling(
            at_fingers(self.requested),
            at_fingers(self.law),
            at_fingers(self.effective),
            at_fingers(self.near_contact),
            "at the fingers",
        )

    def sentences(self, info: DeviceInfo | None = None) -> tuple[str, ...]:
        """Returns a sentence on translation, and one on rotation if it has a spring.

        A device ``info`` that neither turns nor senses rotation has none on it.

        ``K = 2400 N/m, B = 1.7 N s/m (B_law = 0.5)``: B is the effective damping, and the requested
        one follows where it is another. Without an effective coupling it is the law's or the
        requested one, which is said.
        """
        turns = info is None or {*info.axes, *info.sensed} & {*AXES[3:]}
        told = (self._sentence(axis) for axis in SYMBOLS if axis == "translation" or turns)
        return tuple(filter(None, told))

    def _sentence(self, axis: Axis) -> str:
        """Returns the sentence on translation or rotation; empty without a spring."""
        felt, law, asked, near = (
            None if coupling is None else coupling.gains(axis)
            for coupling in (self.effective, self.law, self.requested, self.near_contact)
        )
        first = felt or law or asked
        if first is None or first[0] == 0.0:
            return ""
        (k, b), (k_unit, b_unit) = SYMBOLS[axis], UNITS[axis]

        def other(gains: tuple[float, float], name: str = b) -> str:
            text = f"{name} = {gains[1]:.4g}"
            is_equal = math.isclose(gains[0], first[0])
            return text if is_equal else f"{k} = {format_number(gains[0])}, {text}"

        notes = [other(law, "B_law")] if law and felt else []
        if asked and (felt or law) and not np.allclose(asked, first, rtol=1e-9, atol=0.0):
            notes.append(f"set {other(asked)}")
        notes += [f"near contact or held, as here: {other(near)}"] if near else []
        notes += ["what a hand feels is unknown"] if law and not felt else []
        notes += [self.remark] if self.remark else []
        beside = f" ({', '.join(notes)})" if notes else ""
        name = "B_law" if law and not felt else b
        words = "" if felt or law else " as set"
        return (
            f"{k} = {format_number(first[0])} {k_unit}, "
            f"{name} = {first[1]:.4g} {b_unit}{words}{beside}"
        )


# Rendering methods of the product, and the registry of all methods

IMPLICIT = Method(
    name="implicit",
    about="the coupling as actuators under MuJoCo's discrete integrator: implicit in position and "
    "velocity, solved together with the contacts, passive behind the coupling",
    hazard="",
    scheme=Scheme.IMPLICIT,
    integrator="discrete",
    added_share=IMPLICIT_SHARE,
    is_rigid=True,
)

COMPENSATED = replace(
    IMPLICIT,
    name="compensated",
    about="implicit, with the damping K T that its integration adds taken off the coupling's",
    compensated_share=IMPLICIT_SHARE,
)

LOSSLESS_COUPLING = Method(
    name="lossless",
    about="half of the coupling inside MuJoCo's implicit step, half carried over from the last: a "
    "free tool keeps its energy and is followed to second order, its force comes half a tick late, "
    "of first order; near contacts it is 'implicit'",
    hazard="",
    scheme=Scheme.MIDPOINT,
    integrator="discrete",
    reach=REACH,
    compensated_share=MIDPOINT_SHARE,
    added_share=MIDPOINT_SHARE,
    is_rigid=True,
)

METHODS = {method.name: method for method in (IMPLICIT, COMPENSATED, LOSSLESS_COUPLING)}
"""Registered methods by name. ``COMPARISONS`` adds its own when it is imported."""

COMPARISONS = "hapticbridge.lab.methods"
"""Module of the methods that exist only to be compared; it registers them in ``METHODS``."""


def guaranteed_methods() -> dict[str, Method]:
    """Returns the methods with a guarantee by name, the default one first and the newest next."""
    methods = dict.fromkeys((default_method(), *reversed(METHODS.values())))
    return {method.name: method for method in methods if method.has_guarantee}


def unsuited_reason(method: Method, substeps: int, *, has_several_hands: bool) -> str:
    """Returns why a method cannot render a run, as a clause; empty if it can."""
    properties = method.scheme.properties
    if has_several_hands and not properties.allows_hands:
        return "has one hand, without a grip axis"
    if substeps != 1 and properties.one_substep:
        return f"takes one MuJoCo step a tick, and this run {substeps}"
    return ""


def default_method(substeps: int = 1, *, has_several_hands: bool = False) -> Method:
    """Returns the default method: ``lossless`` if it suits the run, else ``implicit``.

    ``lossless`` takes no substeps and has one hand (``unsuited_reason``). It is strict on every
    shipped scene, in 20 hands each. Away from contact it is at least ten times as accurate as
    ``implicit``; in contact it equals ``implicit`` with the same B', and so suits the same device.

    Springs and dampers of the tool's joints and tendons are taken at the midpoint as well. A mass
    of 1 kg on 500 N/m errs by 0.011 % at 1 ms, by 0.10 % with a held force, by 1.3 % with
    ``implicit``. A spring with slack or yield stays MuJoCo's own, and ``lossless`` is of first
    order: 0.49 % for 1 kg on a tendon with slack, where ``implicit`` errs by 2.5 %.

    ``implicit`` dissipates some energy on the way to a contact and ``lossless`` does not, so energy
    created by the scene's own contacts uses more slack: at most 1.2 % instead of 1.1 % when
    tapping, and equal shares with jamming pegs (``scripts/bench methods --same device``). Rigid
    contacts create none by either. Near contact
    ``lossless`` adds K T to B', but reports K T/2. When tapping at 6 Hz it is 54 µm RMS off its
    reported effective coupling. ``implicit`` is 26 µm off its own report, B + K T/2, and 116 µm off
    B.
    """
    reason = unsuited_reason(LOSSLESS_COUPLING, substeps, has_several_hands=has_several_hands)
    return IMPLICIT if reason else LOSSLESS_COUPLING


def method_names() -> tuple[str, ...]:
    """Returns the names of all methods, those of ``COMPARISONS`` included."""
    import_module(COMPARISONS)
    return tuple(METHODS)


def method_named(name: str) -> Method:
    """Returns a method by its name.

    Raises:
        SceneError: The name is unknown; the message lists the methods.
    """
    if name not in METHODS and name not in method_names():
        raise SceneError(f"no method is called '{name}'; methods: {choices(METHODS)}")
    return METHODS[name]


# Preparation of a scene for a method

_INTEGRATORS = {
    "Euler": mujoco.mjtIntegrator.mjINT_EULER,
    "RK4": mujoco.mjtIntegrator.mjINT_RK4,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "discrete": mujoco.mjtIntegrator.mjINT_DISCRETE,
}

_ARGUMENTS = Arguments(SceneError)

MEASURED_AGAIN = 1e-6
"""Relative difference, without unit, above which a second measurement of a weld disagrees. Probing
by 1e-6 m leaves rounding of 1e-10, on another processor hardly more."""


def resolve_contact_stiffness(
    method: Method, coupling: Coupling, contact_stiffness: float | None
) -> float:
    """Returns K_c in N/m: the requested one, or the coupling's K; 0 for methods with a coupling.

    Raises:
        SceneError: It is not finite, not > 0 or outside 1e-30 to 1e30, or the method has no contact
            springs of its own.
    """
    if method.has_coupling:
        if contact_stiffness is not None:
            raise SceneError(
                f"contact stiffness is {contact_stiffness!r} N/m, but method '{method.name}' "
                "leaves contacts to MuJoCo; only 'direct' takes it"
            )
        return 0.0
    stiffness = coupling.stiffness if contact_stiffness is None else contact_stiffness
    return _ARGUMENTS.number("contact stiffness", stiffness, "N/m", least=0.0, is_open=True)


def check_scene(model: mujoco.MjModel, grip: str, method: Method) -> None:
    """Refuses a scene that a method cannot render or meter.

    Raises:
        SceneError: The message names the obstacle in the scene.
    """
    if method.check is not None:
        method.check(model, grip)
    check_metered(model, method.integrator, method.name)


def prepare(
    scene: Scene,
    coupling: Coupling,
    scene_period: float,
    substeps: int,
    method: Method = IMPLICIT,
    warns: bool = True,
) -> Coupling | None:
    """Sets a scene's integrator, gains and time step for a method, and resets it.

    Args:
        scene: Changed in place. For a weld its model and data are replaced; changes to the old
            model are carried over.
        coupling: The requested coupling.
        scene_period: Time in s between two results of the scene: T, or n T of a slower scene.
        substeps: MuJoCo steps in that time.
        method: The rendering method.
        warns: True to warn of contacts that may create energy at this time step.

    Returns:
        The measured effective coupling of a weld, for ``RunParameters.effective``; None for other
        methods.

    Raises:
        SceneError: Period, substeps or a gain is out of range (1e-30 to 1e30), or the scene does
            not suit the method.
    """
    checked_substeps(substeps, SceneError)
    for gain in fields(Coupling):
        _ARGUMENTS.number(f"coupling {gain.name.replace('_', ' ')}", getattr(coupling, gain.name))
    check_scene(scene.model, scene.grip, method)
    scene.set_timestep(scene_period, substeps)
    scene.set_weld(coupling if method.is_weld else None)
    scene.model.opt.integrator = _INTEGRATORS[method.integrator]
    scene.set_reach(method.reach)
    scene.set_contact(is_rigid=method.is_rigid)
    if warns and method.warns and not method.is_rigid:
        warn_of_contacts(scene.model, scene.grip, scene.path)
    step = scene_period / substeps
    scene.set_gains(*method.gains(method.law_coupling(coupling, step), step))
    effective = measured_weld(scene.model, scene.grip) if method.is_weld else None
    scene.reset()
    if not method.is_rigid:
        refuse_overlap(scene.model, scene.data, scene.grip)
    return effective


def prepare_hands(
    scene: Scene, couplings: Sequence[Coupling], period: float, method: Method, warns: bool = True
) -> None:
    """Prepares a scene for several hands, as ``prepare`` does for one, with a step per tick.

    Args:
        scene: Changed in place.
        couplings: The requested coupling of each hand.
        period: T in s.
        method: The rendering method.
        warns: As for ``prepare``.

    Raises:
        SceneError: As for ``prepare``.
    """
    prepare(scene, couplings[0], period, 1, method, warns=warns)
    for hand, coupling in enumerate(couplings):
        law = method.law_coupling(coupling, period)
        scene.of_hand(hand).set_gains(*method.gains(law, period))


MAX_WRENCH = 1e30
"""Force in N and torque in N m of a device without limits; infinity is no limit of a run."""


def unguarded_parameters(
    scene: Scene, coupling: Coupling, period: float, substeps: int, method: Method
) -> RunParameters:
    """Prepares a scene for a handle without a device, and returns the parameters of its run.

    Nothing limits the wrench, and no guard acts. The samples are poses relative to the grip's.

    Args:
        scene: Changed in place, as by ``prepare``.
        coupling: The requested coupling.
        period: T in s.
        substeps: MuJoCo steps per tick.
        method: The rendering method.

    Raises:
        SceneError: As for ``prepare``.
    """
    effective = prepare(scene, coupling, period, substeps, method, warns=False)
    return RunParameters(
        grip=scene.grip,
        period=period,
        substeps=substeps,
        coupling=method.law_coupling(coupling, period / substeps),
        force_limit=MAX_WRENCH,
        torque_limit=MAX_WRENCH,
        ramp_ticks=0,
        device_origin=IDENTITY_POSE,
        handle_origin=scene.grip_pose(),
        device_start=IDENTITY_POSE,
        scheme=method.scheme,
        is_rigid=method.is_rigid,
        effective=effective,
        contact_stiffness=resolve_contact_stiffness(method, coupling, None),
    )


def check_prepared(model: mujoco.MjModel, parameters: RunParameters, method: Method) -> None:
    """Refuses a model that differs from the result of ``prepare`` for these parameters.

    Raises:
        SceneError: The message names the first difference.
    """
    check_scene(model, parameters.grip, method)
    if model.opt.integrator != _INTEGRATORS[method.integrator]:
        raise SceneError(f"method '{method.name}' requires the integrator {method.integrator}")
    if method.is_rigid and not has_rigid_contact(model):
        raise SceneError("rigid contacts require an elliptic cone, impratio 1000 and a margin")
    weld_id = added_id(model, mujoco.mjtObj.mjOBJ_EQUALITY, WELD_NAME)
    has_weld = weld_id >= 0
    if has_weld != method.is_weld:
        raise SceneError(
            f"method '{method.name}' requires {'a' if method.is_weld else 'no'} weld to the handle"
        )
    if has_weld:
        gains = -model.eq_solref[weld_id]
        coupling = parameters.coupling
        if gains.tolist() != [coupling.stiffness, coupling.damping]:
            raise SceneError(
                f"the weld has K = {gains[0]!r}, B = {gains[1]!r}, the metadata say "
                f"{coupling.stiffness!r}, {coupling.damping!r}"
            )
        effective, measured = (
            parameters.effective or coupling,
            measured_weld(model, parameters.grip),
        )
        for gain in fields(Coupling):
            claimed, true = getattr(effective, gain.name), getattr(measured, gain.name)
            if not math.isclose(claimed, true, rel_tol=MEASURED_AGAIN):
                raise SceneError(
                    f"{gain.name.replace('_', ' ')} of the weld is {true:.6g} in SI units, the "
                    f"metadata say {claimed:.6g}"
                )

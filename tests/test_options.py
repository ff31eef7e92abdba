"""Options of a bridge, and the setup that they resolve to without any device being started."""

from __future__ import annotations

import ast
import inspect
import itertools
import math
import re
from collections.abc import Callable, Iterator
from dataclasses import asdict, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hapticbridge.arguments import label, members, rule_of, types_of
from hapticbridge.clock import RealClock, SimulatedClock
from hapticbridge.coupling import Coupling
from hapticbridge.demand.certificate import default_coupling
from hapticbridge.demand.guard import Limits
from hapticbridge.device import AXES, DeviceInfo, Hand, Motion, SimulatedDevice
from hapticbridge.errors import CouplingError, DeviceError, HapticBridgeError
from hapticbridge.kernel.parameters import ENVIRONMENT, GuardParameters, RunParameters
from hapticbridge.run import options
from hapticbridge.run.bridge import Bridge
from hapticbridge.run.options import BridgeOptions, RunSetup, Workspace
from hapticbridge.scene import Scene, load_scene
from hapticbridge.whatif.settings import CHANGEABLE, KEPT

REAL = DeviceInfo(
    name="arm", axes=AXES, force_limit=10.0, mass=0.1, damping=2.0, rotational_damping=2e-3
)
SIMULATED = DeviceInfo(name="model", axes=AXES, force_limit=10.0, damping=2.0, is_real=False)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene("point_mass")


def test_a_stated_delay_beyond_all_couplings_is_named_with_the_longest(scene: Scene) -> None:
    info = replace(SIMULATED, delay=0.1, is_delay_measured=True)
    clock = SimulatedClock()
    with pytest.raises(DeviceError, match="states a delay of 100 ms, and at 1000 Hz a coupling is"):
        RunSetup.resolve(scene, info, None, BridgeOptions(), clock)
    RunSetup.resolve(scene, replace(info, delay=0.05), None, BridgeOptions(), clock)
    RunSetup.resolve(scene, info, None, BridgeOptions(rate=500.0), clock)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"rate": 0.5}, "rate is 0.5 Hz; it must be 1 to 1000000"),
        *(({"substeps": number}, "substeps is") for number in (0, 2.5, 101)),
        ({"substeps": 2, "method": "lossless"}, "so it must be 1"),
        ({"method": "magic"}, "no method is called 'magic'; methods: "),
        ({"controller": "magic"}, "must be one of 'damper', 'environment', 'off'"),
        ({"clutch": -1}, "clutch is -1; it must be a whole number, 0 to 31"),
        ({"dead_man": 99}, "dead man is 99"),
        ({"mark": True}, "mark is True"),
        ({"clutch": 1, "dead_man": 1}, "both button 1; they exclude each other"),
    ],
)
def test_an_impossible_option_is_refused_when_it_is_made(
    values: dict[str, Any], message: str
) -> None:
    with pytest.raises(HapticBridgeError, match=re.escape(message)):
        BridgeOptions(**values)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Coupling(1.0, 1.0, -1.0, 0.1), "coupling rotational stiffness is -1"),
        (lambda: Coupling(1.0, 1.0, 1.0, math.nan), "coupling rotational damping is nan"),
        (lambda: Workspace(force_scale=0.0), "force scale is 0.0"),
        (lambda: Limits(force=1.0, torque=1.0, stretch=0.0), "stretch limit is 0.0 m"),
        (lambda: Limits(force=1.0, torque=1.0, angle=4.0), "angle limit is 4 rad"),
        (lambda: GuardParameters(hold_force=0.0), "guard: hold force is 0.0"),
        (lambda: GuardParameters(max_damping=-1.0), "guard: max damping is -1.0"),
        (lambda: GuardParameters(fade_ticks=0), "guard: fade ticks is 0"),
    ],
)
def test_a_refusal_names_a_quantity_in_words(make: Callable[[], object], message: str) -> None:
    with pytest.raises(HapticBridgeError, match=message) as refused:
        make()
    assert "_" not in str(refused.value)


@pytest.mark.parametrize(
    ("info", "options", "clock", "message"),
    [
        (REAL, BridgeOptions(), SimulatedClock(), "moves in real time"),
        (REAL, BridgeOptions(method="explicit"), RealClock(), "on a real device"),
        (SIMULATED, BridgeOptions(mark=0), RealClock(), "button 0 is to mark"),
        (SIMULATED, BridgeOptions(realtime=True), SimulatedClock(), "exclude each other"),
        (
            SIMULATED,
            BridgeOptions(limits=Limits(force=11.0, torque=0.1)),
            RealClock(),
            "force limit is 11 N; device 'model' allows at most 10 N",
        ),
        (SIMULATED, BridgeOptions(contact_stiffness=1e3), RealClock(), "only 'direct' takes it"),
    ],
)
def test_what_device_clock_and_options_cannot_do_together_is_refused(
    scene: Scene, info: DeviceInfo, options: BridgeOptions, clock: RealClock, message: str
) -> None:
    with pytest.raises(HapticBridgeError, match=re.escape(message)):
        RunSetup.resolve(scene, info, None, options, clock, is_recorded=False)


def test_a_loop_that_a_device_states_and_lacks_is_refused(scene: Scene) -> None:
    device = SimulatedDevice()
    Bridge(scene, device, clock=SimulatedClock())
    device.info = replace(device.info, loop_period=1e-4, loop_delay=1e-5)
    with pytest.raises(DeviceError, match="'simulated' states loop_period, a loop of its own, but"):
        Bridge(scene, device, clock=SimulatedClock())


def test_a_setup_holds_the_choices_that_were_left_open(scene: Scene) -> None:
    timely = replace(REAL, delay=0.0, is_delay_measured=True)
    setup = RunSetup.resolve(scene, timely, None, BridgeOptions(), RealClock())
    assert (setup.method.name, setup.period) == ("lossless", 1e-3)
    assert setup.coupling.stiffness == pytest.approx(2400.0)  # 80 % of 2 (b - b/4) / T
    unknown = RunSetup.resolve(scene, REAL, None, BridgeOptions(), RealClock())
    stated = RunSetup.resolve(scene, replace(REAL, delay=0.0), None, BridgeOptions(), RealClock())
    assert setup.coupling.stiffness > unknown.coupling.stiffness == stated.coupling.stiffness
    expected = Coupling(2400.0, 0.5, 2.4, 5e-4)
    assert asdict(setup.law) == pytest.approx(asdict(expected), rel=1e-12)
    assert setup.attainable == setup.coupling
    assert (setup.limits.force, setup.guard.controller) == (10.0, ENVIRONMENT)
    assert (setup.is_realtime, setup.is_pipelined) == (True, True)
    simulated = RunSetup.resolve(scene, SIMULATED, None, BridgeOptions(), SimulatedClock())
    assert (simulated.is_realtime, simulated.is_pipelined) == (False, False)


def test_the_force_scale_is_by_default_that_of_the_motion() -> None:
    assert Workspace(scale=2.0).scales == (2.0, 2.0)
    assert Workspace(scale=2.0, force_scale=0.5).scales == (2.0, 0.5)
    assert Workspace(axes=[[0, -1, 0], [1, 0, 0], [0, 0, 1]]).rotation[:3] == (0.0, -1.0, 0.0)


def test_keywords_of_a_bridge_are_the_fields_of_its_options() -> None:
    bridge = Bridge("point_mass", substeps=2, clock=SimulatedClock())
    assert bridge.request.options == BridgeOptions(substeps=2, rate=1000.0)


@pytest.mark.parametrize(
    ("sheet", "chosen", "rate"),
    [
        ({}, {}, 1000.0),
        ({"rate": 125.0, "delay": 0.0}, {}, 125.0),
        ({"rate": 999.4, "delay": 0.0}, {}, 999.4),
        ({"rate": 500.0, "delay": 2.1e-3}, {}, 500.0),
        ({"rate": 0.5, "delay": 0.0}, {}, 1.0),
        ({"rate": 999.9999999999991, "delay": 0.0}, {}, 1000.0),
        ({"rate": 4000.0, "delay": 0.0}, {}, 1000.0),
        ({"rate": 125.0, "delay": None}, {}, 1000.0),  # its samples may be a period old
        ({"rate": 125.0, "delay": 0.0, "is_prescribed": True}, {}, 1000.0),
        ({"rate": 125.0, "delay": 0.0}, {"rate": 1000.0}, 1000.0),
        ({"rate": 125.0, "delay": 0.0}, {"substeps": 1}, 1000.0),
        ({"rate": 125.0, "delay": 0.0}, {"scene_rate": 1000.0}, 1000.0),
        ({"rate": 125.0, "delay": 0.0}, {"method": "weld"}, 1000.0),
    ],
)
def test_the_loop_takes_the_rate_of_a_slower_device_which_is_stiffer(
    sheet: dict[str, Any], chosen: dict[str, Any], rate: float
) -> None:
    info, own_options = replace(REAL, **sheet), BridgeOptions(**chosen)
    assert own_options.for_devices([info]).loop_rate == rate
    if 1.0 < rate < 1000.0:
        usual, own = (default_coupling(info, 1.0 / each).stiffness for each in (1000.0, rate))
        assert own > 1.1 * usual
        fast = replace(info, rate=2000.0)  # it holds one force for half a tick
        assert own_options.for_devices([info, fast]).loop_rate == 1000.0
        half = replace(info, rate=0.5 * rate)
        assert own_options.for_devices([half, info]).loop_rate == rate


def test_a_coupling_without_rotational_gains_is_one_around_the_grip() -> None:
    assert Coupling(2400.0, 0.5) == Coupling(2400.0, 0.5, 2.4, 5e-4)
    assert Coupling(2400.0, 0.5, 0.0, 0.0).rotational_stiffness == 0.0
    for missing in (None, float("nan")):
        with pytest.raises(CouplingError, match="must be finite and >= 0"):
            Coupling(2400.0, 0.5, missing, 0.0)  # type: ignore[arg-type] # on purpose


WRONG = ["x", b"x", None, math.nan, [1.0], {}, object(), 10**320, 1 + 2j, -1.0, 0]
"""Values of other kinds and sizes than a public constructor takes for most of its arguments."""

PUBLIC: list[tuple[type[Any], dict[str, Any]]] = [
    (Limits, {"force": 5.0, "torque": 0.5}),
    (Workspace, {}),
    (Coupling, {"stiffness": 1000.0, "damping": 1.0}),
    (BridgeOptions, {}),
    (DeviceInfo, {"name": "d", "axes": ("x", "y", "z"), "force_limit": 5.0}),
    (Hand, {}),
    (Motion, {"times": [0.0, 1.0], "positions": [[0.0, 0.0, 0.0]] * 2}),
    (SimulatedDevice, {}),
]


@pytest.mark.parametrize(("made", "valid"), PUBLIC, ids=lambda item: getattr(item, "__name__", ""))
def test_a_wrong_value_is_refused_in_a_sentence(made: type[Any], valid: dict[str, Any]) -> None:
    refused = 0
    for name, value in itertools.product(inspect.signature(made).parameters, WRONG):
        try:
            made(**valid | {name: value})
        except HapticBridgeError as error:
            refused += 1
            assert len(str(error)) < 480 and "\n" not in str(error)
    assert refused > 0.5 * len(WRONG) * len(inspect.signature(made).parameters)


NUMBERS = {int: -1, float: math.nan, str: "", bool: "yes"}
"""A value of another kind, or one that no rule admits, by the type of a field."""


def bad_values() -> Iterator[tuple[type[Any], dict[str, Any], str, Any, str]]:
    """Yields for each field of a public class with a rule a value that it refuses, and its unit."""
    for made, valid in PUBLIC:
        if not is_dataclass(made) or made.__name__ == "Motion":
            continue
        for each in fields(made):
            if each.name == "axes":  # refused by a rule of their own
                continue
            kinds, rule = members(types_of(made)[each.name], is_stored=False), rule_of(each)
            found = {kind: NUMBERS[kind] for kind in kinds if kind in NUMBERS}
            if str in found and not rule.is_filled:  # any text is one
                found[str] = 3
            for value in found.values():
                yield made, valid, each.name, value, rule.unit


BAD = list(bad_values())


@pytest.mark.parametrize(
    ("made", "valid", "name", "value", "unit"), BAD, ids=lambda item: getattr(item, "__name__", "")
)
def test_a_bad_value_is_named_with_its_field_unit_and_what_is_valid(
    made: Any, valid: dict[str, Any], name: str, value: Any, unit: str
) -> None:
    [each] = [each for each in fields(made) if each.name == name]
    with pytest.raises(HapticBridgeError) as refused:
        made(**valid | {name: value})
    unit = f" {unit}" if unit and not isinstance(value, str) else ""
    said = f"{label(each)} is {value!r}{unit}; it must be "
    assert said in str(refused.value) and not str(refused.value).endswith("be ")
    assert any(word in str(refused.value) for word in VALID)


VALID = ("finite", "> 0", "to", "a whole number", "True or False", "a text", "one of")
"""Words of which a sentence on what is valid has some."""


def test_a_number_is_stored_as_a_plain_one() -> None:
    made = Limits(force=np.float32(3), ramp=np.int64(1))  # type: ignore[arg-type] # on purpose
    assert (type(made.force), type(made.ramp)) == (float, float)
    assert type(BridgeOptions(substeps=np.int16(2)).substeps) is int  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["scale", "rate", "rotational_damping", "force_limit", "method"])
def test_a_what_if_takes_its_names_from_the_fields(name: str) -> None:
    kind, each = CHANGEABLE[name]
    assert (rule_of(each).flag or each.name).replace("-", "_") == name
    assert kind in (BridgeOptions, Workspace, Limits, Coupling)


def test_a_what_if_changes_every_option_or_says_why_not() -> None:
    every = {
        (rule_of(each).flag or each.name).replace("-", "_")
        for kind in (BridgeOptions, Workspace, Limits, Coupling)
        for each in fields(kind)
    }
    assert every == {*CHANGEABLE, *KEPT, "workspace", "limits"}
    assert all(KEPT.values())


UNSET = {"is_beside": "only a slower scene's own loop is"}
"""Parameters of a run that its setup leaves at their default, each with the reason."""


def test_a_setup_sets_every_parameter_of_a_run() -> None:
    """A parameter that the setup forgets would have its default, whatever the option says."""
    tree = ast.parse(inspect.getsource(options))
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    [made] = [node for node in calls if ast.unparse(node.func) == "RunParameters"]
    assert {word.arg for word in made.keywords} == {
        each.name for each in fields(RunParameters) if each.name not in UNSET
    }


READ_IN_A_LOOP = {"force", "torque"}
"""Limits that are read by a name in a loop."""


@pytest.mark.parametrize("kind", [BridgeOptions, Limits])
def test_every_option_is_read(kind: Any) -> None:
    """An option that is declared, recorded and asked for again, but never used, fails here."""
    package = Path(options.__file__).parents[1]
    files = (path for name in ("run", "demand") for path in (package / name).glob("*.py"))
    source = "".join(path.read_text(encoding="utf-8") for path in files)
    read = set(re.findall(r"\b(?:options|limits)\.(\w+)", source)) | READ_IN_A_LOOP
    inside = set(re.findall(r"\bself\.(\w+)", inspect.getsource(kind)))
    assert {each.name for each in fields(kind)} <= read | inside

"""Every attribute of MJCF, one by one: kept as MuJoCo compiles it, or changed and said."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from test_scene_treatment import schema

import hapticbridge as hb
from hapticbridge.demand.methods import IMPLICIT, prepare
from hapticbridge.scene.treatment import TREATMENTS

ARM = """<body name="arm" pos="1 0 1"><joint name="j" axis="0 1 0"/><geom name="ga" size=".05"
mass=".2"/><site name="sa" pos=".3 0 0"/></body>"""
LEG = """<body name="leg" pos="2 0 1"><joint name="k" axis="0 1 0"/><geom name="gl" size=".05"
mass=".2"/><site name="sl" pos=".3 0 0"/></body>"""
TETRA = 'vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"'
CLOTH = '<flexcomp name="f" type="grid" count="3 3 {}" spacing=".1 .1 .1" pos="0 2 1" mass=".1" '
PASSIVE = '<option integrator="discrete"/>'
TENDONS = """<tendon><spatial name="t"><site site="sa"/><site site="sl"/></spatial>
<fixed name="u"><joint joint="j" coef="1"/></fixed></tendon>"""


def scene(more: str = "", world: str = "") -> str:
    """Returns a scene with a held tool, two swinging bodies, and elements of a test."""
    return f"""<mujoco>{more}<worldbody><body name="tool" pos="0 0 1"><freejoint/>
<geom size=".02" mass=".1"/><site name="grip"/></body>{ARM}{LEG}{world}</worldbody></mujoco>"""


def asset(text: str, world: str = "") -> str:
    return scene(f"<asset>{text}</asset>", world)


def hung(text: str) -> str:
    """Returns a scene in which an element is part of a body."""
    body = f'<body name="b" pos="0 3 1">{text}<geom size=".05" mass=".1"/></body>'
    return scene("", body)


def actuated(kind: str) -> str:
    more = {
        "cylinder": 'timeconst="1"', "muscle": 'lengthrange="0 1"', "damper": 'ctrlrange="0 1"',
        "intvelocity": 'actrange="-1 1"', "dcmotor": 'motorconst="1" resistance="1"',
    }  # fmt: skip
    target = {"adhesion": 'body="arm" ctrlrange="0 1"', "orientation": 'joint="ball"'}
    world = '<body pos="0 3 1"><joint name="ball" type="ball"/><geom size=".05" mass=".1"/></body>'
    words = (kind, target.get(kind, 'joint="j"'), more.get(kind, ""), "@/>")
    return scene(f"{TENDONS}<actuator><{' '.join(words)}</actuator>", world).replace(
        'name="j"', 'name="j" range="-50 50"'
    )


def sensed(kind: str, target: str) -> str:
    return scene(f"<sensor><{kind} {target} @/></sensor>")


ACTUATORS = (
    "general", "motor", "position", "velocity", "intvelocity", "orientation", "pid", "damper",
    "cylinder", "muscle", "adhesion", "dcmotor",
)  # fmt: skip
FLEX = """<deformable><flex name="f" dim="2" body="tool arm leg world" element="0 1 2 1 3 2"
vertex="0 0 0 0 0 0 0 0 0 0 0 0" @>#</flex></deformable>"""

SCENES = {
    "compiler": scene(
        "<compiler @/>",
        """<body pos="0 3 1" euler="10 20 30"><joint range="-1 1"/><inertial pos="0 0 0" mass="1"
        diaginertia="1 1 1"/><geom size=".05"/><geom size=".02" contype="0" conaffinity="0"
        group="1"/><body><geom size=".01" mass=".1"/></body></body>""",
    ),
    "compiler/lengthrange": scene(
        '<compiler><lengthrange @/></compiler><option integrator="discrete"/>'
        '<actuator><muscle joint="j"/></actuator>'
    ).replace('"j" axis', '"j" range="-50 50" axis'),
    "option": scene("<option @/>"),
    "option/flag": scene("<option><flag @/></option>"),
    "size": scene("<size @/>"),
    "statistic": scene("<statistic @/>"),
    **{
        f"visual/{name}": scene(f"<visual><{name} @/></visual>")
        for name in ("global", "quality", "headlight", "map", "scale", "rgba")
    },
    "asset/mesh": asset(f'<mesh name="m" {TETRA} @/>', '<geom type="mesh" mesh="m"/>'),
    "asset/hfield": asset(
        '<hfield name="h" nrow="2" ncol="2" size="1 1 .1 .1" @/>',
        '<geom type="hfield" hfield="h"/>',
    ),
    "asset/texture": asset(
        '<texture name="x" type="2d" builtin="checker" width="8" height="8" @/>'
    ),
    "asset/material": asset(
        '<texture name="x" type="2d" builtin="flat" width="8" height="8"/><material name="m" @/>'
    ),
    "body": scene("", '<body name="b" pos="0 3 1" @><geom size=".05" mass=".1"/></body>'),
    "body on a joint": hung("<freejoint/>").replace('"0 3 1"', '"0 3 1" @'),
    "body/inertial": scene(
        "",
        '<body pos="0 3 1"><freejoint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1" @/>'
        "</body>",
    ),
    "body/joint": hung('<joint name="i" @/>'),
    "body/freejoint": hung('<freejoint name="i" @/>'),
    "body/geom": hung('<joint/><geom name="g" type="box" size=".1 .2 .3" @/>'),
    "body/site": hung('<site name="s" type="box" size=".1 .2 .3" @/>'),
    "body/camera": hung('<camera name="c" @/>'),
    "body/light": hung('<light name="l" @/>'),
    "body/flexcomp": scene("", CLOTH.format(1) + '@><contact selfcollide="none"/></flexcomp>'),
    "body/flexcomp/edge": scene("", CLOTH.format(1) + 'dim="2"><edge @/></flexcomp>'),
    "body/flexcomp/elasticity": scene(
        "",
        CLOTH.format(1) + 'dim="2"><elasticity young="9" thickness=".1" elastic2d="bend" @/>'
        "</flexcomp>",
    ),
    "body/flexcomp/elasticity of a line": scene(
        "",
        CLOTH.format(1).replace("3 3", "3 1") + 'dim="1"><elasticity young="9" shear="5" '
        'section="box" sectionsize=".01 .01" @/></flexcomp>',
    ),
    "body/flexcomp/contact": scene(PASSIVE, CLOTH.format(1) + 'dim="2"><contact @/></flexcomp>'),
    "body/flexcomp/pin": scene("", CLOTH.format(1) + 'dim="2"><pin @/></flexcomp>'),
    "deformable/flex": scene(FLEX.replace("#", "")),
    "deformable/flex/contact": scene(PASSIVE + FLEX.replace("@", "").replace("#", "<contact @/>")),
    "deformable/flex/edge": scene(FLEX.replace("@", "").replace("#", "<edge @/>")),
    "deformable/flex/elasticity": scene(
        FLEX.replace("@", "").replace("#", '<elasticity young="100" @/>')
    ),
    "deformable/skin": scene(
        '<deformable><skin name="s" vertex="0 0 0 1 0 0 0 1 0" face="0 1 2" @><bone body="tool" '
        'bindpos="0 0 0" bindquat="1 0 0 0" vertid="0 1 2" vertweight="1 1 1"/></skin></deformable>'
    ),
    "contact/pair": scene('<contact><pair name="p" geom1="ga" geom2="gl" @/></contact>'),
    "tendon/spatial": scene(TENDONS.replace('"t"', '"t" @')),
    "tendon/fixed": scene(TENDONS.replace('"u"', '"u" @')),
    "tendon/fixed/joint": scene(TENDONS.replace(' coef="1"', ' coef="1" @')),
    "tendon/spatial/pulley": scene(
        TENDONS.replace(
            "</spatial>",
            '<pulley divisor="1" @/><site site="sa"/><site site="sl"/></spatial>',
        )
    ),
    "equality/connect": scene(
        '<equality><connect body1="arm" body2="leg" anchor="0 0 0" @/></equality>'
    ),
    "equality/weld": scene('<equality><weld body1="arm" body2="leg" @/></equality>'),
    "equality/joint": scene('<equality><joint joint1="j" joint2="k" @/></equality>'),
    "equality/tendon": scene(
        TENDONS + '<equality><tendon tendon1="t" tendon2="u" @/></equality>'
    ),
    "equality/flex": scene(
        '<equality><flex flex="f" @/></equality>', CLOTH.format(1) + 'dim="2"/>'
    ),
    **{f"actuator/{kind}": actuated(kind) for kind in ACTUATORS},
    "sensor/jointpos": sensed("jointpos", 'joint="j"'),
    "sensor/rangefinder": sensed("rangefinder", 'site="sa"'),
    "sensor/contact": sensed("contact", ""),
    "sensor/user": sensed("user", 'dim="1"'),
    "custom/numeric": scene('<custom><numeric name="n" data="1" @/></custom>'),
    "custom/text": scene('<custom><text name="n" data="1" @/></custom>'),
    "custom/tuple/element": scene(
        '<custom><tuple name="n"><element objtype="body" objname="arm" @/></tuple></custom>'
    ),
    "keyframe/key": scene(
        '<actuator><general joint="j" dyntype="integrator"/></actuator>'
        '<keyframe><key name="k" @/></keyframe>',
        '<body mocap="true"/>',
    ),
}  # fmt: skip
"""A scene for each element, with a place for one attribute more."""

SHORTCUTS = {f"actuator/{kind}" for kind in ACTUATORS[1:]}

WITHOUT_SCENE = (
    "/extension", "/plugin", "/skin", "/material/layer", "/asset/model", "/attach", "/exclude",
    "/spatial/site", "/spatial/geom", "/flexstrain", "/custom/tuple", "/sensor/", "/default",
)  # fmt: skip
"""Parts of the paths of elements without a scene: plugins, drawing, references alone; sensors read
the motion and share their attributes, and defaults are those of the elements."""

USUAL = (
    "0.3", "3", "true", "false", "enable", "disable", "0.2 0.3", "-1 1", "2 3", "0.1 0.2 0.3",
    "0.6 0.8 0 0", "0.1 0.2 0.3 0.4", "1 0 0 0 1 0", "0 0 1 1 0 0", "0.8 0.9 0.002",
    "0.01 0.02 0.03 0.04 0.05", "pos vel", "quat", "voltage",
)  # fmt: skip
"""Values, of which the first that MuJoCo takes and that changes the model is tried."""

LIMITED = 'limited="true" range="-1 1"'
VALUES = {
    "compiler angle": 'angle="radian"',
    "compiler inertiafromgeom": 'inertiafromgeom="true"',
    "compiler inertiagrouprange": 'inertiagrouprange="1 2" boundmass="1" boundinertia="1"',
    "compiler discardvisual": 'discardvisual="true"',
    "compiler fusestatic": 'fusestatic="true"',
    "compiler eulerseq": 'eulerseq="ZYX"',
    "lengthrange timestep": 'timestep="0.02"',
    "lengthrange mode": 'mode="none"',
    "option cone": 'cone="elliptic"',
    "option integrator": 'integrator="implicit"',
    "option jacobian": 'jacobian="sparse"',
    "option solver": 'solver="CG"',
    "size memory": 'memory="30M"',
    "mesh inertia": 'inertia="shell"',
    "mesh maxhullvert": 'maxhullvert="5" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1 .1 .1 .1 .1 0 .1"',
    "texture type": 'type="cube"',
    "texture builtin": 'builtin="gradient"',
    "texture mark": 'mark="edge"',
    "texture markrgb": 'markrgb="1 0 0" mark="edge"',
    "texture colorspace": 'colorspace="sRGB"',
    "texture random": 'random="0.9" mark="random"',
    "material texture": 'texture="x"',
    "inertial fullinertia": 'fullinertia="1 1.2 1.1 .1 0 0" diaginertia=""',
    "body sleep": 'sleep="never" mocap=""',
    "joint actuatorfrclimited": 'actuatorfrclimited="true" actuatorfrcrange="-1 1"',
    "spatial actuatorfrclimited": 'actuatorfrclimited="true" actuatorfrcrange="-1 1"',
    "fixed actuatorfrclimited": 'actuatorfrclimited="true" actuatorfrcrange="-1 1"',
    "joint limited": LIMITED,
    "spatial limited": LIMITED,
    "fixed limited": LIMITED,
    "joint type": 'type="slide"',
    "geom type": 'type="ellipsoid"',
    "site type": 'type="ellipsoid"',
    "geom fluidshape": 'fluidshape="ellipsoid"',
    "geom fluidcoef": 'fluidcoef="1 1 1 1 1" fluidshape="ellipsoid"',
    "condim": 'condim="6"',
    "camera mode": 'mode="trackcom"',
    "camera output": 'output="depth"',
    "camera projection": 'projection="orthographic"',
    "camera focal": 'focal="1 1" sensorsize="1 1" resolution="9 9"',
    "camera focalpixel": 'focalpixel="1 1" sensorsize="1 1" resolution="9 9"',
    "camera principal": 'principal="1 1" sensorsize="1 1" resolution="9 9" focal="1 1"',
    "camera principalpixel": ('principalpixel="1 1" sensorsize="1 1" resolution="9 9" focal="1 1"'),
    "camera target": 'target="arm" mode="targetbody"',
    "light mode": 'mode="trackcom"',
    "light target": 'target="arm" mode="targetbody"',
    "light type": 'type="point"',
    "flexcomp count": 'count="4 3 1"',
    "flexcomp dim": 'dim="1" count="3 1 1"',
    "flexcomp radius": 'radius="0.02"',
    "body/flexcomp/edge solref": 'solref="0.1 1" equality="true"',
    "body/flexcomp/edge solimp": 'solimp="0.8 0.9 0.1" equality="true"',
    "elasticity elastic2d": 'elastic2d="both"',
    "elasticity section": 'section="circle" sectionsize=""',
    "contact selfcollide": 'selfcollide="sap"',
    "contact margin": 'margin="0.01"',
    "connect site1": 'site1="sa" site2="sl" body1="" body2="" anchor=""',
    "weld site1": 'site1="sa" site2="sl" body1="" body2=""',
    "weld relpose": 'relpose="1 0 0 1 0 0 0"',
    "delay": 'delay="0.01" nsample="9"',
    "interp": 'interp="linear" delay="0.01" nsample="9"',
    "ctrllimited": 'ctrllimited="true" ctrlrange="-1 1"',
    "forcelimited": 'forcelimited="true" forcerange="-1 1"',
    "actlimited": 'actlimited="true" actrange="-2 2" dyntype="integrator"',
    "intvelocity actlimited": 'actlimited="false" actrange="0 0"',
    "intvelocity inheritrange": 'inheritrange="1" actrange=""',
    "orientation forcerange": 'forcerange="0 1"',
    "orientation forcelimited": 'forcelimited="true" forcerange="0 1"',
    "orientation site": 'site="sa" refsite="sl" joint=""',
    "velrange": 'velrange="-1 1" input="pos vel"',
    "ffrange": 'ffrange="-1 1" input="pos ff"',
    "general actrange": 'actrange="-1 1" dyntype="integrator"',
    "general actdim": 'actdim="3" dyntype="user"',
    "dyntype": 'dyntype="filter"',
    "gaintype": 'gaintype="affine"',
    "biastype": 'biastype="affine"',
    "inheritrange": 'inheritrange="1"',
    "refsite": 'site="sa" refsite="sl" joint=""',
    "site": 'site="sa" joint=""',
    "tendon": 'tendon="t" joint=""',
    "jointinparent": 'jointinparent="j" joint=""',
    "cranklength": 'cranksite="sa" slidersite="sl" cranklength="2" joint=""',
    "imax": 'imax="2" ki="1"',
    "rangefinder data": 'data="dist normal"',
    "rangefinder site": 'site="sl"',
    "contact data": 'data="force"',
    "contact reduce": 'reduce="mindist"',
    "contact body1": 'body1="arm"',
    "contact geom1": 'geom1="ga"',
    "contact subtree1": 'subtree1="arm"',
    "contact site": 'site="sa"',
    "user datatype": 'datatype="positive"',
    "user needstage": 'needstage="pos"',
    "user objtype": 'objtype="body" objname="arm"',
}
"""Values of attributes that take no usual one or need another attribute."""


def with_attributes(element: str, words: str) -> str:
    """Returns the scene of an element with attributes in place of those it has; "" removes."""
    before, after = SCENES[element].split("@", 1)
    start = before.rfind("<")
    own = before[start:]
    for name in re.findall(r'(\w+)="', words):
        own = re.sub(rf' {name}="[^"]*"', "", own)
    return before[:start] + own + " " + re.sub(r'\w+=""', "", words) + after.replace("@", "")


TEXT = (
    "angle assetdir meshdir texturedir strippath name class childclass file content_type "
    "fileback filedown filefront fileleft fileright fileup material mesh hfield texture "
    "vertex face texcoord element elemtexcoord node nodecoord body body1 body2 geom1 geom2 "
    "site site2 subtree2 joint joint1 joint2 tendon1 tendon2 flex camera cranksite slidersite "
    "objname objtype"
)
"""Attributes without a value of their own: names, references, files and their content."""

WITHOUT_FIELD = {
    "compiler": "alignfree autolimits balanceinertia conflict coordinate fitaabb passthrough "
    "savecanonical savecompiled saveinertial usethread",
    "compiler/lengthrange": "interval inttotal maxforce timeconst tolrange useexisting",
    "visual/rgba": "bv bvactive",
    "asset/mesh": "builtin params",
    "asset/texture": "embed gridlayout gridsize hflip nchannel vflip",
    "body": "fuse sleep",
    "body on a joint": "fuse mocap",
    "body/freejoint": "align",
    "body/geom": "fitscale",
    "body/flexcomp": "cellcount dof origin scale type",
    "body/flexcomp/edge": "stiffness",
    "body/flexcomp/pin": "gridrange",
    "body/flexcomp/elasticity": "section sectionsize shear",
    "body/flexcomp/elasticity of a line": "elastic2d poisson thickness yield",
    "deformable/flex": "cellcount dim dof",
    "deformable/flex/edge": "stiffness",
    "deformable/flex/elasticity": "elastic2d poisson section sectionsize shear thickness young",
    "actuator/general": "ffrange inheritrange velrange",
    "actuator/dcmotor": "controller",
    "keyframe/key": "plastic",
}
"""Attributes that change nothing in the compiled model of their scene here: MuJoCo reads them in
compilation, or they belong to another kind of element."""

SUMS = ("name", "stat.", "nbuffer", "nJ", "nmocap", "nnames", "npaths", "narena", "nu", "nbody")
"""Beginnings of the names of values that MuJoCo sums up over the whole model."""

IN_TABLE_ALONE = {
    "delays",  # their time stays as it was
    "energy",
    "actuation",
    "autoreset",
    "gap",
    "margin",
    "edges",
    "eulerdamp",
    "sleep policy",
}
"""Subjects of changes that move nothing, or that lines of a run tell otherwise."""

SLEEP = {"tree_sleep_policy"}
DERIVED = {"rigid": {"body_margin", "geom_margin", *SLEEP}, "scene": SLEEP}
"""Values that rigid contacts change for all elements, or that follow from sleep, by the contact."""

FLAGS = {"disableflags": mujoco.mjtDisableBit, "enableflags": mujoco.mjtEnableBit}


@cache
def places() -> tuple[str, ...]:
    """Returns the places of numbers and arrays in a model, with dots for its parts."""
    return tuple(_places(mujoco.MjModel.from_xml_string(scene()), ""))


def _places(part: Any, prefix: str) -> Iterator[str]:
    for name in (each for each in dir(part) if not each.startswith("_")):
        value = getattr(part, name)
        if isinstance(value, np.ndarray | int | float) and name not in (*FLAGS, "signature"):
            yield prefix + name
        elif type(value).__module__.startswith("mujoco") and not callable(value):
            yield from _places(value, f"{prefix}{name}.")


def values(model: mujoco.MjModel) -> dict[str, Any]:
    """Returns numbers and arrays of a compiled model by name, and flags one by one."""
    found = dict(zip(places(), attrgetter(*places())(model), strict=True))
    for name, bits in FLAGS.items():
        flags = getattr(model.opt, name)
        found |= {f"flag {bit}": bool(flags & value) for bit, value in bits.__members__.items()}
    return found


def differing(own: dict[str, Any], other: dict[str, Any]) -> set[str]:
    """Returns names of values that differ, of arrays in the part that ``own`` has."""
    found = set()
    for name, value in own.items():
        first, second = np.asarray(value), np.asarray(other[name])
        if first.ndim == second.ndim:
            second = second[tuple(slice(size) for size in first.shape)]
        if np.array_equal(first, second):
            continue
        if first.shape != second.shape or not np.allclose(first, second, 1e-6, 1e-12, True):
            found.add(name)
    return found


def compiled(text: str) -> dict[str, Any] | None:
    """Returns the values of the model that MuJoCo compiles; None for a scene that it refuses."""
    try:
        return values(mujoco.MjModel.from_xml_string(text))
    except ValueError:
        return None


def tried(element: str, attribute: str) -> tuple[str, dict[str, Any], set[str]] | None:
    """Returns attributes that set one, what MuJoCo compiles with them, and what they change."""
    path = path_of(element)
    keys = (f"{path} {attribute}", f"{path.rpartition('/')[2]} {attribute}", attribute)
    own = next((VALUES[key] for key in keys if key in VALUES), None)
    usual = compiled(SCENES[element].replace("@", ""))
    assert usual is not None, element
    own_part = {"size": ("name", "stat.", "nbuffer", "nnames"), "statistic": ("name",)}
    left_out = own_part.get(path, SUMS)
    for words in [own] if own else [f'{attribute}="{value}"' for value in USUAL]:
        if (with_it := compiled(with_attributes(element, words))) is None:
            continue
        changed = differing(usual, with_it) | differing(with_it, usual)
        if changed := {name for name in changed if not name.startswith(left_out)}:
            return words, with_it, changed
    return None


def attributes(element: str) -> list[str]:
    """Returns the attributes to try: of an actuator, those that no ``general`` has too."""
    shared = schema()["mujoco/actuator/general"] if element in SHORTCUTS else ()
    tested_elsewhere = ("ipc", *shared)
    return [name for name in schema()[f"mujoco/{path_of(element)}"] if name not in tested_elsewhere]


def path_of(element: str) -> str:
    return element.partition(" ")[0]


def subjects(element: str, words: str, contact: str) -> set[str]:
    """Returns subjects of the table by which attributes of an element may differ in a run."""
    path, names = f"/mujoco/{path_of(element)}", re.findall(r'(\w+)="', words)
    # those of each actuator and sensor, in one line of the table
    delays = {"delays"} if "nsample" in names else set()
    return delays | {
        subject
        for subject, each in TREATMENTS.items()
        if (contact == "rigid" or not each.is_rigid) and each.act != "kept, and said"
        for place, name in each.settings
        if name in names and path.endswith(f"/{place}")
    }


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("element", SCENES)
def test_each_attribute_is_kept_or_is_changed_and_said(tmp_path: Path, element: str) -> None:
    path, wrong = tmp_path / "scene.xml", list[str]()
    without = WITHOUT_FIELD.get(element, "").split()
    for attribute in attributes(element):
        found = tried(element, attribute)
        if found is None:
            if attribute not in (*without, *TEXT.split()):
                wrong.append(f"{attribute}: no value changes the model")
            continue
        wrong += [f"{attribute} changes the model"] if attribute in without else []
        words, own, fields = found
        path.write_text(with_attributes(element, words))
        for contact in ("rigid", "scene"):
            scene = hb.load_scene(path)
            method = replace(IMPLICIT, is_rigid=contact == "rigid")
            prepare(scene, hb.Coupling(500.0, 2.0, 0.2, 0.01), 0.001, 1, method)
            new = values(scene.model)
            differ = differing({name: own[name] for name in fields - DERIVED[contact]}, new)
            said = {change.subject for change in scene.differences} | IN_TABLE_ALONE
            if differ and not subjects(element, words, contact) & said:
                wrong.append(f"{words} with {contact} contact: {sorted(differ)}")
    assert wrong == []


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("contact", ["rigid", "scene"])
@pytest.mark.parametrize("element", ["option", "body/joint", "actuator/general", "deformable/flex"])
def test_a_run_changes_no_more_than_its_preparation(
    tmp_path: Path, element: str, contact: str
) -> None:
    path = tmp_path / "scene.xml"
    path.write_text(with_attributes(element, ""))
    prepared = hb.load_scene(path)
    coupling = hb.Coupling(500.0, 2.0, 0.2, 0.01)
    prepare(prepared, coupling, 0.001, 1, replace(IMPLICIT, is_rigid=contact == "rigid"))
    before = values(prepared.model)
    options: dict[str, Any] = {"contact": contact, "method": "implicit", "tool_weight": True}
    clock = hb.SimulatedClock()
    with hb.Bridge(path, "simulated:hand=none", coupling, clock=clock, **options) as bridge:
        bridge.run(duration=0.01)
        more = differing(before, values(bridge.scene.model))
    # where rigid contacts and limits begin to look
    assert {name for name in more if not name.endswith("_margin")} == set()
    assert not more or contact == "rigid"


@pytest.mark.filterwarnings("ignore")
def test_passive_contacts_of_a_flex_become_constraints_or_are_refused_as_is(tmp_path: Path) -> None:
    path = tmp_path / "flex.xml"
    path.write_text(with_attributes("body/flexcomp/contact", 'passive="true"'))
    assert "contacts of flex 'f': passive → constraints" in hb.load_scene(path).changes
    with pytest.raises(hb.SceneError, match="contacts of flex 'f': passive"):
        hb.load_scene(path, as_is=True)
    path.write_text(with_attributes("body/flexcomp/contact", 'passive="false"'))
    assert not any("passive" in each for each in hb.load_scene(path, as_is=True).changes)


def test_each_element_with_attributes_has_a_scene() -> None:
    covered = {f"mujoco/{path_of(element)}" for element in SCENES}
    missing = [path for path, names in schema().items() if names and path not in covered]
    assert [path for path in missing if not any(part in path for part in WITHOUT_SCENE)] == [
        "mujoco"
    ]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", ["general", "site"])
def test_a_default_of_the_scene_leaves_what_the_bridge_adds(tmp_path: Path, kind: str) -> None:
    path, wrong = tmp_path / "scene.xml", list[str]()
    element = {"general": "actuator/general", "site": "body/site"}[kind]
    added = {"general": "actuator_", "site": "site_"}[kind]

    def compiled_part(defaults: str) -> dict[str, Any] | None:
        text = scene(f"<default>{defaults}</default>")
        if (own := compiled(text)) is None:
            return None
        path.write_text(text)
        whole = values(hb.load_scene(path).model)
        names = [name for name in whole if name.startswith(added)]
        return {name: whole[name][len(own[name]) :].copy() for name in names}

    usual, checked = compiled_part(""), 0
    assert usual
    for attribute in schema()[f"mujoco/default/{kind}"]:
        found = tried(element, attribute)
        if found is None or attribute in ("user", "type"):
            continue
        words = re.sub(r' ?\b(joint|site|refsite|cranksite|slidersite)="[^"]*"', "", found[0])
        if part := compiled_part(f"<{kind} {words}/>"):
            checked += 1
            wrong += [words] if differing(usual, part) else []
    assert wrong == []
    assert checked > 8

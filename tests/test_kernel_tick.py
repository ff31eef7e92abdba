"""The compiled tick: its two routes agree, it refuses what is not finite, it reports MuJoCo."""

from __future__ import annotations

import ctypes
import sys
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from kernel_runs import (
    FREE_BALL,
    IDENTITY,
    T,
    at_rest,
    bind,
    fast,
    go_on,
    live,
    load,
    mjcf,
    rotation,
    run_of,
    samples_of,
    sines,
)
from mujoco.introspect import ast_nodes, structs
from scipy.spatial.transform import Rotation

from hapticbridge.errors import HapticBridgeError, SceneError
from hapticbridge.kernel import mujoco_c as native
from hapticbridge.kernel.codes import BAD_RESULT, BAD_SAMPLE, OK, Scheme
from hapticbridge.kernel.handle import handle_pose
from hapticbridge.kernel.record import TICK_DTYPE, TickFlag
from hapticbridge.kernel.tick import HEAD, TAIL, after_step, before_step, publish, simulate
from hapticbridge.scene import load_scene

TURNED = (0.3, -0.2, 0.1, 0.5, 0.5, -0.5, 0.5)


@pytest.mark.parametrize("name", ["point_mass", "peg_in_hole"])
@pytest.mark.parametrize("substeps", [1, 3])
def test_compiled_loop_equals_the_live_one_bit_for_bit(name: str, substeps: int) -> None:
    motion = sines(300, 0.02, 3.0)
    motion[:, 2] -= 0.05 * np.arange(300) / 300
    samples = samples_of(motion, Rotation.from_rotvec(sines(300, 0.2, 2.0)))
    one = live(load_scene(name), samples, substeps=substeps)
    other = fast(load_scene(name), samples, substeps=substeps)
    assert one.ticks.tobytes() == other.ticks.tobytes()
    assert one.binding.slack == other.binding.slack


def test_compiled_loop_agrees_also_where_inputs_change_between_its_calls() -> None:
    world = """
        <body name="tool" pos="0 -1 0"><freejoint/><geom type="sphere" size="0.01" mass="0.1"/>
          <site name="grip"/></body>
        <body name="m" mocap="true"><site name="a"/></body>
        <body name="block" pos="0 0 0.1"><freejoint/><geom type="box" size="0.02 0.03 0.04"/>
          <site name="b"/></body>"""
    rest = """
        <tendon><spatial name="t" range="0 0.1" stiffness="50"><site site="a"/><site site="b"/>
        </spatial></tendon>
        <equality><weld body1="m" body2="block"/></equality>"""
    samples = samples_of(sines(150))

    def move(data: Any) -> None:
        data.mocap_pos[0] = (0.01, 0.0, 0.02)
        data.mocap_quat[0] = (0.8, 0.6, 0.0, 0.0)

    live_run = live(
        mjcf(world, rest), samples, on_tick=lambda k, data: move(data) if k == 100 else None
    )
    scene = load(mjcf(world, rest))
    binding, _ = bind(scene)
    rows = np.zeros(150, TICK_DTYPE)
    assert simulate(binding.state, samples[:100], binding.row, rows[:100]) == 100
    move(scene.data)
    assert simulate(binding.state, samples[100:], binding.row, rows[100:]) == 50
    assert rows.tobytes() == live_run.ticks.tobytes()
    assert abs(rows["external_work"][-1]) > 1e-3


def test_a_second_run_after_a_reset_repeats_the_first_bit_for_bit() -> None:
    scene = load_scene("peg_in_hole")
    samples = samples_of(sines(200, 0.02, 3.0))
    assert fast(scene, samples).ticks.tobytes() == fast(scene, samples).ticks.tobytes()


def test_compiled_loop_stops_where_the_sample_is_bad() -> None:
    scene = load(FREE_BALL)
    binding, _ = bind(scene)
    samples = samples_of(sines(50))
    samples["position"][20, 1] = np.nan
    rows = np.zeros(50, TICK_DTYPE)
    assert simulate(binding.state, samples, binding.row, rows) == 20
    assert rows["tick"][:20].tolist() == list(range(20))
    assert not rows["tool_quaternion"][20:].any()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("position", (np.nan, 0, 0)),
        ("position", (0, np.inf, 0)),
        ("position", (0, 0, -np.inf)),
        ("quaternion", (np.nan, 0, 0, 0)),
        ("quaternion", (1, np.inf, 0, 0)),
        ("quaternion", (0, 0, 0, 0)),
        ("quaternion", (0.1, 0, 0, 0.1)),
    ],
)
def test_bad_sample_is_refused_and_changes_nothing(field: str, value: tuple[float, ...]) -> None:
    scene = load(FREE_BALL)
    binding, parameters = bind(scene)
    run = go_on(run_of(scene, binding, parameters), samples_of(sines(20)))
    samples = samples_of(sines(21)[20:])
    samples[field] = value
    state, row = binding.state.tobytes(), binding.row.tobytes()
    spec = mujoco.mjtState.mjSTATE_INTEGRATION
    before = np.zeros(mujoco.mj_stateSize(scene.model, spec))
    after = before.copy()
    mujoco.mj_getState(scene.model, scene.data, before, spec)
    assert before_step(binding.state, samples, binding.row, 0, T) == BAD_SAMPLE
    mujoco.mj_getState(scene.model, scene.data, after, spec)
    assert (binding.state.tobytes(), binding.row.tobytes()) == (state, row)
    assert before.tobytes() == after.tobytes()
    # and a good one is taken
    go_on(run, samples_of(sines(21)[20:]))


@settings(max_examples=50)
@given(
    st.lists(
        st.one_of(st.floats(), st.floats(-2, 2), st.just(1e9), st.just(0.0)), min_size=7, max_size=7
    )
)
@example([1e9, 0, 0, 1, 0, 0, 0])  # whose square swallows that of the quaternion
@example([1e9, 0, 0, 0, 0, 0, 0])
def test_any_sample_is_either_refused_or_gives_finite_control(values: list[float]) -> None:
    scene = load(FREE_BALL)
    binding, _ = bind(scene)
    samples = at_rest(1)
    samples["position"], samples["quaternion"] = values[:3], values[3:]
    code = before_step(binding.state, samples, binding.row, 0, T)
    with np.errstate(over="ignore", invalid="ignore"):
        square = np.square(values)
        is_valid = np.isfinite(square.sum()) and square[3:].sum() > 0.25
    assert code == (OK if is_valid else BAD_SAMPLE)
    if is_valid:
        assert np.isfinite(scene.data.ctrl).all()
        assert np.linalg.norm(binding.row["device_quaternion"]) == pytest.approx(1, abs=1e-12)


def test_quaternion_of_another_length_or_sign_is_the_same_rotation() -> None:
    scene = load(FREE_BALL)
    binding, _ = bind(scene)
    samples = at_rest(1)
    samples["quaternion"] = (-1.0, -1.0, 0.0, 0.0)
    assert before_step(binding.state, samples, binding.row, 0, T) == OK
    expected = np.sqrt([0.5, 0.5, 0, 0])
    assert binding.row["device_quaternion"][0] == pytest.approx(expected, abs=1e-15)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e200])
def test_diverged_scene_gives_zero_wrench_and_a_trip(value: float) -> None:
    scene = load(FREE_BALL)
    binding, parameters = bind(scene)
    run = go_on(run_of(scene, binding, parameters), samples_of(sines(30)))
    assert np.abs(binding.row["wrench_on_device"]).max() > 0
    recorded = binding.row.copy()
    assert before_step(binding.state, samples_of(sines(31)[30:]), binding.row, 0, T) == OK
    mujoco.mj_step(scene.model, scene.data)
    scene.data.qpos[0] = value
    assert after_step(binding.state, binding.row, 0) == BAD_RESULT
    assert not binding.wrench_on_device.any()
    assert binding.state["loop"]["flags"] == TickFlag.TRIP
    assert binding.state["loop"]["tick"] == 30  # the tick is not counted
    assert (binding.row["wrench_on_tool"] == recorded["wrench_on_tool"]).all()
    assert len(run.ticks) == 30


def test_force_over_the_limit_keeps_its_direction_on_tool_and_device() -> None:
    turning = Rotation.from_rotvec(sines(600, 1.0, 2.0))
    samples = samples_of(sines(600, 0.02, 3.0), turning)
    limited = fast(FREE_BALL, samples, force_limit=5.0, torque_limit=0.02).ticks
    is_at_limit = np.zeros(600, bool)
    for part, limit in ((slice(0, 3), 5.0), (slice(3, 6), 0.02)):
        on_tool = limited["wrench_on_tool"][:, part]
        norm = np.linalg.norm(on_tool, axis=1)
        assert norm.max() <= limit * (1 + 1e-12)
        assert norm.min() < 0.9 * limit
        assert (limited["wrench_on_device"][:, part] == -on_tool).all()
        is_at_limit |= norm > limit * (1 - 1e-12)
    assert 1 < np.count_nonzero(is_at_limit) < 590
    assert ((limited["flags"] & TickFlag.FORCE_LIMITED > 0) == is_at_limit).all()


def test_share_rises_linearly_over_the_ramp_and_the_handle_follows_by_it() -> None:
    ramped = fast(FREE_BALL, samples_of(sines(100, 0.02, 3.0)), ramp_ticks=40).ticks
    share = np.minimum((np.arange(100) + 1) / 41, 1.0)
    np.testing.assert_allclose(ramped["lever"], share, rtol=1e-12)
    np.testing.assert_allclose(
        ramped["wrench_on_device"], -share[:, None] * ramped["wrench_on_tool"], atol=1e-15
    )
    moved = np.diff(ramped["device_position"], axis=0)
    followed = np.diff(ramped["handle_position"], axis=0)
    np.testing.assert_allclose(followed, share[:-1, None] * moved, atol=1e-15)
    is_ramping = ramped["flags"] & TickFlag.RAMPING > 0
    assert is_ramping.tolist() == [True] * 40 + [False] * 60


@pytest.mark.parametrize(("scale", "force_scale"), [(1.0, 1.0), (3.0, 3.0), (3.0, 0.5)])
def test_device_gets_the_wrench_scaled_and_in_its_own_axes(
    scale: float, force_scale: float
) -> None:
    axes = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
    turning = Rotation.from_rotvec(sines(300, 0.8, 1.0))
    run = fast(
        FREE_BALL,
        samples_of(sines(300), turning),
        scale=scale,
        force_scale=force_scale,
        axes=tuple(axes.ravel().tolist()),
    )
    on_tool, sent = run.ticks["wrench_on_tool"], run.ticks["wrench_on_device"]
    assert sent[:, :3] == pytest.approx(-force_scale * on_tool[:, :3] @ axes, abs=1e-12)
    assert sent[:, 3:] == pytest.approx(-force_scale / scale * on_tool[:, 3:] @ axes, abs=1e-12)


def test_handle_follows_the_device_through_scale_axes_and_offset() -> None:
    axes = Rotation.from_rotvec([0.3, -1.1, 0.7])
    turning = Rotation.from_rotvec([0.4, 0.5, -0.6]) * rotation(np.array(TURNED[3:]))
    position = np.array([0.31, -0.18, 0.07])
    scene = load(FREE_BALL)
    origin = (0.0, 0.1, 0.2, *Rotation.from_rotvec([0.2, 0, 0]).as_quat(scalar_first=True))
    binding, _ = bind(
        scene,
        device_start=TURNED,
        scale=2.0,
        axes=tuple(axes.as_matrix().ravel().tolist()),
        handle_origin=tuple(float(v) for v in origin),
    )
    q = turning.as_quat(scalar_first=True)
    here, orientation = handle_pose(
        binding.state["run"][0],
        binding.state["pose"][0],
        tuple(position.tolist()),
        tuple(q.tolist()),
    )
    expected = np.array(origin[:3]) + 2.0 * axes.apply(position - TURNED[:3])
    assert here == pytest.approx(expected, abs=1e-14)
    turned = axes * turning * rotation(np.array(TURNED[3:])).inv() * axes.inv()
    expected_orientation = (turned * rotation(np.array(origin[3:]))).as_matrix()
    assert rotation(np.array(orientation)).as_matrix() == pytest.approx(
        expected_orientation, abs=1e-14
    )
    start = binding.state["pose"][0]
    assert start["handle_position"] == pytest.approx(origin[:3], abs=1e-15)


def test_contacts_and_iterations_over_all_islands_are_those_of_mujoco() -> None:
    block = """<body pos="{} 0 0.03"><freejoint/><geom type="box" size="0.02 0.02 0.02" mass="0.1"
                 contype="1" conaffinity="1"/></body>"""
    world = """<geom type="plane" size="1 1 1" contype="1" conaffinity="1"/>
        <body name="tool" pos="0 0 1"><freejoint/><geom type="sphere" size="0.01" mass="0.1"/>
          <site name="grip"/></body>"""
    world += "".join(block.format(x) for x in (0.2, 0.4, 0.6))
    contacts, expected, islands = [], [], []

    def push(_tick: int, data: Any) -> None:
        data.qfrc_applied[6:] = np.tile([0.9, 0.3, 0, 0, 0, 0.03], 3)

    def look(_tick: int, data: Any) -> None:
        rows = [c.efc_address for c in data.contact if c.efc_address >= 0]
        contacts.append(int(np.sum(data.efc_force[rows] > 0)))
        islands.append(data.nisland)
        expected.append(int(np.sum(data.solver_niter[: max(data.nisland, 1)])))

    scene = mjcf(world, option='gravity="0 0 -9.81"')
    run = live(scene, at_rest(200), on_tick=push, after_tick=look)
    assert max(islands) == 3
    assert run.ticks["solver_iterations"].tolist() == expected
    assert max(expected) >= 3
    assert run.ticks["contacts"].tolist() == contacts
    is_touching = run.ticks["flags"] & TickFlag.CONTACT > 0
    assert is_touching.tolist() == [count > 0 for count in contacts]
    assert set(is_touching) == {False, True}


def test_record_holds_the_tick_the_sample_and_the_pose_after_the_step() -> None:
    poses = []
    samples = samples_of(sines(40), Rotation.from_rotvec(sines(40, 0.5)))
    samples["buttons"] = np.arange(40)
    run = live(
        FREE_BALL, samples, after_tick=lambda _k, d: poses.append(d.site("grip").xpos.copy())
    )
    assert run.ticks["tick"].tolist() == list(range(40))
    assert run.ticks["buttons"].tolist() == list(range(40))
    assert (run.ticks["device_position"] == samples["position"]).all()
    assert (run.ticks["tool_position"] == np.array(poses)).all()
    assert (run.ticks["tool_quaternion"][:, 0] >= 0).all()
    assert (run.ticks["tool_position"][-1] == run.scene.data.qpos[:3]).all()
    loop = run.binding.state["loop"]
    for port, wrench in (("peak", "wrench_on_device"), ("peak_tool", "wrench_on_tool")):
        force = np.linalg.norm(run.ticks[wrench][:, :3], axis=1)
        torque = np.linalg.norm(run.ticks[wrench][:, 3:], axis=1)
        assert loop[f"{port}_force"][0] == pytest.approx(force.max(), rel=1e-15)
        assert loop[f"{port}_torque"][0] == pytest.approx(torque.max(), rel=1e-15)


def test_publish_writes_one_record_and_refuses_a_full_ring() -> None:
    row, ring = np.zeros(1, TICK_DTYPE), np.zeros(2, TICK_DTYPE)
    cursors = np.zeros(2, np.int64)
    row["tick"], row["flags"] = 7, TickFlag.RAMPING
    assert publish(row, ring, cursors, 1, 2, 3, 4, int(TickFlag.OVERRUN))
    assert (cursors[HEAD], cursors[TAIL]) == (1, 0)
    assert ring["tick"][0] == 7
    assert ring["flags"][0] == TickFlag.RAMPING | TickFlag.OVERRUN
    assert [int(ring[f"{name}_ns"][0]) for name in ("deadline", "wake", "read", "write")] == [
        1,
        2,
        3,
        4,
    ]
    row["tick"] = 8
    assert publish(row, ring, cursors, 1, 2, 3, 4, 0)
    row["tick"] = 9
    kept = ring.tobytes()
    assert not publish(row, ring, cursors, 1, 2, 3, 4, 0)
    assert ring.tobytes() == kept
    cursors[TAIL] = 1
    assert publish(row, ring, cursors, 1, 2, 3, 4, 0)
    assert ring["tick"].tolist() == [9, 8]


def test_described_layout_is_that_of_the_library() -> None:
    scene = load(
        mjcf("""
        <body name="tool" pos="0 0 0.00995"><freejoint/>
          <geom type="sphere" size="0.01" mass="0.1" contype="1" conaffinity="1"/>
          <site name="grip"/></body>
        <geom type="plane" size="1 1 1" contype="1" conaffinity="1"/>""")
    )
    data = scene.data
    assert data.ncon == 1
    layout = native.contact_layout()
    address = int(ctypes.c_int64.from_address(native.field_address(data, "contact")).value)
    contact = data.contact[0]
    assert (native.floats(address + layout["point"], 3) == contact.pos).all()
    assert (native.floats(address + layout["frame"], 9) == contact.frame).all()
    assert (native.ints(address + layout["geoms"], 2) == contact.geom).all()
    assert native.ints(address + layout["dim"], 1)[0] == contact.dim
    assert native.ints(address + layout["row"], 1)[0] == contact.efc_address
    force = native.pointer_at(native.field_address(data, "efc_force"))
    assert (native.floats(force, data.nefc) == data.efc_force).all()


@pytest.mark.parametrize(
    ("struct", "kind", "message"),
    [
        ("mjData", "mjtNum", "lays out its structs differently"),
        ("mjOption", "mjtNum", "lays out its structs differently"),
        ("mjData", "mjtNew", "uses a type 'mjtNew'"),
    ],
)
def test_another_layout_of_mujocos_structs_is_refused(
    monkeypatch: pytest.MonkeyPatch, struct: str, kind: str, message: str
) -> None:
    """As if a new MuJoCo had a field that its description does not have, or a type we do not."""
    described = structs.STRUCTS[struct]
    extra = ast_nodes.StructFieldDecl(name="new", type=ast_nodes.ValueType(name=kind), doc="")
    changed = replace(described, fields=(extra, *described.fields))
    scene = load(FREE_BALL)
    with monkeypatch.context() as patch:
        patch.setitem(structs.STRUCTS, struct, changed)
        native.struct_of.cache_clear()
        try:
            with pytest.raises(SceneError, match=message):
                bind(scene)
        finally:
            native.struct_of.cache_clear()
    bind(scene)  # and the true one is accepted


def test_binding_keeps_model_and_data_alive() -> None:
    scene = load(FREE_BALL)
    references = [sys.getrefcount(scene.model), sys.getrefcount(scene.data)]
    binding, _ = bind(scene)  # its state holds bare addresses
    assert [sys.getrefcount(scene.model), sys.getrefcount(scene.data)] > references
    del binding
    assert [sys.getrefcount(scene.model), sys.getrefcount(scene.data)] == references


@pytest.mark.parametrize(
    "changes",
    [
        {"period": 0.0},
        {"period": float("nan")},
        {"substeps": 0},
        {"scale": -1.0},
        {"force_scale": 0.0},
        {"force_limit": float("inf")},
        {"torque_limit": -1.0},
        {"ramp_ticks": -1},
        {"device_origin": IDENTITY[:6]},
        {"handle_origin": (float("nan"), *IDENTITY[1:])},
        {"device_start": ()},
        {"axes": (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0)},  # left-handed
        {"axes": (2.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)},
        {"axes": (1.0, 0.0)},
        {"scheme": 7},
        {"contact_stiffness": 5.0},
        {"contact_stiffness": 0.0, "scheme": Scheme.MASSLESS},
        {"substeps": 2, "scheme": Scheme.MASSLESS, "contact_stiffness": 5.0},
    ],
)
def test_parameters_out_of_range_are_refused_by_name(changes: dict[str, Any]) -> None:
    _, parameters = bind(load(FREE_BALL))
    name = next(iter(changes)).replace("_", ".")
    with pytest.raises(HapticBridgeError, match=f"{name} is"):
        replace(parameters, **changes)


def test_a_run_starts_from_the_keyframe_with_its_energy_as_the_zero() -> None:
    scene = mjcf(
        """<body name="tool"><joint type="slide" axis="0 0 1" stiffness="100"/>
             <geom type="sphere" size="0.01" mass="0.1"/><site name="grip"/></body>""",
        '<keyframe><key name="home" qpos="0.02" qvel="0.3"/></keyframe>',
        'gravity="0 0 -9.81"',
    )
    run = live(scene, at_rest(0))
    expected = 0.5 * 0.1 * 0.3**2 + 0.5 * 100 * 0.02**2 + 0.1 * 9.81 * 0.02
    assert run.start_energy == pytest.approx(expected, rel=1e-12)
    assert run.tool_start[:3] == pytest.approx([0, 0, 0.02])
    assert run.handle_start == pytest.approx(run.tool_start)
    go_on(run, at_rest(1))
    # the first tick's E is that of one implicit step, not the whole stored energy
    assert abs(run.ticks["environment_energy"][0]) < 0.01 * expected

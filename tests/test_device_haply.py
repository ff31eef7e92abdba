"""The Haply driver against a service written from its documentation: virtual time, real sockets."""

from __future__ import annotations

import errno
import json
import re
import socket
import threading
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from device_benches import PERIOD, HaplyBench, read, ticks
from emulated.haply_service import CENTRE, HaplyService, serving
from hypothesis import given
from hypothesis import strategies as st

from hapticbridge.device import SimulatedDevice, haply, open_device
from hapticbridge.device import watchdog as silence
from hapticbridge.device.haply import FORCE_LIMIT, HaplyDevice
from hapticbridge.device.trajectory import Motion
from hapticbridge.device.transport import websocket as transport
from hapticbridge.errors import DeviceError, DeviceLost
from hapticbridge.files import install_command
from hapticbridge.kernel.record import SAMPLE_DTYPE, TickFlag

FORCE = np.array([0.4, -0.3, 0.2, 9.0, 9.0, 9.0])


def started(*mechanics: SimulatedDevice, **options: float) -> tuple[HaplyBench, HaplyDevice]:
    bench = HaplyBench(*mechanics, **options)
    device = bench.opened()
    device.start(PERIOD)
    return bench, device


def test_the_filters_are_set_and_said() -> None:
    bench = HaplyBench()
    (inverse,) = bench.service.devices.values()
    inverse.damping = 5.0  # somebody's
    bench.opened(force_gate=0.1)
    assert (inverse.gate_gain, inverse.damping) == (0.1, 0.0)
    assert bench.service.profile == "hapticbridge"
    said = bench.told[0]
    assert "force_gate.gain set to 0.1, damping.scalar to 0 (force_gate.gain was 0.3" in said
    assert "damping.scalar was 5" in said
    assert "oscillation damper cannot be switched off" in said


def test_a_service_of_before_is_spoken_to_in_its_own_words() -> None:
    bench = HaplyBench()
    bench.service.is_old = True
    device = bench.opened()
    device.start(PERIOD)
    ticks(device, bench.time, 3, FORCE)
    assert "older than 3.5" in bench.told[0]
    assert bench.service.forces[-1] == FORCE[:3].tolist()


def test_each_tick_sends_one_force_and_reads_one_state() -> None:
    bench, device = started(resolution=1e-5)
    before = bench.service.messages
    assert ticks(device, bench.time, 50, FORCE)[1:] == [0] * 49
    bench.time.advance(bench.time.now + PERIOD)
    assert bench.service.messages - before == 50
    assert bench.service.forces[-50:] == [FORCE[:3].tolist()] * 50
    assert device.remark == ""


def test_the_pose_is_the_services_and_nothing_turns() -> None:
    bench = HaplyBench()
    device = bench.opened()
    sample = device.start(PERIOD)
    (inverse,) = bench.service.devices.values()
    bench.service.buttons = {"a": True, "b": False, "c": True}
    ticks(device, bench.time, 30, FORCE)
    bench.time.advance(bench.time.now + PERIOD)
    told = CENTRE + inverse.handle.pose()[0]
    device.read(sample)
    np.testing.assert_allclose(sample["position"][0], told, atol=2e-4)
    np.testing.assert_array_equal(sample["quaternion"][0], (1.0, 0.0, 0.0, 0.0))
    assert sample["buttons"][0] == 0b101


def grip(w: float, x: float, y: float, z: float) -> dict[str, float]:
    return {"w": w, "x": x, "y": y, "z": z}


def test_a_versegrip_turns_the_tool_and_has_buttons() -> None:
    bench = HaplyBench()
    bench.service.orientation = grip(0.6, 0.0, 0.8004, 0.0)  # rounded
    device = bench.opened()
    assert (device.info.axes, device.info.sensed) == (("x", "y", "z"), ("rx", "ry", "rz"))
    assert "the VerseGrip turns the tool without torque on the hand" in bench.told
    sample = device.start(PERIOD)
    size = np.hypot(0.6, 0.8004)
    np.testing.assert_allclose(sample["quaternion"][0], [0.6 / size, 0, 0.8004 / size, 0])
    bench.service.orientation = grip(-0.8, 0.0, 0.0, 0.6)  # the same turn as (0.8, 0, 0, -0.6)
    ticks(device, bench.time, 5, FORCE)
    _, moved = read(device, bench.time)
    np.testing.assert_allclose(moved["quaternion"], [0.8, 0, 0, -0.6])
    for asleep in (None, grip(0.0, 0.0, 0.0, 0.0)):
        bench.service.orientation = asleep
        ticks(device, bench.time, 5, FORCE)
        _, kept = read(device, bench.time)
        np.testing.assert_allclose(kept["quaternion"], [0.8, 0, 0, -0.6])
    bench.service.orientation = grip(2.0, 0.0, 0.0, 0.0)
    with pytest.raises(DeviceError, match="reports no orientation of the VerseGrip"):
        ticks(device, bench.time, 5, FORCE)


def test_a_versegrip_that_is_gone_ends_the_run() -> None:
    bench = HaplyBench()
    bench.service.orientation = grip(0.6, 0.8, 0.0, 0.0)
    device = bench.opened()
    device.start(PERIOD)
    ticks(device, bench.time, 5, FORCE)
    bench.service.grip = ""
    with pytest.raises(DeviceLost, match="the VerseGrip is gone: the Inverse Service does not"):
        ticks(device, bench.time, 5, FORCE)


@pytest.mark.parametrize("asleep", [None, grip(0.0, 0.0, 0.0, 0.0)])
def test_a_versegrip_that_is_listed_and_sends_nothing_ends_the_run(asleep: object) -> None:
    bench = HaplyBench()
    bench.service.orientation = grip(0.6, 0.8, 0.0, 0.0)
    device = bench.opened()
    device.start(PERIOD)
    ticks(device, bench.time, 2000, np.zeros(6))  # at rest on the table it repeats itself
    bench.time.advance(bench.time.now + 10.0)  # a pause of the loop is none of the grip
    bench.service.orientation = asleep
    ticks(device, bench.time, 490, np.zeros(6))
    words = r"the VerseGrip is listed, but has sent no new orientation for 0\.5 s; wake it"
    with pytest.raises(DeviceLost, match=words):
        ticks(device, bench.time, 20, np.zeros(6))


@pytest.mark.parametrize(
    ("force", "is_turning", "is_lost"),
    [(0.4, False, True), (0.4, True, False), (0.0, False, False)],
)
def test_a_versegrip_that_is_carried_and_repeats_its_orientation_ends_the_run(
    force: float, is_turning: bool, is_lost: bool
) -> None:
    bench = HaplyBench(SimulatedDevice(hand=None, damping=2.0))
    bench.service.orientation = grip(0.6, 0.8, 0.0, 0.0)
    device = bench.opened()
    device.start(PERIOD)
    begin, wrench, says = bench.time.now, np.array([force, 0, 0, 0, 0, 0]), ""
    try:
        for k in range(800):  # v = F/b soon: 3 cm in 0.2 s
            step = 2.0**-14 * (k // 400 % 2) if is_turning else 0.0
            bench.service.orientation = grip(0.6, 0.8, step, 0.0)
            ticks(device, bench.time, 1, wrench)
    except DeviceLost as lost:
        says = str(lost)
    assert ("no new orientation for 0.5 s" in says) == is_lost
    if is_lost:
        assert bench.time.now - begin == pytest.approx(0.5, abs=0.01)


def test_a_versegrip_that_sleeps_at_the_start_is_told() -> None:
    bench = HaplyBench()
    device = bench.opened()
    assert device.info.sensed == ()
    assert "has sent no orientation yet; move it, and start again" in bench.told[1]
    bench.service.grip = ""
    bench.opened()
    assert len(bench.told) == 3  # without a grip nothing is said of it


def test_a_wired_grip_has_one_button_and_turns_too() -> None:
    bench = HaplyBench()
    bench.service.grip, bench.service.orientation = "verse_grip", grip(0.0, 1.0, 0.0, 0.0)
    bench.service.buttons["a"] = True
    device = bench.opened()
    sample = device.start(PERIOD)
    assert sample["buttons"][0] == 1
    np.testing.assert_array_equal(sample["quaternion"][0], (0.0, 1.0, 0.0, 0.0))


@pytest.mark.parametrize("listed", ["", "wireless_verse_grip"])
def test_without_a_grip_or_by_choice_nothing_turns(listed: str) -> None:
    bench = HaplyBench()
    bench.service.grip, bench.service.orientation = listed, grip(0.6, 0.8, 0.0, 0.0)
    device = bench.opened(turn=0.0)
    assert device.info.sensed == ()
    assert device.start(PERIOD)["quaternion"][0].tolist() == [1.0, 0.0, 0.0, 0.0]
    assert ("the VerseGrip does not turn the tool" in bench.told) is bool(listed)


def test_a_service_slower_than_the_loop_gets_the_newest_force_and_no_queue() -> None:
    bench, device = started(work=2.7e-3)
    assert device.info.rate == pytest.approx(1 / 2.7e-3, rel=0.01)
    flags = ticks(device, bench.time, 300, FORCE)
    missed = 300 * (1 - 1 / 2.7)
    assert np.count_nonzero(flags) == pytest.approx(missed, abs=4)
    assert int(device.remark.split()[0]) == pytest.approx(missed, abs=6)
    sample, wrench, answers = np.zeros(1, SAMPLE_DTYPE), np.zeros(6), 0
    for k in range(100):
        bench.time.advance(bench.time.now + PERIOD)
        if device.read(sample) == 0 and k > 10:
            (entry,) = json.loads(bench.link.last_sent)["inverse3"]
            assert entry["commands"]["set_cursor_force"]["vector"]["x"] == 0.01 * (k - 1)
            answers += 1
        wrench[0] = 0.01 * k
        device.write(wrench)
    assert answers > 20


def test_forces_of_a_loop_that_stalled_are_not_put_down_to_the_service() -> None:
    """A loop makes up for lost ticks at once; the service answers within 50 µs."""
    bench, device = started(work=5e-5)
    ticks(device, bench.time, 20, FORCE)
    assert device.remark == ""
    for _ in range(5):  # one is under way already, another one is sent, and the last waits
        device.write(FORCE)
    assert device.remark == (
        "3 forces were not sent: newer ones came before the service had answered earlier ones"
    )


@pytest.mark.parametrize(("travel", "work"), [(1e-4, 5e-5), (4e-4, 1e-4), (8e-4, 5e-4)])
def test_rate_and_delay_are_measured(travel: float, work: float) -> None:
    device = HaplyBench(travel=travel, work=work).opened()
    round_trip = 2 * travel + work
    assert device.info.delay == pytest.approx(round_trip, rel=0.02)
    assert device.info.rate == pytest.approx(min(1 / work, 2 / round_trip), rel=0.05)


def test_the_force_that_answers_a_sample_acts_within_the_delay_that_is_stated() -> None:
    bench, device = started(travel=2e-4)
    ticks(device, bench.time, 5, np.zeros(6))
    (inverse,) = bench.service.devices.values()
    device.write(FORCE)
    assert not inverse.force.any()
    bench.time.advance(bench.time.now + 2e-4)
    np.testing.assert_array_equal(inverse.force, FORCE[:3])


def test_closing_leaves_no_force_and_may_be_done_twice() -> None:
    bench, device = started()
    ticks(device, bench.time, 20, FORCE)
    (inverse,) = bench.service.devices.values()
    assert inverse.force.any()
    device.close()
    device.close()
    assert not inverse.force.any()
    assert bench.link.is_closed


def test_a_silent_service_is_lost_after_50_ms_and_not_before() -> None:
    bench, device = started()
    ticks(device, bench.time, 5, FORCE)
    bench.link.is_silent = True
    stale = int(TickFlag.STALE_SAMPLE)
    assert ticks(device, bench.time, 45, FORCE)[3:] == [stale] * 42
    with pytest.raises(DeviceLost, match="has not answered for 50 ms"):
        ticks(device, bench.time, 10, FORCE)


def test_a_loop_that_was_away_finds_the_service_alive() -> None:
    bench, device = started()
    ticks(device, bench.time, 5, FORCE)
    bench.time.advance(bench.time.now + 0.5)
    assert ticks(device, bench.time, 5, FORCE) == [0] * 5
    device.start(PERIOD)
    bench.time.advance(bench.time.now + 0.5)  # before the loop's first question
    assert ticks(device, bench.time, 5, FORCE) == [0] * 5


@pytest.mark.parametrize(("stall", "is_asked_anew"), [(0.04, False), (0.2, True)])
def test_after_a_stall_pose_and_force_are_fresh(stall: float, is_asked_anew: bool) -> None:
    path = Motion([0.0, 2.0], [(0.0, 0.0, 0.0), (0.4, 0.0, 0.0)])
    # slower than the loop: a force waits
    bench, device = started(SimulatedDevice(path=path), work=3e-3)
    ticks(device, bench.time, 300, FORCE)
    end = bench.time.now + stall
    bench.time.advance(end)
    late, sample = len(bench.service.forces), np.zeros(1, SAMPLE_DTYPE)
    assert device.read(sample) == 0
    here = CENTRE + bench.service.devices["049D"].handle.pose()[0]
    assert (np.linalg.norm(sample["position"][0] - here) < 2e-3) == is_asked_anew
    if is_asked_anew:
        assert bench.service.forces[late:] == [[0.0, 0.0, 0.0]]
        assert bench.time.now - end < 0.01
    else:  # it waits for nothing
        assert bench.time.now == pytest.approx(end, abs=1e-9)


def at(**place: str) -> str:
    """Returns an answer with a position, written as JSON or nearly so."""
    numbers = ", ".join(f'"{axis}": {place.get(axis, 0)}' for axis in "xyz")
    return '{"inverse3": [{"device_id": "049D", "state": {"cursor_position": {' + numbers + "}}}]}"


@pytest.mark.parametrize(
    ("answer", "error", "words"),
    [
        ("{", DeviceError, "is not a JSON object"),
        ("[" * 5000, DeviceError, "is not a JSON object"),
        ("[1]", DeviceError, "is not a JSON object"),
        ("{}", DeviceLost, "does not list it any more"),
        ('{"inverse3": 3}', DeviceError, "lists invalid devices"),
        ('{"inverse3": [{"device_id": "049D"}]}', DeviceError, "reports no position"),
        *((answer, DeviceError, "reports no position")
          for answer in (at(x="NaN"), at(z="NaN"), at(x="1e999"), at(x="true"))),
    ],
)  # fmt: skip
def test_answer_that_is_none_ends_run(answer: str, error: type[DeviceError], words: str) -> None:
    bench, device = started()
    ticks(device, bench.time, 5, FORCE)
    bench.service.spoil[bench.service.messages + 2] = answer
    with pytest.raises(error, match=words):
        ticks(device, bench.time, 5, FORCE)


number = st.floats() | st.integers() | st.booleans() | st.text(max_size=3) | st.none()
vector = st.dictionaries(st.sampled_from("xyz"), number)
places = st.dictionaries(st.sampled_from(["cursor_position", "other"]), vector | number)
entry = {"device_id": st.sampled_from(["049D", "x"]), "state": places | number}
entries = st.lists(st.fixed_dictionaries(entry), max_size=2)
told = st.fixed_dictionaries({"inverse3": entries | number})


@given(st.text() | told.map(json.dumps))
def test_whatever_comes_the_position_is_finite_or_there_is_none(message: str) -> None:
    for answer in (lambda: haply.state_of(message, "049D"), lambda: haply.inventory(message)):
        try:
            found = answer()
        except DeviceError as error:
            assert "\n" not in str(error)
            continue
        if isinstance(found, haply.State):
            assert np.isfinite(found.position).all()


def test_one_of_several_is_chosen_by_its_number() -> None:
    bench = HaplyBench(SimulatedDevice(), SimulatedDevice())
    with pytest.raises(DeviceError, match="choose one with serial=, one of '049D', '049E'"):
        bench.opened()
    assert bench.link.is_closed
    with pytest.raises(DeviceError, match="no device 'haply' has serial '77'"):
        bench.opened(serial="77")
    device = bench.opened(serial="049E")
    device.start(PERIOD)
    ticks(device, bench.time, 10, FORCE)
    assert device.info.serial == "049E"
    assert [inverse.force.any() for inverse in bench.service.devices.values()] == [False, True]
    bench.service.devices.clear()
    with pytest.raises(DeviceError, match=r"is plugged in \(looked for a device of the Inverse"):
        bench.opened()


@pytest.mark.parametrize("device_id", ["", "../049D", 7, None, "x" * 65])
def test_a_number_that_is_no_name_is_refused(device_id: object) -> None:
    told = {"session_id": 1, "inverse3": [{"device_id": device_id}]}
    with pytest.raises(DeviceError, match="without a device_id"):
        haply.inventory(json.dumps(told))


def test_scaled_positions_are_refused_because_their_work_is_none() -> None:
    bench = HaplyBench()
    told = json.loads(bench.service.inventory())
    told["inverse3"][0]["config"]["mount"]["scale"]["y"] = 2
    (listed,) = haply.inventory(json.dumps(told))
    assert listed.is_scaled
    with pytest.raises(DeviceError, match="scales the positions of 049D"):
        haply.refuse_scaled(listed)
    (listed,) = haply.inventory(bench.service.inventory())
    haply.refuse_scaled(listed)


def test_numbers_and_limits_come_from_whoever_knows_them() -> None:
    info = HaplyBench().opened().info
    assert (info.mass, info.damping, info.friction, info.resolution) == (None,) * 4
    assert (info.force_limit, info.axes, info.is_real) == (FORCE_LIMIT, ("x", "y", "z"), True)
    info = HaplyBench().opened(damping=1.2, force_limit=5.0).info
    assert (info.damping, info.force_limit) == (1.2, 5.0)
    with pytest.raises(DeviceError, match="damping is -1"):
        HaplyBench().opened(damping=-1)


def test_a_slow_loop_is_refused() -> None:
    with pytest.raises(DeviceError, match="the rate must be at least 50 Hz"):
        HaplyBench().opened().start(0.021)


def test_real_sockets_run_and_are_logged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(silence, "SILENCE", 5.0)  # a busy machine stalls for longer than 50 ms
    service = HaplyService({"049D": SimulatedDevice(damping=50.0)}, resolution=1e-6)
    sample = np.zeros(1, SAMPLE_DTYPE)
    log = tmp_path / "wire.log"
    with serving(service) as (port, drop):
        place = ("localhost", port)
        assert haply.medium(place) == f"the Inverse Service runs at localhost:{port}"
        (plugged,) = haply.find(place)
        assert str(plugged) == "inverse3 (serial 049D)"
        device = open_device(f"haply:service=localhost:{port},log={log},damping=1")
        assert device.info.rate is not None
        device.start(PERIOD)
        fresh = 0
        wait = threading.Event()
        for _ in range(40):
            wait.wait(2e-3)
            fresh += device.read(sample) == 0
            device.write(FORCE)
        assert fresh > 0
        assert service.forces[-1] == FORCE[:3].tolist()
        device.close()
        assert service.forces[-1] == [0.0, 0.0, 0.0]
        device = open_device(f"haply:service=localhost:{port}")
        device.start(PERIOD)
        drop.set()
        with pytest.raises(DeviceLost, match="closed the connection"):
            for _ in range(1000):
                device.write(FORCE)
                wait.wait(1e-3)
                device.read(sample)
        device.close()
    assert " > 7b" in log.read_text()


def test_a_service_that_is_asked_nothing_for_a_while_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    # as while the first orientation of a VerseGrip is compiled for
    monkeypatch.setattr(transport, "OPEN_TIMEOUT", 0.3)
    service = HaplyService({"049D": SimulatedDevice()})
    with serving(service) as (port, _drop):
        link = transport.WebSocketLink.open("localhost", port, "the service")
        assert json.loads(link.wait(5.0) or "")["session_id"] == 7
        assert link.wait(0.6) is None
        link.send('{"session": {"configure": {"profile": {"name": "later"}}}}')
        assert link.wait(5.0)
        assert service.profile == "later"
        link.close()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        return int(probe.getsockname()[1])


def test_no_service_socket_or_package_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port()
    with pytest.raises(DeviceError, match=f"does not run: no answer at localhost:{port}"):
        open_device(f"haply:service=localhost:{port}")
    assert haply.find(("localhost", port)) == []
    assert "does not run" in haply.medium(("localhost", port))
    unreachable = OSError(errno.ENETUNREACH, "Network is unreachable")
    with monkeypatch.context() as patch:
        patch.setattr(socket, "create_connection", Mock(side_effect=unreachable))
        with pytest.raises(DeviceError, match="cannot be reached: Network is unreachable at 10"):
            open_device("haply:service=10.0.0.9:10001")
    for host in ("no.such.invalid", "a..b"):
        with pytest.raises(DeviceError, match=f"^there is no host '{host}' for the Inverse Serv"):
            open_device(f"haply:service={host}:{port}")
    with socket.create_server(("localhost", 0)) as mute:

        def answer() -> None:
            peer, _ = mute.accept()
            peer.sendall(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n")
            peer.close()

        threading.Thread(target=answer, daemon=True).start()
        with pytest.raises(DeviceError, match="is not the Inverse Service"):
            open_device(f"haply:service=localhost:{mute.getsockname()[1]}")
    for wrong in ("localhost:x", "localhost:0", "localhost:70000"):
        with pytest.raises(DeviceError, match="must be HOST:PORT"):
            open_device(f"haply:service={wrong}")
    monkeypatch.setattr(transport, "websocket_client", lambda: None)
    with pytest.raises(DeviceError, match=re.escape(install_command("haply"))):
        open_device(f"haply:service=localhost:{port}")

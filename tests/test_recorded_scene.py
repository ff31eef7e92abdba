"""The scene of a foreign recording: what it names, and what it may take."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import gc
import os
import resource
import signal
import socket
import stat
import struct
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zstandard
from audit_cases import recorded, rewritten, tapped
from cli_cases import Called

from hapticbridge import confinement
from hapticbridge.audit import audit
from hapticbridge.audit.recorded_scene import compile_recorded
from hapticbridge.audit.replay import Resimulator
from hapticbridge.confinement import ForeignSceneError, Worker, in_bounds, unpacked
from hapticbridge.errors import CouplingError, HapticBridgeError, RecordingError, SceneError
from hapticbridge.recording import Recording, RecordingFile, open_recording, read_recording
from hapticbridge.recording.container import MAX_RATIO
from hapticbridge.replay.film import Shot, still
from hapticbridge.report.evidence import Evidence
from hapticbridge.report.search import likely_cause
from hapticbridge.run.description import SOURCE_PREFIX
from hapticbridge.scene.source import refuse_outside
from hapticbridge.whatif import what_if

SCENE = f"{SOURCE_PREFIX}peg_in_hole.xml"
SHEET = f"{SOURCE_PREFIX}peg_in_hole.toml"

COMPILE_TIME = 3.0
"""Processor time in s for a bomb, in place of the user's 10 s."""

PROCESSOR_TIME = COMPILE_TIME + 3.5
"""Most that a bomb may take, in s of processor."""


def address_space() -> int:
    """Returns the address space of this process in bytes, with which a child begins."""
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return read_recording(tapped(tmp_path_factory.mktemp("honest")))


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(confinement, "COMPILE_TIME", COMPILE_TIME)


def told(path: Path) -> str:
    """Returns what the audit says of a file that it does not call passive."""
    try:
        report = audit(path)
    except HapticBridgeError as error:
        return str(error)
    assert report.verdict == "invalid"
    return report.reason


def before_world(element: bytes) -> Callable[[bytes], bytes]:
    return lambda text: text.replace(b"<worldbody>", element + b"<worldbody>", 1)


GRID = b'<replicate count="100" offset="0 0 1">'
BOMBS: dict[str, tuple[str, Callable[[bytes], bytes], str]] = {
    "hello": (SCENE, lambda _: b"hello", "not well-formed"),
    "nested replication": (
        SCENE,
        lambda text: text.replace(
            b"<worldbody>",
            b"<worldbody>" + 5 * GRID + b'<geom size=".1"/>' + 5 * b"</replicate>",
            1,
        ),
        "made MuJoCo fail|needs too much processor time",  # as fast as the machine is
    ),
    "40 000 x 40 000 height field": (
        SCENE,
        before_world(b'<asset><hfield name="h" nrow="40000" ncol="40000" size="1 1 1 1"/></asset>'),
        "made MuJoCo fail",
    ),
    "2.7 GB of a texture": (
        SCENE,
        before_world(
            b'<asset><texture name="t" builtin="flat" width="30000" height="30000"/></asset>'
        ),
        "needs more than",
    ),
    "a device as a mesh": (
        SCENE,
        before_world(b'<asset><mesh name="m" file="/dev/zero"/></asset>'),
        "names the file '/dev/zero'",
    ),
    "a file above": (
        SCENE,
        before_world(b'<asset><mesh name="m" file="../secret.stl"/></asset>'),
        "names the file '../secret.stl'",
    ),
    "300 kB of open comments": (SCENE, lambda text: b"<!--" * 75_000 + text, "cannot read scene"),
    "300 kB of spaces": (SCENE, before_world(b"<a " + b" " * 300_000), "cannot read scene"),
    "300 kB of a name": (SCENE, before_world(b"<" + b"a" * 300_000), "cannot read scene"),
    "deep TOML": (SHEET, lambda _: b"a=" + b"[" * 100_000, "recursion depth"),
    "5000 digits of TOML": (SHEET, lambda _: b"a=" + b"9" * 5000, "digits"),
    "TOML that is no text": (SHEET, lambda _: b"\xff\xfe", "cannot read the scene's parameters"),
}


@pytest.mark.usefixtures("hasty")
@pytest.mark.parametrize("name", BOMBS)
def test_a_hostile_scene_ends_in_a_sentence_with_little_time_and_memory(
    name: str, honest: Recording, tmp_path: Path
) -> None:
    attachment, change, words = BOMBS[name]
    changed = {attachment: change(honest.attachments[attachment])}
    path = rewritten(honest, tmp_path / "bomb.mcap", attachments=changed)
    before, most = resource.getrusage(resource.RUSAGE_CHILDREN), confinement.MEMORY
    most += address_space() + (64 << 20)  # what this process takes until the child is made
    reason = told(path)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert any(each in reason for each in words.split("|"))
    assert "\n" not in reason and str(tmp_path.parent) not in reason.replace(str(path), "")
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < PROCESSOR_TIME
    # the largest child so far counts
    assert after.ru_maxrss == before.ru_maxrss or 1024 * after.ru_maxrss < most


OTHERS: dict[str, Callable[[Path], object]] = {
    "what-if": lambda path: what_if(path, {"damping": 0.6}),
    "render": lambda path: still(path, Shot(width=16, height=16)),
    "view": lambda path: pytest.importorskip("hapticbridge.view.replay").Replay(path),
}
"""Further ways to simulate a recording."""


@pytest.mark.usefixtures("hasty")
@pytest.mark.parametrize(
    ("way", "name"),
    [
        ("what-if", "nested replication"),  # in each way the limits are set all at once
        *((way, name) for name in ("2.7 GB of a texture", "a device as a mesh") for way in OTHERS),
    ],
)
def test_a_hostile_scene_ends_in_a_sentence_in_whatever_simulates_it(
    way: str, name: str, honest: Recording, tmp_path: Path
) -> None:
    attachment, change, words = BOMBS[name]
    changed = {attachment: change(honest.attachments[attachment])}
    path = rewritten(honest, tmp_path / "bomb.mcap", attachments=changed)
    with pytest.raises(HapticBridgeError, match=words) as caught:
        OTHERS[way](path)
    assert "\n" not in str(caught.value)


def crash(*_: object, **__: object) -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


@pytest.mark.parametrize("way", ["what-if", "view"])
def test_a_crash_of_a_scene_leaves_this_process_alive(
    way: str, honest: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = rewritten(honest, tmp_path / "a.mcap")
    monkeypatch.setattr(sys.modules[Resimulator.__module__], "Resimulator", crash)
    monkeypatch.setattr("hapticbridge.replay.stage.Resimulator", crash)
    with pytest.raises(ForeignSceneError, match=r"crashed MuJoCo \(SIGSEGV\)"):
        OTHERS[way](path)


def test_a_reports_cause_is_found_in_a_child_and_without_a_scene_if_that_dies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.mcap"
    recorded(path, "peg_in_hole", method="direct", duration=0.3)
    recording = read_recording(path)
    evidence = Evidence.of(recording)
    assert evidence is not None
    report = replace(audit(path), verdict="active", port="environment", tick=250)
    monkeypatch.setattr("hapticbridge.report.search.compile_recorded", crash)
    assert likely_cause(evidence, report) is not None


def chunk(content: bytes) -> bytes:
    packed = zstandard.ZstdCompressor(level=19).compress(content)
    head = struct.pack("<QQQI", 0, 0, len(content), zlib.crc32(content))
    body = head + struct.pack("<I", 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed
    return struct.pack("<BQ", 6, len(body)) + body


@pytest.mark.parametrize(
    ("content", "count", "words"),
    [
        (bytes(1 << 22), 20, "more than 100 times the file"),
        (bytes((1 << 25) + 1), 3, "bytes, more than 33554432"),
        (struct.pack("<BQ", 0x7F, 0) * 400_000, 1, "holds a record of kind 127"),
        (struct.pack("<BQHIQQ", 5, 22, 99, 0, 0, 0) * 100_000, 1, "does not match"),
    ],
    ids=[
        "80 MB in small chunks",
        "100 MB in large chunks",
        "unknown records",
        "messages of no topic",
    ],
)
def test_a_small_file_that_unpacks_to_much_is_not_unpacked(
    content: bytes, count: int, words: str, honest: Recording, tmp_path: Path
) -> None:
    data, at, path = honest.path.read_bytes(), 8, tmp_path / "bomb.mcap"
    while data[at] != 6:
        at += 9 + struct.unpack_from("<Q", data, at + 1)[0]
    path.write_bytes(data[:at] + count * chunk(content) + data[at:])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_utime
    assert words in "; ".join(read_recording(path).problems)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_utime - before < 6.0


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def message(channel: int, payload: bytes, sequence: int = 0) -> bytes:
    return record(5, struct.pack("<HIQQ", channel, sequence, 0, 0) + payload)


def walked(data: bytes, start: int) -> Iterator[tuple[int, int, int]]:
    """Yields opcode, start and stop of an MCAP file's or a chunk's records."""
    while start < len(data) - 8:
        opcode, size = struct.unpack_from("<BQ", data, start)
        yield opcode, start, start + 9 + size
        start += 9 + size


def ticks_of(path: Path) -> tuple[bytes, list[bytes]]:
    """Returns what precedes the first chunk, and the records of all chunks."""
    data, records = path.read_bytes(), list[bytes]()
    first = next(start for opcode, start, _ in walked(data, 8) if opcode == 6)
    for opcode, start, stop in walked(data, first):
        if opcode != 6:
            break
        inner = start + 9 + 28
        compressed = data[inner + 4 + data[inner] + 8 : stop]
        whole = zstandard.ZstdDecompressor().decompress(compressed, 1 << 22)
        whole += bytes(9)  # for ``walked``, which ends before a file's last magic
        records += [whole[a:b] for _, a, b in walked(whole, 0) if b < len(whole)]
    return data[:first], records


def plain_chunk(content: bytes, times: tuple[int, int] = (0, 0)) -> bytes:
    head = struct.pack("<QQQI", *times, len(content), zlib.crc32(content))
    return record(6, head + struct.pack("<I", 0) + struct.pack("<Q", len(content)) + content)


SHAPES: dict[str, Callable[[list[bytes], int], bytes]] = {
    "tiny chunks": lambda each, n: b"".join(map(plain_chunk, (each * n)[:n])),
    "tiny messages": lambda _, n: b"".join(
        plain_chunk(message(9, b"") * 1000) for _ in range(n // 50)
    ),
    "chunks backwards in time": lambda each, n: b"".join(
        plain_chunk(item, (n - at, n - at)) for at, item in enumerate((each * n)[:n])
    ),
    "chunks that overlap in time": lambda each, n: b"".join(
        plain_chunk(item, (0, n)) for item in (each * n)[:n]
    ),
    "tiny attachments": lambda _, n: b"".join(
        record(9, bytes(16) + struct.pack("<I", 6) + b"%06d" % at + bytes(4) + bytes(8) + bytes(4))
        for at in range(n)
    ),
    "records outside of chunks": lambda each, n: b"".join((each * n)[:n]),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_a_file_of_any_shape_is_walked_in_a_time_that_is_linear_in_its_bytes(
    shape: str, honest: Recording, tmp_path: Path
) -> None:
    """Time of the processor for four times the bytes; a square would take sixteen times."""
    head, records = ticks_of(honest.path)
    setup = plain_chunk(b"".join(each for each in records if each[0] in (3, 4)))
    ticks = [each for each in records if each[0] == 5]
    largest = max(map(len, ticks))
    ticks = [each for each in ticks if len(each) == largest]

    def walked(count: int) -> RecordingFile:
        path = tmp_path / f"{count}.mcap"
        path.write_bytes(head + setup + SHAPES[shape](ticks, count))
        recording = open_recording(path)
        with contextlib.suppress(RecordingError):
            for _ in recording.blocks():
                pass
        return recording

    def spent(count: int) -> float:
        start = time.process_time()
        walked(count)
        return time.process_time() - start

    if shape not in ("tiny messages", "tiny attachments"):
        assert walked(8000).count >= 8000
    # in one of several trials, because a busy machine slows single walks
    assert any(spent(8000) < 8.0 * spent(2000) for _ in range(4))


def test_a_run_at_rest_compresses_far_less_than_is_allowed(tmp_path: Path) -> None:
    path = tmp_path / "rest.mcap"
    recorded(path, "point_mass", duration=5.0)
    recording = read_recording(path)
    assert not recording.problems
    assert recording.ticks.nbytes < 0.5 * MAX_RATIO * path.stat().st_size


@pytest.mark.parametrize(
    ("text", "is_refused"),
    [
        ("<mesh file='a.stl'/>", False),
        ("<mesh file='m/../a.stl'/>", True),
        ("<mesh file='/etc/passwd'/>", True),
        ("<mesh file='&#47;etc/passwd'/>", True),
        ("<mesh file='C:/a.stl'/>", True),
        ("<mesh file='\\\\host\\a.stl'/>", True),
        ("<mesh name='file=\"' file='/etc/passwd'/>", True),
        ("<!-- '--> <mesh name='<!--' file='/etc/passwd'/> -->", True),
        ("<texture fileright='/dev/zero'/>", True),
        ("<compiler meshdir='/etc'/>", True),
        ("<compiler\n assetdir\n =\n '..'/>", True),
        ("<include file='../b.xml'/>", True),
    ],
)
def test_a_scene_names_only_files_of_its_own_folder(text: str, is_refused: bool) -> None:
    data = text.encode()
    if is_refused:
        with pytest.raises(SceneError, match="outside the scene's folder"):
            refuse_outside(data, "main.xml")
    else:
        refuse_outside(data, "main.xml")
    refuse_outside(b"<mesh file='../shared/a.stl'/>", "scenes/main.xml")


@pytest.mark.skipif(sys.platform == "win32", reason="no file there has such a name")
@pytest.mark.parametrize("name", ["a:b", "run 12:30:01"])
def test_a_colon_in_the_name_of_a_file_is_a_letter(name: str, tmp_path: Path) -> None:
    mesh = f"<asset><mesh name='m' file='{name}.obj'/></asset>"
    body = "<body><freejoint/><geom type='mesh' mesh='m'/><site name='grip'/></body>"
    (tmp_path / f"{name}.obj").write_text("v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\n")
    scene = tmp_path / f"{name}.xml"
    scene.write_text(f"<mujoco><option/>{mesh}<worldbody>{body}</worldbody></mujoco>")
    recorded(tmp_path / "run.mcap", scene, duration=0.01)
    for path in tmp_path.glob(f"{name}.*"):
        path.unlink()
    report = audit(tmp_path / "run.mcap")
    assert (report.verdict, report.resimulation) == ("passive", "bit for bit")


def test_names_that_climb_by_steps_do_not_leave_the_folder_in_this_process_either(
    honest: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An include that lies deep may climb; MuJoCo takes its names from the main file's folder."""
    (tmp_path / "secret.xml").write_text("<mujoco><asset/></mujoco>")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "inner"))
    (tmp_path / "inner").mkdir()
    deep = "a/b/c/d.xml"
    main = before_world(f'<include file="{deep}"/>'.encode())(honest.attachments[SCENE])
    for target, is_read in (("../../secret.xml", False), ("a/own.xml", True)):
        files = {
            SCENE: main,
            f"{SOURCE_PREFIX}a/own.xml": b"<mujoco><asset/></mujoco>",
            SOURCE_PREFIX + deep: f'<mujoco><include file="{target}"/></mujoco>'.encode(),
        }
        path = rewritten(honest, tmp_path / "a.mcap", attachments=files)
        if is_read:
            assert audit(path, in_process=True).resimulation == "bit for bit"
        else:
            reason = audit(path, in_process=True).reason
            assert "cannot read scene" in reason and "secret.xml" in reason


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("a\0b", "null byte"),
        ("a/../../b", "outside the scene's folder"),
        ("/etc/b", "outside the scene's folder"),
        ("a/" * 1500 + "b", "cannot be unpacked"),
        (".", "cannot be unpacked: Is a directory"),
        ("peg_in_hole.xml/b", "cannot be unpacked: "),
    ],
)
def test_an_attachment_that_cannot_lie_in_the_folder_is_named(
    name: str, words: str, honest: Recording, tmp_path: Path
) -> None:
    path = rewritten(honest, tmp_path / "a.mcap", attachments={SOURCE_PREFIX + name: b"x"})
    reason = told(path)
    assert words in reason and "\n" not in reason and "/tmp" not in reason.replace(str(path), "")


@pytest.mark.parametrize(
    ("refusal", "words"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "No space left on device"),
        (OSError(errno.EROFS, "Read-only file system"), "Read-only file system"),
        (UnicodeEncodeError("ascii", "ü", 0, 1, "no"), "set PYTHONUTF8=1"),
    ],
)
def test_a_machine_that_cannot_hold_the_scene_leaves_an_honest_run_unverified(
    refusal: Exception, words: str, honest: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: object) -> int:
        raise refusal

    monkeypatch.setattr(Path, "write_bytes", refused)
    report = audit(honest.path, in_process=True)
    assert report.verdict == "unverified"
    assert words in report.reason


def test_attachments_named_as_modules_are_not_imported(honest: Recording, tmp_path: Path) -> None:
    code = f"open({str(tmp_path / 'imported')!r}, 'w')".encode()
    names = ("numpy.py", "mujoco/__init__.py", "encodings.py", "sitecustomize.py")
    path = rewritten(
        honest,
        tmp_path / "a.mcap",
        attachments={**{SOURCE_PREFIX + name: code for name in names}, "json.py": code},
    )
    assert audit(path).resimulation == "bit for bit"
    assert audit(path, in_process=True).resimulation == "bit for bit"
    assert not (tmp_path / "imported").exists()


# Child process


def test_work_in_bounds_returns_its_result_and_raises_its_refusal() -> None:
    given = {"a": [1.5, None], "b": np.arange(6.0).reshape(2, 3), "c": b"x", "d": np.zeros((0, 3))}
    heard: list[object] = []

    def work(worker: Worker) -> object:
        worker.tell("half")
        return given

    found = in_bounds(work, "it", hear=heard.append)
    assert heard == ["half"]
    assert found["a"] == given["a"] and found["c"] == given["c"]
    for name in ("b", "d"):
        np.testing.assert_array_equal(found[name], given[name])

    for kind in (RecordingError, SceneError, CouplingError):

        def refuse(_: object, kind: type[HapticBridgeError] = kind) -> None:
            raise kind("no")

        with pytest.raises(kind, match=r"^no$"):
            in_bounds(refuse, "it")


def spin(_: object) -> None:
    while True:
        pass


def answer(data: bytes) -> Callable[[object], None]:
    """Returns work that writes bytes as its answer, as a process that was taken over may."""

    def work(_: object) -> None:
        pipes = (int(name) for name in os.listdir("/proc/self/fd") if int(name) > 2)  # noqa: PTH208
        for pipe in pipes:
            with contextlib.suppress(OSError):
                os.write(pipe, data)
        os._exit(0)

    return work


@pytest.mark.parametrize(
    ("work", "words"),
    [
        (crash, r"crashed MuJoCo \(SIGSEGV\)"),
        (lambda _: np.ones(1 << 28).sum(), "needs more than 1024 MB of memory"),
        (spin, "needs too much processor time"),
        (lambda _: time.sleep(1e3), "needs more than 1 s"),
        (lambda _: sys.exit(9), "made MuJoCo fail: SystemExit: 9"),
        (lambda _: object(), "made MuJoCo fail: TypeError: object cannot leave"),
        (answer(b"\1" + struct.pack("<IQ", 5, 0) + b'{"a":'), "gives a damaged result"),
        (answer(b"\1" + struct.pack("<IQ", 1, 1 << 40) + b"1"), "gives more than 512 MB"),
    ],
    ids=["crash", "memory", "time", "wait", "exit", "no numbers", "damaged", "too much"],
)
def test_work_out_of_bounds_is_named(
    work: Callable[[object], object], words: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(confinement, "COMPILE_TIME", 0.5)
    monkeypatch.setattr(confinement, "PATIENCE", 1.0 if "1 s" in words else 60.0)
    monkeypatch.setattr(confinement, "SHARE", 0.0 if "1 s" in words else 5.0)
    before = children()
    with pytest.raises(ForeignSceneError, match=f"^the scene {words}"):
        in_bounds(work, "the scene")
    assert children() <= before
    assert not list(tmp_path.iterdir())


def children() -> set[str]:
    """Returns the numbers of this process's children, also of those that have ended."""
    lists = Path("/proc/self/task").glob("*/children")
    return {number for each in lists for number in each.read_text().split()}


def test_a_child_has_the_time_that_it_is_allowed() -> None:
    def work(worker: Worker) -> list[float]:
        before = signal.getitimer(signal.ITIMER_PROF)[0]
        worker.allow_run()
        return [before, signal.getitimer(signal.ITIMER_PROF)[0]]

    before, after = in_bounds(work, "it", seconds=100.0)
    assert before <= confinement.COMPILE_TIME + 0.1 < 99.0 < after <= 100.1


def limits_of(worker: Worker) -> object:
    """Returns limits of this process, and if its timer runs and means confine it."""
    worker.allow_run()
    found = [resource.getrlimit(kind)[0] for kind in (resource.RLIMIT_AS, resource.RLIMIT_FSIZE)]
    return [found, signal.getitimer(signal.ITIMER_PROF)[0] > 0, bool(worker.means)]


@pytest.mark.parametrize("is_limited", [True, False])
def test_a_fresh_child_has_limits_unless_it_is_trusted(is_limited: bool) -> None:
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    fresh = confinement.Fresh(environment, gc.collect, is_limited)
    here = [resource.getrlimit(kind)[0] for kind in (resource.RLIMIT_AS, resource.RLIMIT_FSIZE)]
    with confinement.Confined(limits_of, "it", seconds=50.0, fresh=fresh) as child:
        limits, has_timer, has_means = child.result()
    assert (limits == here, has_timer, has_means) == (not is_limited, is_limited, is_limited)


@pytest.mark.parametrize("umask", [0o000, 0o022])
def test_a_childs_folder_is_its_users_alone_under_any_umask(umask: int) -> None:
    before = os.umask(umask)
    try:
        mode = in_bounds(lambda _: Path(tempfile.gettempdir()).stat().st_mode, "it")
    finally:
        os.umask(before)
    assert stat.S_IMODE(mode) == 0o700


def test_a_child_reads_only_what_it_is_given_and_has_no_network(tmp_path: Path) -> None:
    """Limits that the kernel lacks are not asserted; the audit says nothing different then."""
    secret, given = tmp_path / "secret", tmp_path / "given"
    secret.write_text("x")
    given.write_text("y")

    def tried(action: Callable[[], object]) -> bool:
        try:
            action()
        except OSError:
            return False
        return True

    def work(_: object) -> dict[str, bool]:
        return {
            "given": tried(given.read_text),
            "own": tried(lambda: Path(tempfile.mkdtemp(), "a").write_text("z")),
            "secret": tried(secret.read_text),
            "beside": tried(lambda: (tmp_path / "new").write_text("z")),
            "internet": tried(lambda: socket.socket().connect(("127.0.0.1", 1))),
            "service": tried(lambda: socket.socket(socket.AF_UNIX)),
        }

    means = confinement.means()
    found = in_bounds(work, "it", reads=(given,))
    assert found["given"] and found["own"]
    assert not found["internet"]  # nothing listens there
    if means["rules on paths"]:
        assert not found["secret"] and not found["beside"]
    if means["a filter of sockets"]:
        assert not found["service"]
    assert tried(secret.read_text)
    assert tried(lambda: socket.socket(socket.AF_UNIX).close())


def error_of(action: Callable[[], object]) -> int:
    """Returns the number of the error in which an action ends; 0 without one."""
    try:
        action()
    except OSError as error:
        return error.errno or -1
    return 0


@pytest.mark.skipif(sys.platform != "linux", reason="the numbers are Linux'")
def test_a_child_has_few_and_small_files_no_dump_and_no_descriptor_of_this_process(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(confinement, "MAX_FILE", 1 << 20)
    monkeypatch.setattr(confinement, "MAX_FILES", 64)
    libc = ctypes.CDLL(None, use_errno=True)
    io_uring_setup, get_death_signal = 425, 2

    def work(worker: Worker) -> dict[str, int]:
        large = Path(tempfile.mkdtemp(), "large")
        signal_of_death = ctypes.c_int()
        libc.prctl(get_death_signal, ctypes.byref(signal_of_death), 0, 0, 0)
        libc.syscall(io_uring_setup, 1, None)
        return {
            "io_uring": ctypes.get_errno() if worker.means["a filter of sockets"] else errno.EPERM,
            "death": signal_of_death.value,
            "foreign": error_of(lambda: os.fstat(mine.fileno())),
            "size": error_of(lambda: large.write_bytes(bytes(1 << 21))),
            "count": error_of(lambda: [os.dup(1) for _ in range(100)]),
            "dump": resource.getrlimit(resource.RLIMIT_CORE)[0],
            "alone": int(Path("/proc/self/ns/net").readlink() == network)
            if worker.means["a network of its own"]
            else 0,
        }

    network = Path("/proc/self/ns/net").readlink()
    with (tmp_path / "mine").open("w") as mine:
        found = in_bounds(work, "it")
    assert found == {
        "io_uring": errno.EPERM,
        "death": signal.SIGKILL,
        "size": errno.EFBIG,
        "count": errno.EMFILE,
        "foreign": errno.EBADF,
        "dump": 0,
        "alone": 0,
    }


@pytest.mark.parametrize("kind", ["|O8", "<U4", "<M8[s]"])
def test_an_answer_holds_numbers_alone(kind: str) -> None:
    text = b'{"array of bytes": ["%s", 1]}' % kind.encode()
    with pytest.raises(ValueError, match=r"an array holds no numbers|not understood"):
        unpacked(text, bytes(64))


def test_the_audit_is_the_same_where_the_kernel_has_no_such_means(
    honest: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(confinement, "_LINUX", False)
    assert not any(confinement.means().values())
    assert audit(honest.path).resimulation == "bit for bit"


def test_a_crash_of_a_scene_is_exit_code_2_and_a_row(
    honest: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: Called
) -> None:
    path = rewritten(honest, tmp_path / "a.mcap")
    monkeypatch.setattr(sys.modules[Resimulator.__module__], "Resimulator", crash)
    code, _, err = call("audit", path)
    assert code == 2
    assert "crashed MuJoCo (SIGSEGV)" in err
    code, out, _ = call("audit", path, honest.path)
    assert code == 2
    assert "2 unreadable" in out


def test_a_trusted_scene_is_simulated_here(
    honest: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "fork", lambda: pytest.fail("a child process was started"))
    assert audit(honest.path, in_process=True).resimulation == "bit for bit"
    scene = compile_recorded(honest)
    assert scene.name == honest.meta["scene"]
    assert len(what_if(honest.path, {}, in_process=True).runs) > 1
    replay = pytest.importorskip("hapticbridge.view.replay").Replay
    assert len(replay(honest.path, in_process=True).sights) > 1


def test_a_program_without_standard_streams_may_audit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of one with a window alone, where Python has None in their place."""
    recorded(tmp_path / "run.mcap", "point_mass", duration=0.05)
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, None)
    assert audit(tmp_path / "run.mcap").resimulation == "bit for bit"

"""Every wait of the program has a time limit, or stands in the table with what ends it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import hapticbridge

PACKAGE = Path(hapticbridge.__file__).parent

ENDLESS = {
    "accept", "acquire", "communicate", "exception", "get", "join", "poll", "read", "recv",
    "result", "wait",
}  # fmt: skip
"""Methods that wait without end if they get no argument. Of Popen, ``poll`` never waits."""

FLAGGED = {
    "as_completed", "connection.wait", "fcntl.flock", "input", "os.read", "os.wait", "os.waitpid",
    "readline", "select.poll", "select.select", "shutdown", "signal.pause", "signal.sigwait",
    "subprocess.call", "subprocess.check_call", "subprocess.check_output", "subprocess.run", "wait",
}  # fmt: skip
"""Functions that wait, whatever their arguments, unless one is a ``timeout`` or a flag against."""

STREAMS = {"answers", "pipe", "stdin", "stdout", "stream"}
"""Names over which a loop waits for the other end of a pipe."""

FILES = {"_file", "file", "pages", "self._file", "self._snapshot"}
"""Names of which ``read`` reads a file or memory of this process, which wait for nothing."""

USERS = "a study takes what its functions take; Ctrl-C ends them"
DAEMON = "a thread that ends with its process; nothing waits for it"

REASONS = {
    # the loop
    "run/bridge.py: wait()": "a clock's: at most one period",
    "demand/guard.py: clock.wait()": "a clock's: at most one period",
    "demand/probe.py: clock.wait()": "a clock's: at most one period",
    "demand/probe.py: for line in self.answers": "no wait: answers of a device's axes",
    "identify/identify.py: clock.wait()": "a clock's: at most one period",
    "identify/z_width.py: self.clock.wait()": "a clock's: at most one period",
    "realtime/doctor.py: wait()": "a clock's: at most one period",
    "kernel/machine_code.py: for line in sys.stdin": "the end of the process that asks closes it",
    "run/endpoint.py: super().wait()": "simulated time waits for nothing",
    "program/device_loop.py: self._socket.shutdown(socket.SHUT_RD)": "that of a socket returns",
    "run/endpoint.py: self._thread.join()": "it looks for the end every REPORT_PERIOD",
    "run/endpoint.py: time.sleep(LAST_WORDS / 10)": "until LAST_WORDS is over",
    "program/device_loop.py: time.sleep(REPEAT)": DAEMON,
    "cli/serve.py: time.sleep(LOOK)": DAEMON,
    "program/loop_process.py: for line in stream": DAEMON,
    "program/loop_process.py: told.read()": "the process has ended",
    # devices and their guardian
    "device/transport/hid.py: self._wake.wait()": f"{DAEMON} longer than MAX_WRITE",
    "device/rawhid/serial.py: self._ports.sleep(PAUSE)": "until the time of its caller is over",
    "device/touch/device.py: self._time.sleep(0.001)": "its loop ends with a time",
    "device/touch/device.py: self._time.sleep(0.1 * CALIBRATION_TIME)": "its loop ends with a time",
    "device/wheel/evdev.py: os.read(file, size)": "the file is opened with O_NONBLOCK",
    "device/watchdog.py: select.select([ready], [], [], START_PATIENCE)": "its last argument",
    # records, and the processes that read them
    "recording/recorder.py: for line in answers": f"{DAEMON} longer than STANDSTILL",
    "recording/recorder_process.py: for line in stream": DAEMON,
    "recording/recorder_process.py: stream.readline()": "the bridge's end closes it",
    "recording/recorder_process.py: time.sleep(0.1)": "once, when the bridge is dead",
    "recording/recorder_process.py: time.sleep(POLL)": "until the bridge closes, or is dead",
    "recording/ring.py: fcntl.flock(file, fcntl.LOCK_SH)": "the user's own processes lock it "
    "exclusively for the time of one removal",
    "recording/container.py: with ThreadPoolExecutor(2)": "compression of a chunk in memory",
    "recording/container.py: record.result()": "compression of a chunk in memory",
    "view/process.py: stream.readline()": "the bridge's end closes it",
    "view/process.py: time.sleep(due - now)": "until the bridge closes its end, or is dead",
    "view/controls.py: time.sleep(pace)": DAEMON,
    "view/window.py: stream.readline()": DAEMON,
    "view/window.py: stream.readline(MAX_LINE + 1)": DAEMON,
    "view/window.py: time.sleep(INTERVAL)": DAEMON,
    "view/window.py: time.sleep(HAND_INTERVAL)": DAEMON,
    "view/window.py: self._outbox.get()": DAEMON,
    # pictures, foreign scenes
    "confinement.py: os.waitpid(self._child, 0)": "it was killed",
    "confinement.py: select.poll()": "makes the object, which waits with a limit",
    "confinement.py: os.waitpid(self._child, os.WNOHANG)": "it does not wait",
    "confinement.py: os.read(self._reading, min(size - len(pieces), 1 << 20))": "poll has data",
    "audit/replay.py: child.result()": "it has a time limit of its own",
    # studies
    "sweep.py: wait(running, return_when=FIRST_COMPLETED)": USERS,
    "sweep.py: wait(running)": USERS,
    "sweep.py: future.exception()": "its future is done",
    "sweep.py: future.result()": "its future is done",
    "sweep.py: pool.submit(_outcomes, function, [point]).result()": USERS,
    "sweep.py: probe.result()": "imports a module in a process, which ends or breaks",
    "sweep.py: pool.shutdown(wait=True, cancel_futures=True)": USERS,
    "sweep.py: barrier.wait()": "a worker ends with its parent",
    "sweep.py: connection.wait([parent.sentinel])": DAEMON,
    "tools/compare.py: for line in stream": "no wait: records of a file",
    "testing/device_contract.py: bench.clock.wait()": "a clock's: at most one period",
    "testing/device_contract.py: self.clock.wait()": "a clock's: at most one period",
}
"""Ends of the waits without a time limit of their own. A new wait gets a limit, or a line here."""


def dotted(node: ast.expr) -> str:
    """Returns the text of a name with dots, without what is called or indexed in it."""
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def is_endless(call: ast.Call, *, is_in_loop: bool) -> bool:
    """Returns whether a call may wait without end."""
    name, named = dotted(call.func), {keyword.arg for keyword in call.keywords}
    receiver, _, last = name.rpartition(".")
    if "timeout" in named or "LOCK_NB" in ast.unparse(call):
        return False
    if last == "sleep":
        return is_in_loop
    if name in FLAGGED or (receiver and last in {"readline", "shutdown"}):
        return True
    is_bare = not call.args and not call.keywords
    if last in ENDLESS and is_bare and isinstance(call.func, ast.Attribute):
        is_process = "process" in receiver and last == "poll"
        return receiver not in FILES and not is_process
    return is_bare and name == "wait"


def waits(source: str) -> Iterator[str]:
    """Yields the text of each call, loop and context that may wait without end."""
    inside = {
        child
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.While)
        for child in map(ast.dump, ast.walk(node))
    }
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call):
            if is_endless(node, is_in_loop=ast.dump(node) in inside):
                yield ast.unparse(node)
        elif isinstance(node, ast.For) and dotted(node.iter).rpartition(".")[2] in STREAMS:
            yield f"for line in {ast.unparse(node.iter)}"
        elif isinstance(node, ast.With):
            for item in node.items:
                text = ast.unparse(item.context_expr)
                if "PoolExecutor(" in text or text == "process":
                    yield f"with {text}"


def test_every_wait_has_a_limit_or_a_reason() -> None:
    found = {
        f"{path.relative_to(PACKAGE).as_posix()}: {text}"
        for path in PACKAGE.rglob("*.py")
        for text in waits(path.read_text(encoding="utf-8"))
    }
    assert sorted(found - set(REASONS)) == []  # a wait without a limit
    assert sorted(set(REASONS) - found) == []  # a line without its wait


@pytest.mark.parametrize(
    ("source", "count"),
    [
        ("process.wait()", 1),
        ("process.wait(2.0)", 0),
        ("process.wait(timeout=2.0)", 0),
        ("thread.join()", 1),
        ("thread.join(2.0)", 0),
        ("', '.join(words)", 0),
        ("queue.get()", 1),
        ("table.get('x')", 0),
        ("queue.get_nowait()", 0),
        ("process.poll()", 0),
        ("subprocess.run(['a'])", 1),
        ("subprocess.run(['a'], timeout=1.0)", 0),
        ("lock.acquire()", 1),
        ("fcntl.flock(file, fcntl.LOCK_SH)", 1),
        ("fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)", 0),
        ("connection.recv()", 1),
        ("for line in process.stdout: pass", 1),
        ("while is_on:\n    time.sleep(1)", 1),
        ("time.sleep(1)", 0),
        ("with ThreadPoolExecutor(2) as pool: pass", 1),
    ],
)
def test_the_search_finds_waits_and_nothing_else(source: str, count: int) -> None:
    assert len(list(waits(source))) == count

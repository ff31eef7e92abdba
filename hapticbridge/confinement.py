"""Child process for foreign work, with limits on memory, time and files and without a network.

The child is a fork, so nothing is imported or read again, or a fresh interpreter (``Fresh``).
Linux gives these means to any user:

- limits of resources (``setrlimit``);
- a network of its own without an interface (``unshare``) and a filter that refuses sockets
  (``seccomp``), which also keeps it from the sockets of local services;
- rules on paths (Landlock, from Linux 5.13): it reads programs, and what its caller names.

A missing one changes no result; ``hapticbridge doctor`` names it.
"""

from __future__ import annotations

import contextlib
import ctypes
import faulthandler
import json
import os
import pickle
import platform
import select
import shutil
import signal
import struct
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from hapticbridge.errors import (
    CouplingError,
    DeviceError,
    HapticBridgeError,
    RecordingError,
    SceneError,
)

if sys.platform != "win32":
    import resource

MEMORY = 1024 << 20
"""Memory in bytes that foreign work may take beyond the present process. Robots with large meshes
take more than 640 MB to compile; with more, a hostile scene could take a small machine's memory."""

COMPILE_TIME = 10.0
"""Processor time in s in which a foreign scene must compile. The shipped scenes take 0.1 s, a robot
with large meshes 2.5 s, and a slower machine several times that. With more, a hostile scene would
keep its user waiting."""

PATIENCE, SHARE = 10.0, 5.0
"""Time in s that a child may take beyond ``SHARE`` times its processor time. A child that waits
uses no processor; on a busy machine an honest one has a fifth of it."""

LONGEST = 4e5
"""Largest processor time in s of a child; one without limits has it. No film takes four days, and
the kernel waits up to 2e6 s, ``SHARE`` times as long. A child that hangs ends then."""

MAX_FILE, MAX_FILES = 256 << 20, 256
"""Size in bytes of a file that the child may write, and number of files it may have open."""

MAX_ANSWER = 1 << 29
"""Bytes that a child may hand back. Every instant of ten minutes of a large scene takes 100 MB."""


class ForeignSceneError(HapticBridgeError):
    """A foreign scene crashed MuJoCo, or needs more than its share of memory or time."""


# Result of the work, as numbers and texts

_FRAME = struct.Struct("<BIQ")
_ARRAY = "array of bytes"
_TOLD, _DONE, _REFUSED, _FAILED = range(4)


def packed(kind: int, value: object) -> list[bytes | memoryview]:
    """Returns a message as bytes: numbers, texts, lists, mappings, arrays of numbers, and bytes.

    It holds no code and no references, unlike ``pickle``: its reader trusts no sender.
    """
    pieces: list[bytes | memoryview] = []

    def placed(item: object) -> object:
        if isinstance(item, np.ndarray):
            item = np.ascontiguousarray(item)
            pieces.append(item.data.cast("B") if item.size else b"")
            return {_ARRAY: [item.dtype.str, *item.shape]}
        if isinstance(item, bytes):
            pieces.append(item)
            return {_ARRAY: ["bytes", len(item)]}
        if isinstance(item, np.generic):
            return item.item()
        raise TypeError(f"{type(item).__name__} cannot leave the child process")

    text = json.dumps(value, default=placed).encode()
    return [_FRAME.pack(kind, len(text), sum(len(piece) for piece in pieces)), text, *pieces]


def unpacked(text: bytes, data: bytes) -> Any:
    """Returns a message; arrays are views of its data.

    Raises:
        ValueError: The message is damaged.
    """
    start = 0

    def array(mapping: dict[str, Any]) -> object:
        nonlocal start
        if _ARRAY not in mapping:
            return mapping
        kind, *shape = mapping[_ARRAY]
        if not all(type(side) is int and side >= 0 for side in shape):
            raise ValueError("the shape of an array is no shape")
        if kind == "bytes":
            start += shape[0]
            return data[start - shape[0] : start]
        dtype = np.dtype(str(kind))
        if dtype.kind not in "biuf":
            raise ValueError("an array holds no numbers")
        count = int(np.prod(shape, dtype=object))
        item = np.frombuffer(data, dtype, count, start).reshape(shape)
        start += item.nbytes
        return item

    return json.loads(text, object_hook=array)


class Worker(Protocol):
    """Limits of the process as seen by the work in it.

    Attributes:
        means: The means that confine it, and if they work, by name.
    """

    means: dict[str, bool]

    def allow_run(self) -> None:
        """Gives the process the time of the run from now on; before, it may only compile."""

    def tell(self, value: object) -> None:
        """Hands over a part of the result."""


class Unlimited:
    """Stands for the limits where work is trusted and done in this process."""

    def __init__(self, hear: Callable[[Any], None] | None = None) -> None:
        self._hear = hear
        self.means: dict[str, bool] = {}

    def allow_run(self) -> None:
        """Implements ``Worker.allow_run``."""

    def tell(self, value: object) -> None:
        """Implements ``Worker.tell``."""
        if self._hear is not None:
            self._hear(value)


Work = Callable[[Worker], object]


# Child process


@dataclass(frozen=True, slots=True)
class Fresh:
    """Start of a child as a fresh interpreter, for libraries that a fork would break.

    The work and ``prepare`` are then pickled: functions of modules, with small arguments.

    Attributes:
        environment: Environment of the child.
        prepare: Called before the child is limited, for what is not foreign.
        is_limited: False sets no limits; a crash still ends the child alone.
    """

    environment: Mapping[str, str]
    prepare: Callable[[], object]
    is_limited: bool = True


_FRESH = """
import os, sys
answer = os.dup(1)
os.dup2(2, 1)
sys.path.insert(0, sys.argv[1])
from hapticbridge.confinement import work_fresh
work_fresh(answer, sys.argv[2])
"""
# what a driver prints goes to the void


class Confined:
    """Foreign work in a child process, which ends with it or with this process.

    As a context, it ends the child when it is left.

    Args:
        work: Function to call in the child. It returns and tells what ``packed`` takes.
        what: Name of what is worked on, for the message.
        seconds: Processor time in s that the child has after ``Worker.allow_run``.
        fresh: Start of the child if it is not a fork.
        on_error: Function that lets MuJoCo report an error that would end a forked child.
        **limits: As for ``confine``.
    """

    def __init__(
        self,
        work: Work,
        what: str,
        *,
        seconds: float = 0.0,
        fresh: Fresh | None = None,
        on_error: Callable[[Callable[[str], None]], None] | None = None,
        **limits: Any,
    ) -> None:
        self._what, self._work = what, work
        is_limited = fresh is None or fresh.is_limited
        seconds = min(seconds, LONGEST) if is_limited else LONGEST
        self._folder = tempfile.mkdtemp(prefix="hapticbridge-")
        self._until = time.monotonic() + PATIENCE + SHARE * (COMPILE_TIME + seconds)
        self._patience = self._until - time.monotonic()
        self._child, self._fresh = 0, fresh
        if sys.platform == "win32":
            return
        self._reading, writing = os.pipe()
        limits["writes"] = (*limits.get("writes", ()), self._folder)
        if fresh is not None:
            job = pickle.dumps((work, seconds, limits, fresh, self._folder)).hex()
            package = str(Path(__file__).resolve().parents[1])
            # -P: a file in the user's working folder must not replace a module
            command = [sys.executable, "-P", "-c", _FRESH, package, job]
            void = (os.POSIX_SPAWN_OPEN, 2, os.devnull, os.O_WRONLY, 0)
            self._child = os.posix_spawn(
                sys.executable,
                command,
                fresh.environment,
                file_actions=[(os.POSIX_SPAWN_DUP2, writing, 1), void],
            )
        else:
            for stream in (sys.stdout, sys.stderr):
                if stream is not None:  # as where they are closed
                    stream.flush()
            self._child = os.fork()
            if self._child == 0:
                limited = _Limits(writing, seconds, limits)
                if on_error is not None:
                    on_error(limited.fail)
                limited.work_and_exit(work, self._folder)
        os.close(writing)

    def __enter__(self) -> Confined:
        return self

    def __exit__(self, *_: object) -> None:
        if self._child:
            with contextlib.suppress(OSError):
                os.kill(self._child, signal.SIGKILL)
            os.close(self._reading)
            os.waitpid(self._child, 0)
        shutil.rmtree(self._folder, ignore_errors=True)

    def _prepare(self) -> None:
        """Prepares fresh work where it is done in this process."""
        try:
            if self._fresh is not None:
                self._fresh.prepare()
        except Exception as error:
            raise ForeignSceneError(f"{self._what} {failure(error)[0]}") from None

    def result(self, hear: Callable[[Any], None] | None = None) -> Any:
        """Waits for the work; returns its result.

        ``hear`` is called with what the work tells meanwhile.

        Raises:
            RecordingError: The work raised it.
            ForeignSceneError: The child crashed, exceeded its limits, or made no progress.
        """
        if sys.platform == "win32":
            self._prepare()
            return self._work(Unlimited(hear))
        room = MAX_ANSWER
        while frame := self._read(_FRAME.size):
            kind, size, rest = _FRAME.unpack(frame)
            room -= size + rest
            if room < 0 or kind > _FAILED:
                raise ForeignSceneError(
                    f"{self._what} gives more than {MAX_ANSWER >> 20} MB of results"
                )
            try:
                result = unpacked(self._read(size), self._read(rest))
            except (ValueError, TypeError, RecursionError) as error:
                raise ForeignSceneError(f"{self._what} gives a damaged result: {error}") from None
            if kind == _DONE:
                return result
            if kind == _REFUSED:
                raise _refusal(result)
            if kind == _FAILED:
                raise ForeignSceneError(f"{self._what} {result}")
            if hear is not None:
                hear(result)
        for _ in range(100):  # its end closed the pipe; if not, it is killed
            child, status = os.waitpid(self._child, os.WNOHANG)
            if child:
                self._child = 0
                os.close(self._reading)
                break
            time.sleep(0.01)
        else:
            status = -signal.SIGKILL
        code = os.waitstatus_to_exitcode(status) if status >= 0 else status
        raise ForeignSceneError(f"{self._what} {death(code)}")

    def _read(self, size: int) -> bytes:
        """Reads from the child; returns less only if it ended."""
        pieces = bytearray()
        ready = select.poll()
        ready.register(self._reading, select.POLLIN)
        while len(pieces) < size:
            left = max(self._until - time.monotonic(), 0.0)
            if not ready.poll(1e3 * left):
                raise ForeignSceneError(f"{self._what} needs more than {self._patience:.0f} s")
            piece = os.read(self._reading, min(size - len(pieces), 1 << 20))
            if not piece:
                break
            pieces += piece
        return bytes(pieces)


def _refusal(refusal: Any) -> HapticBridgeError:
    """Returns the error of the work; one of another class than these as a RecordingError."""
    classes = {each.__name__: each for each in (CouplingError, DeviceError, SceneError)}
    name, words = refusal if isinstance(refusal, list) and len(refusal) == 2 else ("", refusal)
    return classes.get(str(name), RecordingError)(str(words))


def in_bounds(work: Work, what: str, *, trusted: bool = False, **bounds: Any) -> Any:
    """Does foreign work in a child process, or a trusted one in this; returns its result.

    Args:
        work: As for ``Confined``.
        what: Name of what is worked on.
        trusted: True if it is done in this process.
        **bounds: As for ``Confined``, and ``hear`` as for ``Confined.result``.

    Raises:
        RecordingError: The work raised it.
        ForeignSceneError: The child crashed, exceeded its limits, or made no progress.
    """
    hear = bounds.pop("hear", None)
    if trusted:
        return work(Unlimited(hear))
    with Confined(work, what, **bounds) as child:
        return child.result(hear)


class _Limits:
    """Limits of this process, which is the child; implements ``Worker``."""

    def __init__(
        self, answer: int, seconds: float, limits: dict[str, Any], fresh: Fresh | None = None
    ) -> None:
        self._answer, self._seconds, self._limits, self._fresh = answer, seconds, limits, fresh
        self._is_limited = fresh is None or fresh.is_limited
        self.means: dict[str, bool] = {}

    def work_and_exit(self, work: Work, folder: str) -> None:
        words: object = ""
        is_refusal = False
        try:
            faulthandler.disable()
            tempfile.tempdir = folder
            _die_with_parent()
            os.closerange(3, self._answer)
            os.closerange(self._answer + 1, 1 << 20)
            if self._fresh is not None:
                self._fresh.prepare()
            if self._is_limited:
                self.means = confine(**self._limits)
            self._send(_DONE, work(self))
            os._exit(0)
        except BaseException as error:
            words, is_refusal = failure(error)
            words = [type(error).__name__, words] if is_refusal else words
        finally:
            with contextlib.suppress(BaseException):
                self._send(_REFUSED if is_refusal else _FAILED, words)
            os._exit(1)

    def fail(self, words: str) -> None:
        """Hands over MuJoCo's error message and ends this process."""
        self._send(_FAILED, f"made MuJoCo fail: {' '.join(words.split())[:200]}")
        os._exit(1)

    def _send(self, kind: int, value: object) -> None:
        for piece in packed(kind, value):
            view = memoryview(piece)
            while view:
                view = view[os.write(self._answer, view) :]

    def allow_run(self) -> None:
        """Implements ``Worker.allow_run``."""
        if self._is_limited:
            allow_time(self._seconds)

    def tell(self, value: object) -> None:
        """Implements ``Worker.tell``."""
        self._send(_TOLD, value)


def work_fresh(answer: int, job: str) -> None:
    """Does the job of a ``Fresh`` child and ends this process, which is the child."""
    work, seconds, limits, fresh, folder = pickle.loads(bytes.fromhex(job))
    _Limits(answer, seconds, limits, fresh).work_and_exit(work, folder)


_NO_ROOM = (
    f"needs more than {MEMORY >> 20} MB of memory; --in-process sets no limit, for a scene that "
    "you trust"
)
_NO_TIME = "needs too much processor time; --in-process sets no limit, for a scene that you trust"


def failure(error: BaseException) -> tuple[str, bool]:
    """Returns what to say of an error of foreign work, and True if it refuses the recording."""
    if isinstance(error, MemoryError) or "allocate memory" in str(error):  # MuJoCo's words
        return _NO_ROOM, False
    if isinstance(error, HapticBridgeError):
        return str(error), True
    words = " ".join(f"{type(error).__name__}: {error}".split())[:200]
    return f"made MuJoCo fail: {words}", False


def death(code: int) -> str:
    """Returns what to say of a process that foreign work ended, by its exit code."""
    if sys.platform != "win32" and code in (-signal.SIGXCPU, -signal.SIGPROF):
        return _NO_TIME
    name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
    return f"crashed MuJoCo ({name})"


# Limits of the present process


def confine(
    *, reads: Iterable[Any] = (), writes: Iterable[Any] = (), memory: int = MEMORY
) -> dict[str, bool]:
    """Limits this process and all that it starts, for good.

    Args:
        reads: Files and folders that it may read besides programs.
        writes: Folders in which it may also write.
        memory: Address space in bytes that it may take beyond what it has. Of the latter it may
            fill what is idle.

    Returns:
        The means beside the limits of resources, and if they work, by name.
    """
    if sys.platform == "win32":
        return {}
    _limit_memory(memory)
    _lower(resource.RLIMIT_FSIZE, MAX_FILE)
    _lower(resource.RLIMIT_NOFILE, MAX_FILES)
    _lower(resource.RLIMIT_CORE, 0)
    allow_time(COMPILE_TIME)
    return {
        "a network of its own": leave_network(),
        "a filter of sockets": refuse_sockets(),
        "rules on paths": limit_paths(reads, writes),
    }


def _limit_memory(more: int) -> None:
    with contextlib.suppress(OSError), open("/proc/self/statm", encoding="ascii") as pages:  # noqa: PTH123
        present = int(pages.read().split()[0]) * resource.getpagesize()
        _lower(resource.RLIMIT_AS, present + more)


def _lower(kind: int, most: int) -> None:
    soft, hard = resource.getrlimit(kind)
    known = [each for each in (soft, most) if each != resource.RLIM_INFINITY]
    resource.setrlimit(kind, (min(known), hard))


def allow_time(seconds: float) -> None:
    """Ends this process after so many seconds of processor time from now on."""
    if sys.platform != "win32":
        # the timer knows fractions; the limit in whole seconds stands behind it
        signal.setitimer(signal.ITIMER_PROF, max(seconds, 1e-3))
        used = resource.getrusage(resource.RUSAGE_SELF)
        until = int(used.ru_utime + used.ru_stime + seconds) + 2
        _, hard = resource.getrlimit(resource.RLIMIT_CPU)
        if hard != resource.RLIM_INFINITY:
            until = min(until, hard)
        resource.setrlimit(resource.RLIMIT_CPU, (until, hard))


PATIENCE_HERE = 60.0
"""Time in s in which a user's own scene must compile. The slowest of 285 public ones takes 9 s."""


def machine_memory() -> int:
    """Returns the memory of this machine in bytes."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


@contextlib.contextmanager
def bounded_here(end: Callable[[str], None]) -> Iterator[None]:
    """Bounds memory and time of a compilation in this process.

    Beyond the memory of the machine, an allocation fails, which MuJoCo reports. MuJoCo cannot be
    interrupted: after ``PATIENCE_HERE``, ``end`` is called in another thread with a clause and must
    end the process.
    """
    if sys.platform == "win32":
        yield
        return
    before = resource.getrlimit(resource.RLIMIT_AS)
    watch = threading.Timer(
        PATIENCE_HERE, end, (f"takes more than {PATIENCE_HERE:g} s to compile",)
    )
    watch.daemon = True
    _limit_memory(machine_memory())
    watch.start()
    try:
        yield
    finally:
        watch.cancel()
        resource.setrlimit(resource.RLIMIT_AS, before)


_LINUX = sys.platform == "linux"
_PR_SET_PDEATHSIG, _PR_SET_SECCOMP, _PR_SET_NO_NEW_PRIVS = 1, 22, 38


def _libc() -> Any:
    return ctypes.CDLL(None, use_errno=True)


def _die_with_parent() -> None:
    if _LINUX:
        _libc().prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)


def leave_network() -> bool:
    """Moves this process to a network of its own without interfaces; returns True if it did."""
    new_user, new_network = 0x10000000, 0x40000000
    return _LINUX and _libc().unshare(new_user | new_network) == 0


_SOCKET = {"x86_64": (0xC000003E, 41), "aarch64": (0xC00000B7, 198)}
"""Code of an architecture and number of its system call ``socket``, from Linux' headers."""


def refuse_sockets() -> bool:
    """Refuses this process new sockets, also to local services; returns True if it does."""
    if not _LINUX or platform.machine() not in _SOCKET or sys.maxsize < 1 << 32:
        return False
    architecture, socket = _SOCKET[platform.machine()]
    load, is_equal, is_above, give = 0x20, 0x15, 0x35, 0x06
    allowed, refused = 0x7FFF0000, 0x00050001  # EPERM
    io_uring_setup, other_abi = 425, 0x40000000
    lines = [
        (load, 0, 0, 4),
        (is_equal, 0, 4, architecture),
        (load, 0, 0, 0),
        (is_above, 2, 0, other_abi),
        (is_equal, 1, 0, socket),
        (is_equal, 0, 1, io_uring_setup),
        (give, 0, 0, refused),
        (give, 0, 0, allowed),
    ]
    code = ctypes.create_string_buffer(b"".join(struct.pack("<HBBI", *line) for line in lines))
    program = ctypes.create_string_buffer(struct.pack("@HP", len(lines), ctypes.addressof(code)))
    libc = _libc()
    libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
    return bool(libc.prctl(_PR_SET_SECCOMP, 2, ctypes.byref(program), 0, 0) == 0)


_CREATE_RULESET, _ADD_RULE, _RESTRICT = 444, 445, 446
_READ = 0x1 | 0x4 | 0x8  # execute, read a file, read a folder
_ONE_FILE = 0x1 | 0x2 | 0x4 | 1 << 14 | 1 << 15  # the rights that a file has


def landlock_version() -> int:
    """Returns the version of the kernel's rules on paths; 0 without them."""
    return max(int(_libc().syscall(_CREATE_RULESET, None, 0, 1)), 0) if _LINUX else 0


def limit_paths(reads: Iterable[Any], writes: Iterable[Any]) -> bool:
    """Restricts this process to programs and some paths; returns True if the kernel does."""
    version = landlock_version()
    if not version:
        return False
    libc = _libc()
    every = (1 << 13 + (version >= 2) + (version >= 3)) - 1 | (version >= 5) << 15
    tcp, scopes = 3 * (version >= 4), 3 * (version >= 6)
    size = 8 * (1 + (version >= 4) + (version >= 6))
    rules = libc.syscall(_CREATE_RULESET, struct.pack("<QQQ", every, tcp, scopes), size, 0)
    if rules < 0:
        return False
    try:
        wanted = [(path, _READ) for path in (*_programs(), *map(str, reads))]
        wanted += [(path, every) for path in ("/dev/null", *map(str, writes))]
        for path, rights in wanted:
            try:
                place = os.open(path, os.O_PATH | os.O_CLOEXEC)
            except OSError:
                continue
            known = every if Path(path).is_dir() else _ONE_FILE & every
            libc.syscall(_ADD_RULE, rules, 1, struct.pack("<Qi", rights & known, place), 0)
            os.close(place)
        libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
        return bool(libc.syscall(_RESTRICT, rules, 0) == 0)
    finally:
        os.close(rules)


def _programs() -> tuple[str, ...]:
    package = Path(__file__).resolve().parents[1]
    here = (package / "hapticbridge", package / "models")
    prefixes = sys.prefix, sys.base_prefix, sys.exec_prefix
    system = "/usr", "/lib", "/lib64", "/bin", "/etc/ld.so.cache", "/opt"
    facts = "/proc/cpuinfo", "/proc/meminfo", "/proc/self", "/sys/devices/system", "/dev/urandom"
    return (*map(str, here), *prefixes, *system, *facts)


def means() -> dict[str, bool]:
    """Returns the means of this machine that confine a child, and if they work, by name."""
    if sys.platform == "win32":
        return {}
    trial: dict[str, bool] = in_bounds(lambda worker: worker.means, "the trial")
    return trial

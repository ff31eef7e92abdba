"""Machine code on disk: it computes what Python does; a bad file or folder costs only time."""

from __future__ import annotations

import hashlib
import importlib
import os
import shutil
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from hapticbridge.device.profile import profiles
from hapticbridge.errors import HapticBridgeError
from hapticbridge.kernel import jit, machine_code
from hapticbridge.kernel.jit import Program, compiled, direct, external, prepare
from hapticbridge.kernel.jit import compiled_for_threads as threaded

PAIR = np.dtype([("first", "<f8"), ("second", "<i8")])


def weighted(
    table: NDArray[np.float64],
    pairs: NDArray[np.void],
    pair: Any,
    factor: float,
    shift: int,
    negates: bool,
) -> float:
    total = factor * table[1, 2] + table[-1, -1] + pairs[1]["first"] + pair["first"] + table.size
    table[0, 0] = total + shift + pair["second"]
    return float(-total if negates else total)


def is_above(pair: Any, limit: float) -> bool:
    return bool(pair["first"] > limit)


def rows_of(table: NDArray[np.float64]) -> int:
    return int(table.shape[0] + 10 * table.shape[1])


def clear(table: NDArray[np.float64]) -> None:
    for row in table:
        for i in range(row.size):
            row[i] = 0.0


def allocating(table: NDArray[np.float64]) -> float:
    return float(np.cumsum(table[0])[-1])


def raising(table: NDArray[np.float64]) -> int:
    if table[0, 0] > 0.0:
        raise ValueError("positive")
    return 1


def paired(both: tuple[NDArray[np.float64], NDArray[np.void], int], factor: float) -> float:
    both[0][0, 0] += factor
    return float(both[0][2, 3] + both[1][1]["first"] * both[2])


def arguments_of_weighted() -> tuple[Any, ...]:
    pairs = np.array([(1.5, 2), (2.5, 3)], PAIR)
    return np.arange(12.0).reshape(3, 4), pairs, pairs[0], 0.1, 7, True


CASES: dict[str, tuple[Callable[..., Any], Callable[[], tuple[Any, ...]]]] = {
    "every kind of argument": (weighted, arguments_of_weighted),
    "truth": (is_above, lambda: (np.ones(1, PAIR)[0], 0.5)),
    "integer": (rows_of, lambda: (np.zeros((3, 4)),)),
    "no result": (clear, lambda: (np.ones((3, 4)),)),
    "tuple": (paired, lambda: ((np.ones((3, 4)), np.ones(2, PAIR), 3), 0.5)),
    "allocation": (allocating, lambda: (np.ones((3, 4)),)),
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A cache of its own."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    jit.cache_folder.cache_clear()
    found = jit.cache_folder()
    assert found is not None
    yield found
    jit.cache_folder.cache_clear()


@pytest.mark.parametrize("name", CASES)
def test_machine_code_from_disk_does_what_python_does(name: str, folder: Path) -> None:
    function, arguments = CASES[name]
    expected = arguments()
    result = function(*expected)
    for _ in range(2):  # compiled, then from disk
        given = arguments()
        answer = direct(compiled(function), *given)(*given)
        assert answer == result
        assert isinstance(answer, type(result)) or isinstance(result, type(answer))
        for one, other in zip(given, expected, strict=True):
            pairs = zip(one, other, strict=True) if isinstance(one, tuple) else ((one, other),)
            assert all(np.array_equal(*pair) for pair in pairs)
    (path,) = folder.glob("*.o")
    assert machine_code.read(path)  # that of "allocation" is refused by the linker each time


@pytest.mark.parametrize("name", CASES)
def test_numba_compiles_where_the_linkers_rules_are_not_known(
    name: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    function, arguments = CASES[name]
    given, expected = arguments(), arguments()
    assert direct(compiled(function), *given)(*given) == function(*expected)
    assert not list(folder.glob("*.o"))


def test_an_exception_is_raised_although_machine_code_cannot(folder: Path) -> None:
    function = direct(compiled(raising), np.zeros((1, 1)))
    assert function(np.zeros((1, 1))) == 1
    with pytest.raises(ValueError, match="positive"):
        function(np.ones((1, 1)))
    (path,) = folder.glob("*.o")
    assert machine_code.read(path) == b""


_yield = external("sched_yield", "int32()")


def waiting(flags: NDArray[np.int64], turns: int) -> int:
    """Waits until another thread sets the first flag; gives up after some turns."""
    for turn in range(turns):
        if flags[0]:
            return turn
        _yield()
    return -1


@pytest.mark.parametrize(("compile_it", "is_released"), [(compiled, False), (threaded, True)])
def test_machine_code_for_threads_releases_the_lock(
    compile_it: Callable[[Any], Any], is_released: bool, folder: Path
) -> None:
    flags = np.zeros(1, np.int64)
    function = direct(compile_it(waiting), flags, 1)
    (path,) = folder.glob("*.o")
    assert machine_code.read(path)
    with ThreadPoolExecutor(1) as pool:
        answer = pool.submit(function, flags, 10_000_000 if is_released else 1000)
        while not is_released and not answer.done():
            pass
        flags[0] = 1
        assert (answer.result() >= 0) == is_released


def refuse_to_compile(self: Any, *_: object) -> bytes:
    raise AssertionError(f"{self.source.__name__} is compiled")


def test_what_was_prepared_is_not_compiled_again(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table, left = np.zeros((3, 4)), list[int]()
    wanted = [Program(compiled(each), (table,)) for each in (rows_of, clear, allocating)]
    prepare(wanted, left.append)
    assert left == [3, 2, 1]
    assert sorted(path.name.partition("-")[0] for path in folder.iterdir()) == [
        "allocating",
        "clear",
        "rows_of",
    ]
    monkeypatch.setattr(jit.Compiled, "program", refuse_to_compile)
    prepare(wanted, left.append)
    assert left == [3, 2, 1]
    assert direct(compiled(rows_of), table)(table) == 43
    assert direct(compiled(allocating), table)(table) == 0.0  # by numba


def test_code_made_with_the_wheel_is_used_where_it_fits(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = np.zeros((3, 4))
    direct(compiled(rows_of), table)
    (path,) = folder.glob("*.o")
    (tmp_path / "wheel").mkdir()
    path.rename(tmp_path / "wheel" / path.name)
    monkeypatch.setattr(jit, "READY_MADE", tmp_path / "wheel")
    with monkeypatch.context() as context:
        context.setattr(jit.Compiled, "program", refuse_to_compile)
        assert direct(compiled(rows_of), table)(table) == 43
    assert not list(folder.iterdir())
    monkeypatch.setattr(jit, "_environment", lambda: "another level of the processor")
    assert direct(compiled(rows_of), table)(table) == 43
    assert [each.name != path.name for each in folder.glob("*.o")] == [True]


@pytest.mark.parametrize(
    "spoil",
    [
        lambda path: path.write_bytes(path.read_bytes()[:-1]),
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(hashlib.sha256(b"no code").digest() + b"no code"),
        lambda path: path.chmod(0o666),
    ],
    ids=["cut off", "empty", "no object file", "writable by others"],
)
def test_a_file_that_cannot_be_trusted_costs_only_time(
    spoil: Callable[[Path], Any], folder: Path
) -> None:
    table = np.zeros((3, 4))
    direct(compiled(rows_of), table)
    (path,) = folder.glob("*.o")
    spoil(path)
    assert direct(compiled(rows_of), table)(table) == 43
    assert machine_code.read(path)  # written again, except for the code with a right digest


def test_code_that_could_not_be_compiled_once_is_compiled_again_later(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = np.zeros((3, 4))
    with monkeypatch.context() as short_of_memory:
        short_of_memory.setattr(machine_code, "object_code", lambda _program: b"")
        assert direct(compiled(rows_of), table)(table) == 43
    assert not list(folder.glob("*.o"))
    assert direct(compiled(rows_of), table)(table) == 43
    (path,) = folder.glob("*.o")
    assert machine_code.read(path)


def test_a_file_that_others_can_write_is_not_loaded(folder: Path) -> None:
    machine_code.write(folder / "a.o", b"code")
    assert machine_code.read(folder / "a.o") == b"code"
    (folder / "a.o").chmod(0o620)
    assert machine_code.read(folder / "a.o") is None


@pytest.fixture
def no_folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[Path | str], str]]:
    """Moves the cache to where none may be; returns the reason that is told."""

    def move(place: Path | str) -> str:
        monkeypatch.setenv("NUMBA_CACHE_DIR", str(place))
        jit.cache_folder.cache_clear()
        with pytest.warns(UserWarning, match="machine code is not kept") as told:
            assert jit.cache_folder() is None
        return str(told[0].message)

    yield move
    monkeypatch.undo()
    jit.cache_folder.cache_clear()


def test_a_folder_that_cannot_be_written_costs_only_time(
    tmp_path: Path, no_folder: Callable[[Path | str], str]
) -> None:
    (tmp_path / "file").touch()
    assert "cannot be written: File exists" in no_folder(tmp_path / "file" / "cache")
    table = np.zeros((3, 4))
    assert direct(compiled(rows_of), table)(table) == 43
    assert direct(compiled(allocating), table)(table) == 0.0
    assert compiled(rows_of)(table) == 43
    assert list(tmp_path.iterdir()) == [tmp_path / "file"]
    # where numba turns when it cannot write
    assert not list((Path(__file__).parent / "__pycache__").glob("test_machine_code*.nb?"))


def test_code_that_numba_cannot_write_goes_nowhere_else(folder: Path) -> None:
    table = np.zeros((3, 4))
    assert compiled(allocating)(table) == 0.0
    (own,) = (path for path in folder.glob("allocating-*") if path.is_dir())
    shutil.rmtree(own)
    own.touch()  # a file where numba wants a folder
    assert compiled(allocating)(table) == 0.0
    assert not list((Path(__file__).parent / "__pycache__").glob("test_machine_code*.nb?"))


def test_a_compiler_that_the_user_disabled_is_told(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("numba.config.DISABLE_JIT", 1)
    with pytest.raises(HapticBridgeError, match=r"^NUMBA_DISABLE_JIT is set, and .*; unset it$"):
        compiled(rows_of)(np.zeros((3, 4)))
    monkeypatch.setattr("numba.config.DISABLE_JIT", 0)
    assert compiled(rows_of)(np.zeros((3, 4))) == 43
    assert list(folder.iterdir())


def test_a_setting_that_the_compiler_refuses_is_told(tmp_path: Path) -> None:
    """The package must be compiled anew, as after an update; numba then ends its own import."""
    none = {**os.environ, "NUMBA_NUM_THREADS": "0", "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-m", "hapticbridge", "run", "point_mass", "--fast"]
    ended = subprocess.run(command, env=none, capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    last = ended.stderr.splitlines()[-1]
    assert last.startswith("error: the compiler numba refuses a setting of the environment: ")
    assert "NUMBA_NUM_THREADS" in last


OPEN: dict[str, tuple[str, int]] = {
    "writable by all": ("cache/machine_code", 0o777),
    "writable by its group": ("cache/machine_code", 0o770),
    "readable, with files that numba may leave open": ("cache/machine_code", 0o755),
    "in a folder of all": ("cache", 0o777),
    "in a folder of a folder of all": (".", 0o777),
}


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX permissions")
@pytest.mark.parametrize("name", OPEN)
def test_no_code_is_taken_from_a_folder_that_others_can_write(
    name: str, tmp_path: Path, no_folder: Callable[[Path | str], str]
) -> None:
    (tmp_path / "cache" / "machine_code").mkdir(mode=0o700, parents=True)
    place, mode = OPEN[name]
    (tmp_path / place).chmod(mode)
    assert str(tmp_path / place) in no_folder(tmp_path / "cache")


@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() != 0, reason="needs root's chown")
@pytest.mark.parametrize("place", ["cache/machine_code", "cache", "."])
def test_no_code_is_taken_from_a_folder_of_another_user(
    place: str, tmp_path: Path, no_folder: Callable[[Path | str], str]
) -> None:
    (tmp_path / "cache" / "machine_code").mkdir(mode=0o700, parents=True)
    os.chown(tmp_path / place, 65534, 65534)
    assert str(tmp_path / place) in no_folder(tmp_path / "cache")


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX permissions")
def test_a_folder_below_one_like_tmp_is_safe_and_made_for_this_user_alone(tmp_path: Path) -> None:
    (tmp_path / "tmp").mkdir()
    (tmp_path / "tmp").chmod(0o1777)
    before = os.umask(0)
    try:
        assert machine_code.fault_of(tmp_path / "tmp" / "cache" / "machine_code") == ""
    finally:
        os.umask(before)
    found = (tmp_path / "tmp" / "cache" / "machine_code").stat()
    assert stat.S_IMODE(found.st_mode) == 0o700


SOURCES = {
    "limits": "RAMP = 0.25\nTABLE = (1.0, 2.0)\n",
    "flags": "import enum\nclass Flag(enum.IntEnum):\n    OPEN = 3\n",
    "inner": """
from hapticbridge.kernel.jit import compiled
import numpy as np
TURN = np.array([5.0, 6.0])
@compiled
def risen(time):
    return 2.0 * time + TURN[1]
""",
    "outer": """
from hapticbridge.kernel.jit import compiled
from limits import RAMP, TABLE
from flags import Flag
from inner import risen
@compiled
def share(time):
    return risen(time) / RAMP + TABLE[1] + (9.0 if Flag.OPEN == 3 else time)  # of the force
""",
}
"""Modules of which the last is called: constants and functions come from the others."""

CHANGES: dict[str, tuple[str, str, str]] = {
    "a constant of another file": ("limits", "0.25", "0.5"),
    "an item of a tuple": ("limits", "2.0", "3.0"),
    "a member of an enumeration": ("flags", "3", "4"),
    "a function that is called": ("inner", "2.0 *", "4.0 *"),
    "an array of a function that is called": ("inner", "6.0", "7.0"),
    "its own code": ("outer", "TABLE[1]", "TABLE[0]"),
}


def imported(sources: dict[str, str], folder: Path) -> Any:
    """Writes modules and imports them anew; returns the function ``share``."""
    folder.mkdir(exist_ok=True)
    for name, text in sources.items():
        (folder / f"{name}.py").write_text(text)
        sys.modules.pop(name, None)
    importlib.invalidate_caches()
    return importlib.import_module("outer").share


@pytest.fixture
def modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.syspath_prepend(str(tmp_path / "modules"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # two versions in a second look alike
    yield tmp_path / "modules"
    for name in SOURCES:
        sys.modules.pop(name, None)


@pytest.mark.parametrize("called", ["directly", "by numba"])
@pytest.mark.parametrize("name", CHANGES)
def test_a_changed_source_never_runs_its_old_code(
    name: str, called: str, folder: Path, modules: Path
) -> None:
    def result(function: Any) -> Any:
        return direct(function, 1.0)(1.0) if called == "directly" else function(1.0)

    file, old, new = CHANGES[name]
    changed = SOURCES | {file: SOURCES[file].replace(old, new)}
    before = imported(SOURCES, modules)
    # compiled after its file has changed: the old code is then the newest on disk
    (modules / f"{file}.py").write_text(changed[file])
    assert result(before) == expected(SOURCES)
    assert result(imported(changed, modules)) == expected(changed) != expected(SOURCES)
    assert any(folder.iterdir())


def expected(sources: dict[str, str]) -> float:
    """Computes ``share(1.0)`` in Python."""
    names: dict[str, Any] = {}
    for text in sources.values():
        lines = [line for line in text.splitlines() if "import compiled" not in line]
        plain = [line for line in lines if not line.startswith(("@compiled", "from "))]
        exec("\n".join(plain), names)
    return float(names["share"](1.0))


def test_a_comment_or_another_folder_compiles_nothing_anew(folder: Path, modules: Path) -> None:
    assert direct(imported(SOURCES, modules), 1.0)(1.0) == expected(SOURCES)
    kept = sorted(folder.glob("*.o"))
    commented = {name: f"# said\n{text}" for name, text in SOURCES.items()}
    assert direct(imported(commented, modules), 1.0)(1.0) == expected(SOURCES)
    assert sorted(folder.glob("*.o")) == kept != []


def test_types_of_one_size_have_code_of_their_own(folder: Path) -> None:
    turned = np.dtype([("second", "<i8"), ("first", "<f8")])
    function = compiled(is_above)
    for dtype in (PAIR, turned):
        record = np.zeros(1, dtype)
        record["second"], record["first"] = 5, 0.25
        assert not direct(function, record[0], 0.0)(record[0], 0.5)
        assert direct(function, record[0], 0.0)(record[0], 0.2)
    assert len(list(folder.glob("*.o"))) == 2


RUN = """
import itertools, sys
import hapticbridge as hb
from hapticbridge.run.commands import Couple, Reset, Switch
with hb.Bridge("point_mass", "simulated", clock=hb.SimulatedClock()) as bridge:
    bridge.session.commands.now = itertools.count(1.0).__next__
    bridge.run(0.02)
    for command in (Couple(500.0, 1.0), Switch(force=False), Switch(force=True), Reset()):
        bridge.command(command)
        bridge.run(0.5)
print("numba" in sys.modules)
"""


def on_second_run(program: str) -> str:
    """Returns what a program prints once its machine code is on disk."""
    for _ in range(2):
        process = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, check=True
        )
    return process.stdout


def test_a_run_with_commands_needs_no_numba_once_its_code_is_on_disk() -> None:
    assert on_second_run(RUN) == "False\n"


PUSHED = """
import sys
import mujoco
import numpy as np
import hapticbridge as hb
from hapticbridge.device.base import AXES
from hapticbridge.kernel import machine_code

class Arm:  # six free axes with motors, in Python alone
    info = hb.DeviceInfo(
        name="arm", axes=AXES, force_limit=9, damping=2, rotational_damping=0.002, delay=0,
        is_real=False)
    damping, mass = np.repeat((2.0, 0.002), 3), np.repeat((0.3, 1e-3), 3)
    is_pushed = False

    def start(self, period):
        self.period, self.place, self.speed = period, np.zeros(3), np.zeros(6)
        self.turn, self.wrench = np.eye(4)[0], np.zeros(6)
        return np.array([(self.place, self.turn, 0)], hb.SAMPLE_DTYPE)

    def read(self, sample):
        self.speed += self.period * (self.wrench - self.damping * self.speed) / self.mass
        self.place += self.period * self.speed[:3]
        mujoco.mju_quatIntegrate(self.turn, self.speed[3:], self.period)
        sample[0] = self.place, self.turn, 0
        return 0

    def write(self, wrench):
        self.wrench = np.array(wrench)
        self.is_pushed |= bool(self.wrench.any())

    def close(self):
        pass

def counted(code, name):
    late.extend([name] * arm.is_pushed)
    return load(code, name)

arm, late, load, machine_code.load = Arm(), [], machine_code.load, counted
with hb.Bridge("point_mass", arm, clock=hb.SimulatedClock(), probe=True) as bridge:
    print(bridge.run(0.1).probe)
print(arm.is_pushed, late, "numba" in sys.modules)
"""


def test_nothing_is_compiled_or_loaded_once_a_motor_is_on() -> None:
    """The probe's first pushes would last as long as that, in which the motor holds its force."""
    assert on_second_run(PUSHED) == "x, y, z, rx, ry, rz answered the right way\nTrue [] False\n"


DRAGGED = """
import sys
from types import SimpleNamespace
from hapticbridge.view.controls import device_pose
rest = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
axes = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
parameters = SimpleNamespace(axes=axes, handle_origin=rest, device_origin=rest, scale=1.0)
device_pose(parameters, (0.1, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))
print("numba" in sys.modules)
"""


def test_a_drag_on_the_page_needs_no_numba() -> None:
    """Its import would hold the first drag back."""
    process = subprocess.run(
        [sys.executable, "-c", DRAGGED], capture_output=True, text=True, check=True
    )
    assert process.stdout == "False\n"


END = """
import hapticbridge as hb
with hb.Bridge("point_mass", "simulated", clock=hb.SimulatedClock()) as bridge:
    bridge.run(0.02)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc overwrites what is released")
def test_functions_read_no_released_memory_when_the_process_ends() -> None:
    overwriting = {"PYTHONMALLOC": "malloc", "MALLOC_PERTURB_": "255"}
    process = subprocess.run([sys.executable, "-c", END], env=os.environ | overwriting, check=False)
    assert process.returncode == 0


def test_a_user_without_a_home_is_told_how_to_name_a_folder(
    monkeypatch: pytest.MonkeyPatch, no_folder: Callable[[Path | str], str]
) -> None:
    """As a user id of a container that the system's list lacks; an empty setting is none."""

    def unknown(number: int) -> None:
        raise KeyError(number)

    for name in ("HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("pwd.getpwuid", unknown)
    assert no_folder("").endswith("no home directory; set HOME or NUMBA_CACHE_DIR")
    assert "omega3" in profiles()

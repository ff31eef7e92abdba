"""Files: atomic replacement, folders proven writable, JSON without NaN, HDF5, extras."""

from __future__ import annotations

import errno
import importlib
import io
import json
import math
import os
import secrets
import shlex
import shutil
import sys
import tempfile
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from hapticbridge.errors import HapticBridgeError, StudyError

# Import of optional packages

CHECKOUT = Path(__file__).resolve().parents[1]
"""Folder of ``pyproject.toml`` if the package runs from a checkout."""


def install_command(extra: str) -> str:
    """Returns the command that installs an extra where this program runs.

    In a checkout it names the checkout, because no index may have the package. ``pip`` is called
    through this program's Python if the shell's own belongs to another one.
    """
    found = shutil.which("pip")
    is_ours = found is not None and Path(found).parent == Path(sys.executable).parent
    pip = "pip" if is_ours else f"{shlex.quote(sys.executable)} -m pip"
    if not (CHECKOUT / "pyproject.toml").is_file():
        return f"{pip} install 'hapticbridge[{extra}]'"
    target = "." if Path.cwd() == CHECKOUT else str(CHECKOUT)
    return f"{pip} install -e {shlex.quote(f'{target}[{extra}]')}"


def import_extra(
    module: str, purpose: str, extra: str, error: type[HapticBridgeError], package: str = ""
) -> Any:
    """Imports a module of an optional package.

    ``extra`` is the project's extra that installs it. ``purpose`` and ``package`` name the feature
    and the package in the message; ``package`` defaults to the module's first part.

    Raises:
        HapticBridgeError: ``error``, with the command that installs the package.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        package = package or module.partition(".")[0]
        raise error(
            f"{purpose} needs {package}, which is not installed: {install_command(extra)}"
        ) from None


def printable(text: str) -> str:
    """Replaces control characters, which would break a terminal, a title or an SVG."""
    return "".join(letter if letter.isprintable() else "�" for letter in text)


# JSON without NaN and infinity, and JSON from other programs


def finite_or_null(value: Any) -> Any:
    """Replaces every number that is not finite by None.

    Mappings, lists and tuples may be nested; tuples become lists.
    """
    if isinstance(value, Mapping):
        return {key: finite_or_null(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [finite_or_null(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def read_json(text: str | bytes) -> Any:
    """Parses JSON from a file, a device or a browser.

    Raises:
        ValueError: The text is not JSON, or is nested too deeply for the interpreter.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def reason_of(error: OSError, target: Path) -> str:
    """Returns the reason why a file or folder cannot be written, in words."""
    folder = target.absolute().parent
    if not os.path.lexists(folder):
        return f"the folder {target.parent} does not exist"
    if not os.path.isdir(folder):  # noqa: PTH112 - pathlib's raises without permission
        return f"{target.parent} is not a folder"
    if words := folder_words(error):
        return words
    if error.errno == errno.ENOENT:  # as in /proc
        return f"the folder {target.parent} takes no new file"
    return error.strerror or str(error)


@contextmanager
def writing(path: Path, error: type[HapticBridgeError]) -> Iterator[None]:
    """Raises ``error`` with the reason if the block cannot write a file or folder.

    Raises:
        HapticBridgeError: ``error``.
    """
    try:
        yield
    except OSError as found:
        raise error(f"cannot write '{path}': {reason_of(found, path)}") from None


def check_target(path: Path, error: type[HapticBridgeError]) -> None:
    """Checks that a file can be made or replaced, before anything is computed for it.

    An existing path that is no regular file, such as a pipe, is not tried.

    Raises:
        HapticBridgeError: ``error``, with the reason.
    """
    with writing(path, error):
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, "it is a folder")
        if path.is_file() or not path.exists():
            tempfile.TemporaryFile(dir=path.resolve().parent).close()


def check_regular(path: Path, error: type[HapticBridgeError]) -> None:
    """Checks that a path leads to a regular file, or to nothing yet; a pipe is not replaced.

    Raises:
        HapticBridgeError: ``error``.
    """
    if path.exists() and not path.is_file():
        raise error(f"cannot write '{path}': it exists and is not a file")


def refuse_existing(path: Path, error: type[HapticBridgeError], *, overwrite: bool) -> None:
    """Refuses to replace a file that was not to be replaced.

    Raises:
        HapticBridgeError: ``error``.
    """
    if path.exists() and not overwrite:
        raise error(f"'{path}' exists; choose another file or add --overwrite")


_LIMITS = {
    errno.EFBIG: "'ulimit -f' allows no larger file",
    errno.EMFILE: "'ulimit -n' allows no more open files; 256 suffice",
    errno.EAGAIN: "'ulimit -u' allows no further process or thread",
}
"""Words on limits of the system, by the error that tells of them."""


def limit_words(number: int | None) -> str:
    """Returns which limit of the system an error number tells of; empty for another error."""
    return _LIMITS.get(number or 0, "")


def folder_words(error: OSError) -> str:
    """Returns that a folder of the process is missing if this is the error; else empty.

    That of temporary files is looked for without a name; a relative name needs the current folder.
    """
    named = error.filename is not None
    if not isinstance(error, FileNotFoundError) or (named and Path(error.filename).is_absolute()):
        return ""
    try:
        Path.cwd()
    except FileNotFoundError:
        return "the current folder was removed; change to another one"
    if named:
        return ""
    return f"{error.strerror}; free space there, lift 'ulimit -f', or set TMPDIR to another folder"


def is_unicode(text: str) -> bool:
    """Returns False for a name or a word of a command line whose bytes are no UTF-8."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def name_fault(path: Path, reader: str) -> str:
    """Returns why a library cannot be given a name that is no Unicode text; empty if it is text."""
    if is_unicode(str(path)):
        return ""
    try:
        os.fsencode(path).decode()
    except UnicodeDecodeError:
        return f"{reader} needs a name in UTF-8"
    return encoding_words()


def encoding_words() -> str:
    """Returns what to say of a name that Python cannot read or write here."""
    encoding = sys.getfilesystemencoding()
    return f"Python reads names as {encoding} here; set PYTHONUTF8=1, or a locale with UTF-8"


def user_folder(find: Callable[..., str]) -> Path | None:
    """Returns this program's folder by a function of platformdirs; None without a home directory.

    A user without an entry in the system's list has one only if HOME is set.
    """
    with suppress(RuntimeError):  # of newer versions; an older one returns a relative '~'
        if (folder := Path(find("hapticbridge", appauthor=False))).is_absolute():
            return folder
    return None


NO_HOME = "this user has no home directory; set HOME"

# Files of other programs

_UNPACKED = "compressed as a whole file; what {} makes of it is read"
_ZSTD = b"\x28\xb5\x2f\xfd", _UNPACKED.format("'zstd -d'")
_FOREIGN = {
    ".db3": (
        b"SQLite format 3\0",
        "a bag of ROS 2 in SQLite; 'ros2 bag convert' writes it in MCAP, which is read",
    ),
    ".bag": (
        b"#ROSBAG V",
        "a bag of ROS 1; 'rosbags-convert --dst-storage mcap' makes it one of ROS 2 in MCAP, which "
        "is read",
    ),
    ".zstd": _ZSTD,
    ".zst": _ZSTD,
    ".gz": (b"\x1f\x8b", _UNPACKED.format("'gunzip'")),
}
"""First bytes of a kind of file, and its name with what makes it readable, by its ending."""


def foreign_kind(path: Path) -> str:
    """Returns the kind of a bag or packed file that is not read, and what makes it readable.

    The kind follows from the file's first bytes; one whose ending promises others is damaged. It is
    empty for any other file, and for one that cannot be read.
    """
    try:
        if not path.is_file():  # a pipe would wait for its writer
            return ""
        with path.open("rb") as file:
            start = file.read(16)
    except (OSError, ValueError):
        return ""
    kinds = (kind for begin, kind in _FOREIGN.values() if start.startswith(begin))
    is_wrong = path.suffix in _FOREIGN
    wrong = f"damaged, empty or misnamed: it does not begin as a file with the ending {path.suffix}"
    return next(kinds, wrong if is_wrong else "")


def draft_of(target: Path) -> Path:
    """Returns the place of a file or folder until it is whole.

    Its name is short and ASCII, so that it can be made wherever the target can.
    """
    return target.with_name(f".{zlib.crc32(os.fsencode(target.name)):08x}.draft")


def remove_file(path: Path) -> None:
    """Removes a regular file; does nothing if there is none, or it cannot be removed."""
    if path.is_file():
        with suppress(OSError):
            path.unlink()


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yields a temporary path; after the block the file replaces the target.

    If writing fails or is interrupted, an existing file is left unchanged and no partial file
    remains. A link is followed. An existing path that is not a regular file, such as a pipe or
    /dev/stdout, is written directly.

    Raises:
        OSError: The file cannot replace the target.
    """
    target = path.resolve()
    if path.exists() and not path.is_file():
        yield path
        return
    # a name that no other user of the folder can guess, and link elsewhere
    draft = target.with_name(f".draft-{secrets.token_hex(8)}{target.suffix}")
    try:
        yield draft
        draft.replace(target)
    finally:
        with suppress(OSError):
            draft.unlink(missing_ok=True)


def prepared_folder(folder: Path, names: Collection[str] = ()) -> Path:
    """Makes a folder, if there is none, and proves that it and its files can be written.

    Args:
        folder: Folder to write into.
        names: Files in it that will be written; existing ones stay unchanged. Without names, any
            new file must be possible.

    Raises:
        StudyError: The path is a file, or the folder or a file in it cannot be made or written.
    """
    path = folder
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not names:
            tempfile.TemporaryFile(dir=folder).close()
        for path in (folder / name for name in names):
            is_new = not path.exists()
            with path.open("ab"):
                pass
            if is_new:
                path.unlink()
    except FileExistsError:
        raise StudyError(f"'{folder}' is a file; name a folder to write into") from None
    except (OSError, ValueError) as error:
        reason = reason_of(error, path) if isinstance(error, OSError) else str(error)
        raise StudyError(f"cannot write '{path}': {reason}") from None
    return folder


# HDF5


class _EnduringFile(io.FileIO):
    """File that keeps its first failure to write, and writes nothing after it.

    HDF5 crashes the process if a write fails while it closes a file. Here every write seems to
    succeed.

    Attributes:
        failure: The first failure; None without one.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, "w+")
        self.failure: OSError | None = None

    def write(self, data: Any, /) -> int:
        """Writes all bytes, unless a write failed; returns their number in any case."""
        rest = memoryview(data).cast("B")
        size = len(rest)
        try:
            while self.failure is None and rest:
                rest = rest[super().write(rest) :]
        except OSError as error:
            self.failure = error
        return size

    def truncate(self, size: int | None = None, /) -> int:
        """Sets the file's size, unless a write failed; returns the size asked for."""
        try:
            return super().truncate(size) if self.failure is None else size or 0
        except OSError as error:
            self.failure = error
            return size or 0


class Hdf5File:
    """New HDF5 file that survives a full disk: ``check`` and ``close`` raise what failed.

    Args:
        path: The file.
        purpose: What needs h5py, in words.
        error: Raised if h5py is not installed.
        options: Options of ``h5py.File``.

    Attributes:
        root: The open file of h5py.

    Raises:
        OSError: The file cannot be made.
        HapticBridgeError: ``error``.
    """

    def __init__(
        self, path: Path, purpose: str, error: type[HapticBridgeError], **options: Any
    ) -> None:
        h5py = import_extra("h5py", purpose, "hdf5", error)
        self._file = _EnduringFile(path)
        self.root = h5py.File(self._file, "w", **options)

    def check(self) -> None:
        """Checks that everything could be written so far.

        Raises:
            OSError: Something could not be written.
        """
        if self._file.failure is not None:
            raise self._file.failure

    def close(self) -> None:
        """Finishes the file.

        Raises:
            OSError: Something could not be written.
        """
        self.root.close()
        self._file.close()
        self.check()

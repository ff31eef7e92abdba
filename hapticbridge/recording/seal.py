"""Seal of a recording: digest of the contents, hash chain over the file, optional signature.

The last metadata record of a whole file, ``hapticbridge.digest``, is its seal:

- ``sha256``: digest of the contents, independent of the container's layout (``Digest``).
- ``chain``: end of the hash chain over all records before the seal (``Chain``).
- ``index``: hash of all bytes behind the data section, which are the index and the file's end.
- ``key``: public key of the signer as OpenSSH writes it, ``ssh-ed25519 …``; only in a signed file.
- ``signature``: ed25519 signature of all other entries (``statement``), hexadecimal.

Without a key all of this can be computed anew after a change. With one, the key's holder alone can.
"""

from __future__ import annotations

import base64
import hashlib
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from hapticbridge.errors import RecordingError
from hapticbridge.files import import_extra, printable
from hapticbridge.recording.format import Attachment

DIGEST, CHAIN, INDEX, KEY, SIGNATURE = "sha256", "chain", "index", "key", "signature"
"""Entries of a seal."""

# Digest of the contents


class Digest:
    """SHA-256 of a recording's contents, independent of the container's layout.

    It is the SHA-256 of ``hapticbridge digest 1``, a newline, and four SHA-256 of 32 bytes each:

    1. metadata: for each key in sorted order, key and value;
    2. attachments: for each name in sorted order, name, media type and data;
    3. ticks: all records in order, packed, without CDR headers or separators;
    4. events: each JSON payload in order.

    Each further hand adds the SHA-256 of its records as in 3.

    In 1, 2 and 4 every piece (text as UTF-8) follows its length as 8 bytes, little-endian.
    Different contents therefore never give equal bytes.
    """

    def __init__(
        self, metadata: Mapping[str, str] | None = None, attachments: Iterable[Attachment] = ()
    ) -> None:
        self._ticks = [hashlib.sha256()]
        self._events = hashlib.sha256()
        self.describe(metadata or {}, attachments)

    def describe(self, metadata: Mapping[str, str], attachments: Iterable[Attachment]) -> None:
        """Sets metadata and attachments, which are known only at the end of a damaged file."""
        self._metadata = hashlib.sha256()
        for key in sorted(metadata):
            _add(self._metadata, key.encode())
            _add(self._metadata, metadata[key].encode())
        self._attachments = hashlib.sha256()
        for attachment in sorted(attachments, key=lambda attachment: attachment.name):
            _add(self._attachments, attachment.name.encode())
            _add(self._attachments, attachment.media_type.encode())
            _add(self._attachments, attachment.data)

    def add_ticks(self, rows: NDArray[np.void], hand: int = 0) -> None:
        """Adds records of a hand, shape (n,), ``TICK_DTYPE``."""
        while len(self._ticks) <= hand:
            self._ticks.append(hashlib.sha256())
        self._ticks[hand].update(np.ascontiguousarray(rows).view(np.uint8).data)

    def add_event(self, payload: bytes) -> None:
        """Adds one event's JSON."""
        _add(self._events, payload)

    def hexdigest(self) -> str:
        """Returns the digest of the contents so far, as 64 hexadecimal digits."""
        whole = hashlib.sha256(b"hapticbridge digest 1\n")
        first, *others = self._ticks
        for part in (self._metadata, self._attachments, first, self._events, *others):
            whole.update(part.digest())
        return whole.hexdigest()


def _add(digest: hashlib._Hash, piece: bytes) -> None:
    digest.update(len(piece).to_bytes(8, "little"))
    digest.update(piece)


# Hash chain over the file

HASH_SIZE = 32
"""Size of a hash in bytes: 256 bits of BLAKE2b."""


def new_hash(data: bytes = b"") -> hashlib.blake2b:
    """Returns the hash of a record or of a stretch of the file, to which more can be added."""
    return hashlib.blake2b(data, digest_size=HASH_SIZE)


class Chain:
    """Hash chain over the records of an MCAP file.

        c_0 = H(magic),   c_k = H(c_(k-1) ‖ H(r_k))

    r_k is the k-th record with opcode and length, H is BLAKE2b with 32 bytes. A record that is
    left out, added, exchanged or changed changes all later links.
    """

    def __init__(self) -> None:
        self._link = new_hash(MCAP0_MAGIC).digest()

    def add(self, record_hash: bytes) -> None:
        """Adds the hash of the next record."""
        self._link = new_hash(self._link + record_hash).digest()

    def add_records(self, data: bytes) -> None:
        """Adds whole records of a file that is being written; its magic is none."""
        start = 0
        while data != MCAP0_MAGIC and start < len(data):
            stop = start + 9 + int.from_bytes(data[start + 1 : start + 9], "little")
            self.add(new_hash(data[start:stop]).digest())
            start = stop

    def hexdigest(self) -> str:
        """Returns the last link, as 64 hexadecimal digits."""
        return self._link.hex()


_FAULTS = {
    DIGEST: "the file's content does not match its digest: it was changed",
    CHAIN: "the file's records do not match their hash chain: one was removed, added or written "
    "anew by another program",
    INDEX: "the index at the end of the file does not match its hash: it was changed",
}


def seal_fault(stored: Mapping[str, str], computed: Mapping[str, str]) -> str:
    """Returns the fault of a whole file's seal as a sentence; empty if it fits.

    A file of an earlier version has neither chain nor index.
    """
    if DIGEST not in stored:
        return "the file has no digest although it is not cut"
    wrong = (name for name in computed if stored.get(name, computed[name]) != computed[name])
    return next((_FAULTS[name] for name in wrong), "")


# Signature

_KIND = "ssh-ed25519"
_MAKE = "ssh-keygen -t ed25519 -N '' -f KEY"
_LONGEST_FILE = 1 << 20


def statement(seal: Mapping[str, str]) -> bytes:
    """Returns the signed bytes: a title and all entries but the signature, sorted by name.

    Each name and value follows its length as 8 bytes, little-endian.
    """
    signed = hashlib.sha256()
    for name in sorted(seal.keys() - {SIGNATURE}):
        _add(signed, name.encode())
        _add(signed, seal[name].encode())
    return b"hapticbridge signature 1\n" + signed.digest()


@dataclass(frozen=True, slots=True)
class Signer:
    """Private ed25519 key that signs recordings.

    Attributes:
        seed: The key's 32 bytes; no text of a signer shows them.
    """

    seed: bytes

    def __repr__(self) -> str:
        return "Signer(…)"

    @classmethod
    def load(cls, path: str | Path) -> Signer:
        """Reads a private key, as OpenSSH or in PEM (PKCS 8), without a passphrase.

        Raises:
            RecordingError: The file cannot be read, may be read by other users, or holds no such
                key, or the extra ``sign`` is not installed.
        """
        path = Path(path)
        serialization, ed25519 = _cryptography()
        data = _read(path)
        is_openssh = b"OPENSSH PRIVATE KEY" in data
        name = f"load_{'ssh' if is_openssh else 'pem'}_private_key"
        try:
            key = getattr(serialization, name)(data, password=None)
        except TypeError:
            raise RecordingError(
                f"the key '{path}' has a passphrase, which a run cannot ask for; make one without: "
                f"{_MAKE}"
            ) from None
        except Exception as error:
            raise _no_key(path, "private", error) from None
        if not isinstance(key, ed25519.Ed25519PrivateKey):
            raise _no_key(path, "private", TypeError("it is of another kind"))
        if os.name == "posix" and path.stat().st_mode & 0o077:
            raise RecordingError(f"other users can read the key '{path}': chmod 600 '{path}'")
        return cls(key.private_bytes_raw())

    def signed(self, seal: Mapping[str, str]) -> dict[str, str]:
        """Returns a seal with public key and signature.

        Raises:
            RecordingError: The extra ``sign`` is not installed.
        """
        serialization, ed25519 = _cryptography()
        key = ed25519.Ed25519PrivateKey.from_private_bytes(self.seed)
        complete = {**seal, KEY: _openssh(serialization, key.public_key())}
        return complete | {SIGNATURE: key.sign(statement(complete)).hex()}


def trusted_keys(path: str | Path) -> dict[str, str]:
    """Reads public ed25519 keys: lines of OpenSSH (``KEY.pub``), or one in PEM.

    Returns:
        The comment of each key, by the key as a seal holds it.

    Raises:
        RecordingError: The file cannot be read or holds no or another key, or the extra ``sign`` is
            not installed.
    """
    path = Path(path)
    serialization, ed25519 = _cryptography()
    data = _read(path)
    if b"PRIVATE KEY" in data:
        raise RecordingError(f"'{path}' is a private key; trust takes the public one, '{path}.pub'")
    is_pem = b"BEGIN PUBLIC KEY" in data
    lines = [data] if is_pem else [line for line in map(bytes.strip, data.splitlines()) if line]
    load = getattr(serialization, f"load_{'pem' if is_pem else 'ssh'}_public_key")
    keys = {}
    try:
        for line in lines:
            if line.startswith(b"#"):
                continue
            key = load(line)
            if not isinstance(key, ed25519.Ed25519PublicKey):
                raise TypeError("it is of another kind")  # noqa: TRY301 - one refusal for all
            comment = b"" if is_pem else b" ".join(line.split()[2:])
            keys[_openssh(serialization, key)] = printable(comment.decode(errors="replace"))
    except Exception as error:
        raise _no_key(path, "public", error) from None
    if not keys:
        raise _no_key(path, "public", ValueError("it is empty"))
    return keys


UNPROVEN = "who recorded the file, and that it is complete and unedited"
"""Facts that only a key proves; part of every report without one."""


@dataclass(frozen=True, slots=True)
class SignatureCheck:
    """Result of checking a signature.

    Attributes:
        sentence: The result as a sentence.
        is_trusted: True if a trusted key signed exactly this file, False if not, None if no trusted
            key was named.
    """

    sentence: str
    is_trusted: bool | None = None


def check_signature(
    seal: Mapping[str, str], fault: str, trusted: Mapping[str, str] | None
) -> SignatureCheck:
    """Checks the signature of a file.

    Args:
        seal: Entries of the seal; empty for a file without one.
        fault: Reason why the file cannot be what was signed, as a sentence; empty if it can.
        trusted: Comments by trusted public key; None checks nothing.

    Raises:
        RecordingError: The extra ``sign`` is not installed.
    """
    signer = seal.get(KEY, "")
    if trusted is None:
        if SIGNATURE not in seal:
            return SignatureCheck(f"not signed: only a key would prove {UNPROVEN}")
        return SignatureCheck(
            f"signed by {fingerprint(signer)}, not checked: only its public key (--trust KEY) "
            f"proves {UNPROVEN}"
        )
    if SIGNATURE not in seal:
        why = f" ({fault})" if fault else ""
        return SignatureCheck(f"the file is not signed{why}", is_trusted=False)
    name = f"{trusted.get(signer, '')} ({fingerprint(signer)})".strip()
    if signer not in trusted:
        return SignatureCheck(
            f"the file is signed by {fingerprint(signer)}, which is no trusted key",
            is_trusted=False,
        )
    serialization, _ = _cryptography()
    try:
        key = cast(Any, serialization.load_ssh_public_key(signer.encode()))
        key.verify(bytes.fromhex(seal[SIGNATURE]), statement(seal))
    except Exception:  # a wrong signature, or one that is none
        fault = "the signature belongs to another file or was changed"
    if fault:
        return SignatureCheck(f"not as {name} signed it: {fault}", is_trusted=False)
    return SignatureCheck(f"signed by {name}, unchanged since", is_trusted=True)


def fingerprint(key: str) -> str:
    """Returns the fingerprint of a public key, as ``ssh-keygen -l`` prints it."""
    try:
        kind, blob = key.split()[:2]
        data = base64.b64decode(blob, validate=True)
    except ValueError:
        return "a damaged key"
    if kind != _KIND:
        return "a key of another kind"
    return "SHA256:" + base64.b64encode(hashlib.sha256(data).digest()).decode().rstrip("=")


def _cryptography() -> tuple[Any, Any]:
    base = "cryptography.hazmat.primitives"
    return (
        import_extra(f"{base}.serialization", "a signature", "sign", RecordingError),
        import_extra(f"{base}.asymmetric.ed25519", "a signature", "sign", RecordingError),
    )


def _openssh(serialization: Any, key: Any) -> str:
    text: bytes = key.public_bytes(
        serialization.Encoding.OpenSSH, serialization.PublicFormat.OpenSSH
    )
    return text.decode()


def _read(path: Path) -> bytes:
    try:
        if not path.is_file():
            path.stat()  # raises if it is missing
            raise RecordingError(f"cannot read the key '{path}': it is not a regular file")
        with path.open("rb") as file:
            return file.read(_LONGEST_FILE)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RecordingError(f"cannot read the key '{path}': {reason}") from None


def _no_key(path: Path, kind: str, error: Exception) -> RecordingError:
    reason = str(error).partition(". ")[0].rstrip(".") or type(error).__name__
    return RecordingError(
        f"'{path}' holds no {kind} ed25519 key ({reason:.80}); make a pair: {_MAKE}"
    )

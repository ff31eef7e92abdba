"""Forgeries of a signed recording's file: chunks, index, seal, signature, with and without a key.

A careless forger writes checksums and index anew and keeps the seal. A careful one writes the seal
anew too, and can do all but sign. Without a key the careful one is seen only where the parts
contradict each other (``test_audit_forgeries``); with one, never called passive.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
from audit_cases import OldSignature, ScriptedDevice, key_pair, recorded, rewritten
from cli_cases import Called
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC
from test_audit_forgeries import OWN_WORD, SHORTER, no_trip, shortened

from hapticbridge.audit import audit
from hapticbridge.bridge import Bridge
from hapticbridge.device import SimulatedDevice
from hapticbridge.errors import HapticBridgeError, RecordingError, SafetyTrip
from hapticbridge.export import export
from hapticbridge.files import install_command
from hapticbridge.guard import Limits
from hapticbridge.recording import Recording, read_recording, repair
from hapticbridge.recording.seal import Signer, fingerprint, trusted_keys
from hapticbridge.run_description import SOURCE_PREFIX

# Honest files


@dataclass
class Bench:
    """Keys and signed recordings of a lab, and a stranger's key."""

    folder: Path
    key: Path
    stranger: Path

    @property
    def trust(self) -> Path:
        return self.key.with_suffix(".pub")

    @property
    def run(self) -> Path:
        return self.folder / "run.mcap"

    @property
    def trip(self) -> Path:
        return self.folder / "trip.mcap"


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    folder = tmp_path_factory.mktemp("signed")
    lab = Bench(folder, key_pair(folder), key_pair(folder, "stranger"))
    recorded(lab.run, "virtual_wall", duration=1.5, sign=lab.key)
    away = ScriptedDevice(lambda tick: (0.001 * max(tick - 50, 0), 0, 0, 1, 0, 0, 0))
    limits = Limits(force=10.0, torque=0.5, stretch=0.005)
    with pytest.raises(SafetyTrip):
        recorded(lab.trip, "point_mass", away, duration=0.3, limits=limits, sign=lab.key)
    return lab


# Records of a file, changed and written with new checksums and a new index


@dataclass
class Parts:
    """Records of a file in order, with chunks kept packed.

    Attributes:
        before: Header, metadata and attachments.
        chunks: Each chunk with its message indexes.
        seal: Entries of the seal.
        hides: Number of a chunk that the index leaves out; None for none.
        after: Records between the seal and the end of the data.
    """

    before: list[Any]
    chunks: list[list[Any]]
    seal: dict[str, str]
    hides: int | None = None
    after: list[Any] = field(default_factory=list)

    @classmethod
    def of(cls, path: Path) -> Parts:
        parts = cls([], [], {})
        with path.open("rb") as stream:
            for each in StreamReader(stream, emit_chunks=True).records:
                if isinstance(each, records.DataEnd):
                    break
                if isinstance(each, records.Metadata) and each.name == "hapticbridge.digest":
                    parts.seal = each.metadata
                elif isinstance(each, records.Chunk):
                    parts.chunks.append([each])
                elif isinstance(each, records.MessageIndex):
                    parts.chunks[-1].append(each)
                else:
                    parts.before.append(each)
        return parts

    def write(self, path: Path) -> Path:
        """Writes the file with checksums and index made anew."""
        out, index = BytesIO(), []
        out.write(MCAP0_MAGIC)

        def add(record: Any) -> tuple[int, int]:
            start, builder = out.tell(), RecordBuilder()
            record.write(builder)
            out.write(builder.end())  # type: ignore[no-untyped-call]
            return start, out.tell() - start

        for each in self.before:
            add(each)
        for number, (chunk, *messages) in enumerate(self.chunks):
            place = add(chunk)
            offsets = {each.channel_id: add(each)[0] for each in messages}
            span = chunk.message_start_time, chunk.message_end_time
            sizes = len(chunk.data), chunk.uncompressed_size
            length = out.tell() - sum(place)
            entry = (place[1], place[0], chunk.compression, *sizes)
            made = records.ChunkIndex(
                chunk_length=entry[0],
                chunk_start_offset=entry[1],
                compression=entry[2],
                compressed_size=entry[3],
                message_end_time=span[1],
                message_index_length=length,
                message_index_offsets=offsets,
                message_start_time=span[0],
                uncompressed_size=entry[4],
            )
            if number != self.hides:
                index.append(made)
        for each in (records.Metadata(name="hapticbridge.digest", metadata=self.seal), *self.after):
            add(each)
        add(records.DataEnd(data_section_crc=zlib.crc32(out.getvalue())))
        start = out.tell()
        for made in index:
            add(made)
        footer = records.Footer(
            summary_start=start if index else 0, summary_offset_start=0, summary_crc=0
        )
        builder = RecordBuilder()
        footer.write(builder)
        tail = builder.end()  # type: ignore[no-untyped-call]
        crc = zlib.crc32(out.getvalue()[start:] + tail[:-4])
        path.write_bytes(out.getvalue() + tail[:-4] + crc.to_bytes(4, "little") + MCAP0_MAGIC)
        return path

    def sealed(self, path: Path) -> Path:
        """Writes the file with a new seal, too; key and signature stay."""
        self.seal |= read_recording(self.write(path)).computed_seal
        return self.write(path)

    def sealed_but(self, name: str, path: Path) -> Path:
        """Writes the file with a new seal in which one hash is the old one."""
        old = self.seal[name]
        self.sealed(path)
        self.seal[name] = old
        return self.write(path)


Forge = Callable[[Bench, Path], Path]


def changed(change: Callable[[Parts], object], write: Callable[[Parts, Path], Path]) -> Forge:
    """Changes the records and writes them."""

    def forge(bench: Bench, path: Path) -> Path:
        parts = Parts.of(bench.run)
        change(parts)
        return write(parts, path)

    return forge


def but(name: str, change: Callable[[Parts], object]) -> Forge:
    """Changes the records and writes the seal anew, with one hash left as it was."""
    return changed(change, lambda parts, path: parts.sealed_but(name, path))


def kept(change: Callable[[Parts], object]) -> Forge:
    """Changes the records; the seal stays."""
    return changed(change, Parts.write)


def anew(change: Callable[[Parts], object]) -> Forge:
    """Changes the records and writes the seal anew, with the old signature."""
    return changed(change, Parts.sealed)


def content(change: Callable[[Recording], Mapping[str, Any]], source: str = "run") -> Forge:
    """Changes the contents and writes the file anew, with the old signature."""

    def forge(bench: Bench, path: Path) -> Path:
        recording = read_recording(getattr(bench, source))
        return rewritten(recording, path, signer=OldSignature(recording.seal), **change(recording))

    return forge


def resealed(**entries: str | None) -> Forge:
    """Changes entries of the seal alone; None removes one."""

    def change(parts: Parts) -> None:
        parts.seal = {**parts.seal, **entries}  # type: ignore[dict-item]
        parts.seal = {name: text for name, text in parts.seal.items() if text is not None}

    return kept_index(change)


def kept_index(change: Callable[[Parts], object]) -> Forge:
    """Changes the seal; all hashes of the file still fit it."""

    def forge(bench: Bench, path: Path) -> Path:
        parts = Parts.of(bench.run)
        change(parts)
        hashes = read_recording(parts.write(path)).computed_seal
        parts.seal |= {name: hashes[name] for name in hashes if name in parts.seal}
        return parts.write(path)

    return forge


def exchanged(parts: Parts) -> None:
    parts.chunks[1], parts.chunks[2] = parts.chunks[2], parts.chunks[1]


def hidden_chunk(parts: Parts) -> None:
    parts.hides = 1


def foreign(parts: Parts) -> None:
    parts.before.append(records.Metadata(name="foreign", metadata={"note": "kind"}))


def attachment(parts: Parts) -> None:
    note = records.Attachment(
        create_time=0, log_time=0, name="note", media_type="", data=b"proof of everything"
    )
    parts.before.append(note)


def behind(parts: Parts) -> None:
    parts.after.append(records.Metadata(name="foreign", metadata={"note": "kind"}))


def another_key(bench: Bench, path: Path) -> Path:
    signer = Signer.load(bench.stranger)
    return rewritten(read_recording(bench.run), path, signer=signer)


def another_files(bench: Bench, path: Path) -> Path:
    old = OldSignature(read_recording(bench.trip).seal)
    return rewritten(read_recording(bench.run), path, signer=old)


def claimed_key(bench: Bench, path: Path) -> Path:
    """Signs with another key and writes the trusted one beside it."""
    seal = Signer.load(bench.stranger).signed(read_recording(bench.run).seal)
    (trusted,) = trusted_keys(bench.trust)
    return rewritten(read_recording(bench.run), path, signer=OldSignature(seal | {"key": trusted}))


def cut(bench: Bench, path: Path) -> Path:
    """Cuts the end off, behind the seal."""
    path.write_bytes(bench.run.read_bytes()[:-60])
    return path


def cut_changed(bench: Bench, path: Path) -> Path:
    parts = Parts.of(bench.run)
    attachment(parts)
    data = parts.sealed(path).read_bytes()
    path.write_bytes(data[:-60])
    return path


def mended(bench: Bench, path: Path) -> Path:
    repair(cut(bench, path.with_name("cut.mcap")), path)
    return path


def mended_silently(bench: Bench, path: Path) -> Path:
    """Repairs a cut file and removes the event that says so."""
    found = read_recording(mended(bench, path.with_name("mended.mcap")))
    kept = [event for event in found.events if event["event"] != "repaired"]
    return rewritten(found, path, events=kept)


def commented(recording: Recording) -> dict[str, Any]:
    name = f"{SOURCE_PREFIX}virtual_wall.xml"
    return {"attachments": {name: recording.attachments[name] + b"<!-- kind -->"}}


# Table

UNNAMED = "no part of the file depends on what is added beside it"
ANYBODY = "without a key no signature is checked: any key may have made it"
BESIDE = "the index serves other programs; the audit reads every chunk"


@dataclass(frozen=True)
class Forgery:
    """A kind of forgery of a signed file.

    Attributes:
        forge: Writes it.
        plain: Verdict without a key.
        keyed: Verdict with the key.
        why: Reason why only a key shows it; empty where it is seen without one.
    """

    forge: Forge
    plain: str = "invalid"
    keyed: str = "invalid"
    why: str = ""


def only_a_key(forge: Forge, why: str) -> Forgery:
    return Forgery(forge, "passive", "unverified", why)


FORGERIES = {
    # the seal is kept
    "tail cut off, seal kept": Forgery(kept(lambda p: p.chunks.pop())),
    "chunk removed, seal kept": Forgery(kept(lambda p: p.chunks.pop(2))),
    "chunk doubled, seal kept": Forgery(kept(lambda p: p.chunks.insert(2, p.chunks[2]))),
    "chunks exchanged, seal kept": Forgery(kept(exchanged)),
    "chunk left out of the index, seal kept": Forgery(kept(hidden_chunk)),
    "metadata added, seal kept": Forgery(kept(foreign)),
    "attachment added, seal kept": Forgery(kept(attachment)),
    "metadata behind the seal, seal kept": Forgery(kept(behind)),
    # one hash is kept
    "metadata added, chain kept": Forgery(but("chain", foreign)),
    "attachment added, digest kept": Forgery(but("sha256", attachment)),
    "chunk left out of the index, its hash kept": Forgery(but("index", hidden_chunk)),
    # the seal is written anew, the signature kept
    "tail cut off": Forgery(anew(lambda p: p.chunks.pop())),
    "tail cut off and the stop moved": only_a_key(content(shortened), SHORTER),
    "chunk removed": Forgery(anew(lambda p: p.chunks.pop(2))),
    "chunk doubled": Forgery(anew(lambda p: p.chunks.insert(2, p.chunks[2]))),
    "chunks exchanged": Forgery(anew(exchanged)),
    "chunk left out of the index": only_a_key(anew(hidden_chunk), BESIDE),
    "metadata added": only_a_key(anew(foreign), UNNAMED),
    "attachment added": only_a_key(anew(attachment), UNNAMED),
    "trip removed": only_a_key(content(no_trip, "trip"), SHORTER),
    "metadata changed": only_a_key(content(lambda _: {"meta": {"started": "2001"}}), OWN_WORD),
    "attachment changed": only_a_key(content(commented), OWN_WORD),
    # the signature
    "signature of another file": only_a_key(another_files, ANYBODY),
    "signed with another key": only_a_key(another_key, ANYBODY),
    "trusted key beside another's signature": only_a_key(claimed_key, ANYBODY),
    "no signature": only_a_key(resealed(key=None, signature=None), ANYBODY),
    "key without a signature": only_a_key(resealed(signature=None), ANYBODY),
    "signature without a key": only_a_key(resealed(key=None), ANYBODY),
    "signature of zeros": only_a_key(resealed(signature="00" * 64), ANYBODY),
    "signature that is none": only_a_key(resealed(signature="hello"), ANYBODY),
    "key that is none": only_a_key(resealed(key="ssh-ed25519 hello"), ANYBODY),
    "entry added to the seal": only_a_key(resealed(note="kind"), UNNAMED),
    "no chain": only_a_key(resealed(chain=None), ANYBODY),
    # lost ends
    "cut behind the seal": only_a_key(cut, "the verdict is on what the file holds, and says so"),
    "changed and cut": only_a_key(cut_changed, "the verdict is on what the file holds"),
    "repaired": only_a_key(mended, "the verdict is on what the file holds, and says so"),
    "repaired, and not said": only_a_key(mended_silently, SHORTER),
}


@pytest.mark.parametrize("name", FORGERIES)
def test_a_forged_file_is_never_passive_under_a_key(
    name: str, bench: Bench, tmp_path: Path
) -> None:
    forgery = FORGERIES[name]
    path = forgery.forge(bench, tmp_path / "forged.mcap")
    keyed = audit(path, trust=bench.trust, accepts_unverified=True)
    assert (keyed.verdict, keyed.is_trusted, keyed.exit_code) == (forgery.keyed, False, 1)
    if forgery.keyed == "unverified":
        assert keyed.reason.startswith(keyed.signature)
    plain = audit(path)
    assert (plain.verdict, plain.is_trusted) == (forgery.plain, None), plain.reason
    assert (plain.exit_code == 0) == bool(forgery.why)


def test_a_signed_file_is_passive_under_its_key(bench: Bench, tmp_path: Path) -> None:
    for path in (bench.run, bench.trip):
        report = audit(path, trust=bench.trust)
        # a trip leaves the device uncertified, signed or not
        exit_code = int(path == bench.trip)
        assert (report.verdict, report.is_trusted) == ("passive", True)
        assert report.exit_code == exit_code
        assert "lab@bench" in report.signature
    # the files that the table changes are right as they are written
    same = Parts.of(bench.run).sealed(tmp_path / "same.mcap")
    assert audit(same).verdict == "passive"
    assert read_recording(same).seal_fault == ""
    assert len(Parts.of(bench.run).chunks) >= 5


def test_without_a_key_the_report_says_what_only_a_key_would_prove(
    bench: Bench, tmp_path: Path
) -> None:
    told = "who recorded the file, and that it is complete and unedited"
    signed = audit(bench.run)
    assert signed.signature.startswith(f"signed by SHA256:{''}")
    unsigned = audit(rewritten(read_recording(bench.run), tmp_path / "unsigned.mcap"))
    assert unsigned.signature.startswith("not signed: only a key would prove")
    for report in (signed, unsigned):
        assert told in report.signature
        assert json.loads(report.to_json())["signature"] == report.signature


def test_any_key_of_the_trusted_file_suffices(bench: Bench, tmp_path: Path) -> None:
    keys = tmp_path / "keys"
    both = [key.with_suffix(".pub").read_text() for key in (bench.stranger, bench.key)]
    keys.write_text("# our lab\n\n" + "\n".join(both))
    assert audit(bench.run, trust=keys).is_trusted is True
    keys.write_text(both[0])
    assert audit(bench.run, trust=keys).is_trusted is False


# Recordings that lost their end


@pytest.mark.usefixtures("undrawn")
def test_a_file_that_lost_its_end_says_so_through_repairs_and_exports(
    bench: Bench, tmp_path: Path, call: Called
) -> None:
    first, again, twice = (tmp_path / f"{name}.mcap" for name in ("first", "again", "twice"))
    repair(cut(bench, tmp_path / "cut.mcap"), first)
    data = first.read_bytes()
    again.write_bytes(data[: int(0.8 * len(data))])  # the event of the repair is lost, too
    assert "repaired" not in [event["event"] for event in read_recording(again).events]
    repair(again, twice)
    for path in (tmp_path / "cut.mcap", first, again, twice):
        report = audit(path)
        assert (report.verdict, report.is_cut) == ("passive", True), (path, report.reason)
        assert "its end" in report.cut
        values = json.loads(report.to_json())
        assert (values["is_cut"], values["cut"]) == (True, report.cut)
        assert audit(path, trust=bench.trust).exit_code == 1
        # a piece from the middle has no event of the repair in its span
        out = tmp_path / "piece.csv"
        export(path, "csv", out, span=(0.2, 0.4), overwrite=True)
        piece = json.loads(out.with_name("piece.csv.json").read_text())
        assert piece["meta"]["incomplete"] == report.cut
        assert ("repaired" in [event["event"] for event in piece["events"]]) == (
            path in (first, twice)
        )
        export(path, "csv", out, overwrite=True)
        whole = json.loads(out.with_name("piece.csv.json").read_text())
        assert whole["meta"]["incomplete"] == report.cut
    page = tmp_path / "page.html"
    code, printed, _ = call("audit", first, "--report", page)
    assert code == 0
    assert audit(first).cut in " ".join(printed.split())
    assert "had lost its end and was repaired" in page.read_text()
    assert "only a key would prove" in page.read_text()
    export(bench.run, "csv", tmp_path / "piece.csv", overwrite=True)
    assert "incomplete" not in (tmp_path / "piece.csv.json").read_text()


# Keys


def test_a_key_of_ssh_keygen_signs_and_has_its_fingerprint(tmp_path: Path) -> None:
    program = shutil.which("ssh-keygen")
    if program is None:
        pytest.skip("there is no ssh-keygen on this machine")
    key = tmp_path / "KEY"
    make = [program, "-q", "-t", "ed25519", "-N", "", "-C", "alice@lab", "-f", str(key)]
    subprocess.run(make, check=True)
    shown = subprocess.run([program, "-l", "-f", str(key)], check=True, capture_output=True)
    ((public, comment),) = trusted_keys(f"{key}.pub").items()
    assert comment == "alice@lab"
    assert fingerprint(public) in shown.stdout.decode()
    recorded(tmp_path / "run.mcap", "point_mass", duration=0.1, sign=key)
    assert audit(tmp_path / "run.mcap", trust=f"{key}.pub").is_trusted is True
    subprocess.run([*make[:-5], "secret", *make[-4:-1], str(tmp_path / "locked")], check=True)
    with pytest.raises(RecordingError, match="has a passphrase"):
        Signer.load(tmp_path / "locked")


def test_pem_keys_do_as_well(bench: Bench, tmp_path: Path) -> None:
    from cryptography.hazmat.primitives import serialization as s

    key = s.load_ssh_private_key(bench.key.read_bytes(), None)
    private, public = tmp_path / "key.pem", tmp_path / "public.pem"
    private.write_bytes(key.private_bytes(s.Encoding.PEM, s.PrivateFormat.PKCS8, s.NoEncryption()))
    private.chmod(0o600)
    public.write_bytes(
        key.public_key().public_bytes(s.Encoding.PEM, s.PublicFormat.SubjectPublicKeyInfo)
    )
    assert Signer.load(private) == Signer.load(bench.key)
    assert trusted_keys(public).keys() == trusted_keys(bench.trust).keys()
    assert Signer.load(private).seed.hex() not in repr(Signer.load(private))


def test_a_key_that_cannot_be_used_is_refused_in_a_sentence(
    bench: Bench, tmp_path: Path, call: Called, monkeypatch: pytest.MonkeyPatch
) -> None:
    def file(name: str, data: bytes, mode: int = 0o600) -> Path:
        path = tmp_path / name
        path.write_bytes(data)
        path.chmod(mode)
        return path

    text = bench.key.read_bytes()
    run = ("run", "point_mass", "--fast", "--duration", 0.05, "--record", tmp_path / "r.mcap")
    signs = [
        (tmp_path / "none", "No such file"),
        (tmp_path, "not a regular file"),
        (file("empty", b""), "holds no private ed25519 key"),
        (file("words", b"BEGIN OPENSSH PRIVATE KEY, or so"), "holds no private ed25519 key"),
        (bench.trust, "holds no private ed25519 key"),
    ]
    if os.name == "posix":
        signs.append((file("open", text, 0o644), "chmod 600"))
    for key, words in signs:
        code, _, err = call(*run, "--sign", key)
        assert (code, words in " ".join(err.split())) == (2, True), err
        assert not (tmp_path / "r.mcap").exists()
    trusts = [
        (tmp_path / "none", "No such file"),
        (bench.key, "is a private key"),
        (file("none.pub", b"# no key\n"), "holds no public ed25519 key"),
        (file("rsa.pub", b"ssh-rsa AAAA"), "holds no public ed25519 key"),
    ]
    for key, words in trusts:
        for files in ((bench.run,), (bench.run, bench.trip)):
            code, _, err = call("audit", *files, "--trust", key)
            assert (code, words in " ".join(err.split())) == (2, True), err
    code, _, err = call("run", "point_mass", "--fast", "--duration", 0.05, "--sign", bench.key)
    assert (code, "--sign goes with --record" in err) == (2, True)
    with pytest.raises(HapticBridgeError, match="sign needs a recording"):
        Bridge("point_mass", SimulatedDevice(), sign=bench.key)
    monkeypatch.setitem(__import__("sys").modules, "cryptography", None)
    for name in list(__import__("sys").modules):
        if name.startswith("cryptography."):
            monkeypatch.setitem(__import__("sys").modules, name, None)
    for command in (("audit", bench.run, "--trust", bench.trust), (*run, "--sign", bench.key)):
        code, _, err = call(*command)
        assert code == 2
        assert install_command("sign") in " ".join(err.split())
    assert call("audit", bench.run)[0] == 0  # without a key nothing is needed


def test_a_table_and_the_terminal_name_what_no_trusted_key_signed(
    bench: Bench, tmp_path: Path, call: Called
) -> None:
    bare = rewritten(read_recording(bench.run), tmp_path / "bare.mcap")
    code, out, _ = call("audit", bare, bench.run, "--trust", bench.trust)
    assert code == 1
    lines = out.splitlines()
    assert ["unverified" in line for line in lines if ".mcap" in line] == [True, False] or [
        "unverified" in line for line in lines if ".mcap" in line
    ] == [False, True]
    assert any("the file is not signed" in line for line in lines)
    code, out, _ = call("audit", bare, "--trust", bench.trust)
    assert (code, "the file is not signed; apart from that" in out) == (1, True)
    code, out, _ = call("audit", bench.run, "--trust", bench.trust)
    assert (code, "lab@bench" in out) == (0, True)
    code, _, err = call("audit", bare, "--trust", bench.trust, "--what-if", "damping=1")
    assert (code, "--trust" in err) == (2, True)

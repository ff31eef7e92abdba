"""What a user without a Falcon reads who asks for one."""

from __future__ import annotations

from pathlib import Path

import pytest
from cli_cases import Called

from hapticbridge.device.transport import usb as usb_search


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        (
            "falcon",
            "error: no device 'falcon' is plugged in (looked for 0403:cb48); 'hapticbridge "
            "devices' lists connected",
        ),
        ("falcon:damping=-1", "error: damping = -1.0: must be a finite number >= 0 N s/m"),
        ("falcon:firmware=/no/image,damping=2", "error: firmware = '/no/image': cannot be read"),
        (
            "falcon:colour=red",
            "unknown option 'colour' of the falcon device; choose one of 'damping'",
        ),
    ],
)
def test_a_falcon_that_cannot_be_had_is_one_sentence_and_exit_code_2(
    call: Called, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, spec: str, words: str
) -> None:
    monkeypatch.setattr(usb_search, "on_the_bus", list)
    monkeypatch.setattr(usb_search, "libusb", lambda: None)
    path = tmp_path / "run.mcap"
    code, out, err = call("run", "peg_in_hole", "--device", spec, "--record", str(path))
    assert code == 2
    assert out == ""
    assert words in " ".join(err.split())
    assert not path.exists()

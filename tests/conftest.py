"""What several test files are given."""

from __future__ import annotations

from pathlib import Path

import pytest
from audit_cases import (
    recorded,
    tapped,
)

from hapticbridge.recording import Recording, read_recording


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("audit")


@pytest.fixture(scope="module")
def tap(folder: Path) -> Recording:
    """A peg in contact, tilted and off centre."""
    return read_recording(tapped(folder))


@pytest.fixture(scope="module")
def held(folder: Path) -> Recording:
    """The same with a device in a hand, whose motion answers to the force."""
    path = folder / "held.mcap"
    motion = folder / "tap.csv"
    tapped(folder)
    recorded(path, device=f"simulated:path={motion}", duration=0.2)
    return read_recording(path)


@pytest.fixture
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SWEEP_SCRATCH", str(tmp_path))
    return tmp_path

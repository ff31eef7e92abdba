"""``hapticbridge repair``."""

from __future__ import annotations

from pathlib import Path

import pytest
from audit_cases import recorded
from cli_cases import Called


@pytest.fixture(scope="module")
def cut_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    whole = tmp_path_factory.mktemp("cut") / "long.mcap"
    recorded(whole, "virtual_wall", duration=1.5)
    cut = whole.with_name("a [b] cut.mcap")
    cut.write_bytes(whole.read_bytes()[: int(0.95 * whole.stat().st_size)])
    return cut


def test_cut_file_is_called_cut_and_repaired(call: Called, cut_file: Path, tmp_path: Path) -> None:
    cut, mended = cut_file, tmp_path / "mended.mcap"
    code, out, _ = call("audit", cut)
    assert code == 0
    assert "the file is cut" in out
    assert f"hapticbridge repair '{cut}' OUTPUT" in out
    assert call("repair", cut, mended)[0] == 0
    code, out, _ = call("audit", mended)
    assert code == 0
    assert "repaired (1)" in out
    code, _, err = call("repair", cut, mended)
    assert code == 2
    assert "mended.mcap" in err

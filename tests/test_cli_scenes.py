"""``hapticbridge scenes``."""

from __future__ import annotations

from pathlib import Path

from cli_cases import Called


def test_the_next_command_of_a_scene_runs(call: Called) -> None:
    _, out, _ = call("scenes", "planar_peg")
    command = out.splitlines()[-1].removeprefix("next: hapticbridge ")
    assert call(*command.split(), "--fast", "--duration", "0.1")[0] == 0


def test_a_scene_of_one_s_own_is_shown_whatever_its_grip_is_called(
    call: Called, tmp_path: Path
) -> None:
    """Nobody holds it here, so no grip is needed; what cannot be compiled is refused as ever."""
    path = tmp_path / "chisel.xml"
    text = "<mujoco><worldbody><body><freejoint/><geom size='.01'{}/>{}</body></worldbody></mujoco>"
    for site in ("<site name='hand'/>", ""):
        path.write_text(text.format("", site))
        code, out, err = call("scenes", path)
        assert (code, err) == (0, "")
        assert "1 moving body, 6 degrees of freedom" in out
    path.write_text(text.format(" mass='0'", ""))
    code, _, err = call("scenes", path)
    assert code == 2
    assert "error: cannot compile scene" in err

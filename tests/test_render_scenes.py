"""scripts/render_scenes: draws where a renderer is, and says in one sentence where none is."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from model_runs import MODELS, ROOT
from PIL import Image

from hapticbridge.scene import scene_names


def render(*arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(ROOT / "scripts/render_scenes"), *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        capture_output=True,
        text=True,
        check=False,
    )


def test_a_scene_is_drawn_or_the_missing_renderer_is_named(tmp_path: Path) -> None:
    done = render("virtual_wall", "--out", tmp_path, "--gallery", tmp_path / "all.png")
    if done.returncode:
        assert done.returncode == 2
        assert "works here, so nothing can be drawn off-screen; on Debian: apt" in done.stderr
        return
    assert done.stdout in {f"drawn with {name}: virtual_wall\n" for name in ("egl", "osmesa")}
    with Image.open(tmp_path / "virtual_wall.png") as picture:
        drawn = np.asarray(picture.convert("RGB")).astype(int)
    with Image.open(MODELS / "virtual_wall" / "virtual_wall.png") as picture:
        shipped = np.asarray(picture.convert("RGB")).astype(int)
    # drivers differ in edges and shadows, not in what is where
    assert drawn.shape == shipped.shape
    assert np.median(np.abs(drawn - shipped)) < 8
    for file in (tmp_path / "all.png", ROOT / "hapticbridge/guide/scenes.png"):
        assert file.stat().st_size < 300_000
        with Image.open(file) as picture:
            assert picture.width == 800


@pytest.mark.parametrize("name", scene_names())
def test_every_scene_has_a_small_picture_that_shows_something(name: str) -> None:
    file = MODELS / name / f"{name}.png"
    assert file.is_file(), f"draw it: scripts/render_scenes {name}"
    assert file.stat().st_size < 100_000
    with Image.open(file) as picture:
        assert picture.size <= (640, 400)
        assert np.asarray(picture.convert("L")).std() > 20

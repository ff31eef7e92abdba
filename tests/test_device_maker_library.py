"""Makers' libraries, which users install themselves: named, found, missing, or others."""

from __future__ import annotations

import ctypes.util
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType

import pytest
from emulated.dhd_stub import Stub
from emulated.hd_stub import HdStub

from hapticbridge.device import force_dimension, open_device
from hapticbridge.device.force_dimension import Dhd
from hapticbridge.device.touch import device as touch
from hapticbridge.device.touch.servo import Hd
from hapticbridge.device.transport.maker_library import LibraryFiles, MakerLibrary
from hapticbridge.errors import DeviceError


@dataclass(frozen=True)
class Maker:
    """A driver with a library, and what it says about it."""

    name: str
    driver: ModuleType
    stub: Callable[[], Stub | HdStub]
    library: Callable[[str], MakerLibrary]
    found: str
    missing: str
    first: str
    lacks: str

    @property
    def files(self) -> LibraryFiles:
        files: LibraryFiles = self.driver.FILES
        return files


MAKERS = (
    Maker(
        name="forcedimension",
        driver=force_dimension,
        stub=Stub,
        library=Dhd,
        found="Force Dimension's library was found",
        missing="install the SDK of forcedimension.com and name its file with library=FILE",
        first="dhdGetDeviceCount",
        lacks="has no dhdOpenID: it is not Force Dimension's library",
    ),
    Maker(
        name="touch",
        driver=touch,
        stub=HdStub,
        library=Hd,
        found="OpenHaptics' library was found",
        missing="install OpenHaptics and the Touch driver of 3D Systems and name its file with",
        first="hdInitDevice",
        lacks="has no hdDisableDevice: it is not OpenHaptics' library",
    ),
)
each_maker = pytest.mark.parametrize("maker", MAKERS, ids=lambda maker: maker.name)


@each_maker
def test_a_library_is_named_or_found(
    maker: Maker, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    file = maker.stub().file
    monkeypatch.setenv(maker.files.variable, file)
    assert maker.driver.medium() == f"{maker.found}: {file}"
    monkeypatch.delenv(maker.files.variable)
    monkeypatch.setattr(ctypes.util, "find_library", lambda stem: file)
    assert file in maker.driver.medium()
    monkeypatch.setattr(ctypes.util, "find_library", lambda stem: None)
    monkeypatch.setattr(maker.driver, "FILES", replace(maker.files, names={}))
    assert maker.missing in maker.driver.medium()
    with pytest.raises(DeviceError, match="name its file with library=FILE"):
        open_device(maker.name)
    broken = tmp_path / "broken.so"
    broken.write_bytes(b"no library")
    monkeypatch.chdir(tmp_path)
    # the loader looks for a name without a folder elsewhere, and finds no such file there
    for name in (str(broken), "./broken.so", "broken.so"):
        with pytest.raises(DeviceError, match=f"'{broken}' cannot be loaded"):
            open_device(f"{maker.name}:library={name}")
    with pytest.raises(DeviceError, match=r"'none\.so' cannot be loaded"):
        open_device(f"{maker.name}:library=none.so")


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not name what is missing")
@each_maker
def test_a_library_without_one_that_it_needs_is_found_and_names_it(
    maker: Maker, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler (cc)")
    source, needed, target = (tmp_path / name for name in ("a.c", "libgone.so", "libmaker.so"))
    source.write_text("int needed(void) { return 1; }")
    for out, more in ((needed, ()), (target, ("-Wl,--no-as-needed", needed))):
        subprocess.run([compiler, "-shared", "-fPIC", source, *more, "-o", out], check=True)
    needed.unlink()
    monkeypatch.delenv(maker.files.variable, raising=False)
    monkeypatch.setattr(ctypes.util, "find_library", lambda stem: None)
    names = {"linux": (str(tmp_path / "absent.so"), str(target))}
    monkeypatch.setattr(maker.driver, "FILES", replace(maker.files, names=names))
    with pytest.raises(DeviceError, match=r"libmaker\.so' cannot be loaded: .*libgone\.so"):
        open_device(maker.name)


@each_maker
def test_another_library_is_told_from_it(maker: Maker, tmp_path: Path) -> None:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler (cc)")
    source, target = tmp_path / "a.c", tmp_path / "other.so"
    source.write_text(f"int {maker.first}(void) {{ return 1; }}")
    subprocess.run([compiler, "-shared", "-fPIC", source, "-o", target], check=True)
    with pytest.raises(DeviceError, match=maker.lacks):
        maker.library(str(target))

"""Profiles of devices: what is known, from where, and what a run makes of it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hapticbridge.device import SimulatedDevice
from hapticbridge.device import profile as shelf
from hapticbridge.device.force_dimension import MODELS
from hapticbridge.device.profile import Profile, Quantity, read_profile
from hapticbridge.errors import DeviceError

UNKNOWN = dataclasses.replace(
    SimulatedDevice().info, mass=None, damping=None, friction=None, force_limit=8.0
)


@pytest.fixture(autouse=True)
def _own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))


def own(tmp_path: Path) -> Path:
    folder = tmp_path / "config" / "hapticbridge" / "devices"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


@pytest.mark.parametrize("path", sorted(shelf.SHIPPED.glob("*.toml")), ids=lambda path: path.stem)
def test_shipped_profiles_state_every_number_that_matters_with_its_source(path: Path) -> None:
    profile = read_profile(path)
    mechanics = {"workspace", "force_limit", "mass", "damping", "friction", "resolution", "rate"}
    assert set(profile.quantities) >= mechanics
    assert profile.axes
    for name, quantity in profile.quantities.items():
        assert quantity.source
        if quantity.value is None:
            assert "no figure" in quantity.source or "without a" in quantity.source, name
        is_measured = "'hapticbridge identify' measures it" in quantity.source
        assert not is_measured or name in {*shelf.LOWER_END, "resolution"}


@pytest.mark.parametrize(
    ("driver", "model", "stem"),
    [
        ("forcedimension", "omega.3", "omega3"),
        ("forcedimension", "omega.7 left", "omega3"),
        ("forcedimension", "delta.3", "delta3"),
        ("forcedimension", "sigma.7", "sigma7"),
        ("forcedimension", "lambda.7 left", "lambda7"),
        ("haply", "inverse3", "inverse3"),
        ("haply", "Minverse", "minverse"),
    ],
)
def test_shipped_profile_is_found_by_the_reported_model(driver: str, model: str, stem: str) -> None:
    found = shelf.profile_of(driver, "S 1", model)
    assert found is not None and found.path == shelf.SHIPPED / f"{stem}.toml"
    other = {"haply": "forcedimension", "forcedimension": "haply"}[driver]
    assert shelf.profile_of(other, "S 1", model) is None


def test_every_model_that_a_profile_names_is_one_that_the_driver_reports() -> None:
    assert set(shelf.modelled("forcedimension")) <= {model.name for model in MODELS.values()}
    assert set(shelf.modelled("haply")) == {"inverse3", "minverse"}
    assert shelf.modelled("falcon") == ()


def holding(**quantities: Quantity) -> Profile:
    return Profile("mine", "falcon", "", None, "", quantities)


def test_what_was_measured_of_one_model_is_not_taken_for_another(tmp_path: Path) -> None:
    damping = holding(damping=Quantity(9.0, "measured", (8.0, 10.0)))
    measured = dataclasses.replace(damping, device="forcedimension", models=("omega.3",))
    (own(tmp_path) / "forcedimension.toml").write_text(measured.to_toml(), encoding="utf-8")
    stems = {"omega.3": "forcedimension", "sigma.7": "sigma7", "lambda.3": ""}
    for model, stem in stems.items():
        found = shelf.profile_of("forcedimension", "", model)
        assert Path((found and found.path) or "").stem == stem


def test_a_broken_file_for_another_device_is_not_read(tmp_path: Path) -> None:
    (own(tmp_path) / "pid-7.toml").write_text("format = ", encoding="utf-8")
    assert shelf.profile_of("haply", "049D", "inverse3") is not None
    with pytest.raises(DeviceError, match="is not TOML"):
        shelf.profile_of("pid", "7")


def test_nobody_publishes_the_damping() -> None:
    known = [shelf.profile_named(name).quantities.get("damping") for name in shelf.profiles()]
    assert all(quantity is None or quantity.value is None for quantity in known)


numbers = st.floats(0.0, 1e9)


@given(
    value=st.none() | numbers,
    spread=st.floats(0.0, 1e6),
    source=st.text(min_size=1),
    name=st.text(min_size=1).filter(lambda text: "\r" not in text),
    quantity=st.sampled_from([unit for unit in shelf.UNITS if unit != "workspace"]),
)
def test_a_written_profile_reads_back_as_itself(
    tmp_path_factory: pytest.TempPathFactory, value: float | None, spread: float, **texts: str
) -> None:
    source, name, quantity = (texts[key] for key in ("source", "name", "quantity"))
    positive = value is None or value > 0.0
    interval = None if value is None or not positive else (value - spread, value + spread)
    known = {quantity: Quantity(value, source, interval)}
    profile = Profile(name, "falcon", "A 1", ("x", "z"), "", known)
    path = tmp_path_factory.mktemp("profile") / "p.toml"
    path.write_text(profile.to_toml(), encoding="utf-8")
    assert dataclasses.replace(read_profile(path), path=None) == profile


def test_a_profile_fills_in_what_the_driver_does_not_know_from_the_safe_end() -> None:
    profile = holding(
        damping=Quantity(2.0, "measured", (1.8, 2.2)),
        mass=Quantity(0.4, "measured", (0.39, 0.41)),
        friction=Quantity(0.1, "measured", (-0.01, 0.2)),
        resolution=Quantity(1e-3, "maker"),
        force_limit=Quantity(20.0, "maker"),
    )
    filled = profile.fill(UNKNOWN)
    assert (filled.damping, filled.mass, filled.friction) == (1.8, 0.39, 0.0)
    assert filled.resolution == UNKNOWN.resolution  # the driver knew
    assert filled.force_limit == 8.0  # the lower limit holds
    assert holding(force_limit=Quantity(3.0, "maker")).fill(UNKNOWN).force_limit == 3.0


def test_a_unit_goes_before_its_kind_and_ones_own_before_what_is_shipped(tmp_path: Path) -> None:
    shipped = shelf.profile_of("falcon")
    assert shipped is not None and shipped.path == shelf.SHIPPED / "falcon.toml"
    mine = dataclasses.replace(shipped, name="mine")
    (own(tmp_path) / "falcon.toml").write_text(mine.to_toml(), encoding="utf-8")
    unit = dataclasses.replace(shipped, name="unit", serial="7")
    (own(tmp_path) / "falcon-7.toml").write_text(unit.to_toml(), encoding="utf-8")
    for serial, name in (("", "mine"), ("8", "mine"), ("7", "unit")):
        found = shelf.profile_of("falcon", serial)
        assert found is not None and found.name == name
    assert shelf.profile_of("rawhid") is None
    assert shelf.profile_named("omega3").device == "forcedimension"


HEAD = 'format = 1\nname = "n"\ndevice = "falcon"\n'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("format = ", "is not TOML"),
        ("", "format must be 1"),
        ('format = 1\ndevice = "falcon"\n', "name is ''"),
        (HEAD + "colour = 3\n", "unknown tables 'colour'; valid tables: 'damping'"),
        (HEAD + 'axes = ["z", "x"]\n', "axes is ['z', 'x']"),
        (HEAD + 'models = "omega.3"\n', "models is 'omega.3'; it must be a list of texts"),
        (HEAD + 'models = [""]\n', "models is ['']; it must be"),
        (HEAD + "damping = 2\n", "[damping] must hold value and source"),
        (HEAD + "[damping]\nvalue = 2\n", "[damping] needs a source"),
        (
            HEAD + '[damping]\nvalue = -2.0\nsource = "s"\n',
            "[damping] value is -2.0 N s/m; it must be",
        ),
        (HEAD + '[damping]\nvalue = nan\nsource = "s"\n', "[damping] value is nan"),
        (HEAD + '[damping]\nvalue = "lots"\nsource = "s"\n', "[damping] value is 'lots'"),
        (HEAD + '[damping]\nvalue = 2.0\nunit = "N"\nsource = "s"\n', "must be 'N s/m'"),
        (HEAD + '[mass]\nvalue = 2.0\ninterval = [3.0, 4.0]\nsource = "s"\n', "must contain the"),
        (HEAD + '[mass]\nvalue = "unknown"\ninterval = [3.0, 4.0]\nsource = "s"\n', "two numbers"),
        (HEAD + '[workspace]\nvalue = [0.1, 0.1]\nsource = "s"\n', "three lengths"),
    ],
)
def test_bad_profile_is_refused_with_file_and_place(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(DeviceError) as error:
        read_profile(path)
    assert str(path) in str(error.value) and words in str(error.value)
    with pytest.raises(DeviceError, match="unknown profile 'falcn'; choose one of 'delta3'"):
        shelf.profile_named("falcn")
    with pytest.raises(DeviceError, match=r"cannot read profile '.*no\.toml'"):
        shelf.profile_named(str(tmp_path / "no.toml"))

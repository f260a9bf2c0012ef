"""Settings of identification: every arm in conf that has some composes, and wrong ones are refused by key."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from apcc_torch.composition.identify import IdentifySettings, known_arm, parameters, recorded
from apcc_torch.conf_path import conf_path
from apcc_torch.errors import ConfigError, DataError
from apcc_torch.identification.series import Series
from apcc_torch.reading import defaults
from apcc_torch.recordings.data_set import DataSettings, SessionSettings
from composed import composed_identify

NAMES = sorted(path.stem for path in (Path(conf_path()) / "identification").glob("*.yaml"))


def recorded_with(settings: IdentifySettings, m: int, k: int, monkeypatch: pytest.MonkeyPatch) -> Series:
    zeros = torch.zeros(5, dtype=torch.float64)
    series = Series(zeros, zeros.expand(m, 5).mT, zeros.expand(k, 3, 5).movedim(-1, 0), zeros.to(torch.int64))
    monkeypatch.setattr("apcc_torch.composition.identify.load_session", lambda *_: None)
    monkeypatch.setattr("apcc_torch.composition.identify.series_of", lambda _: series)
    data = DataSettings(folder="/", sessions={"made": SessionSettings(file="x.csv")})
    blocks = settings.split.changed(by="blocks")
    return recorded(settings.changed(data=data, split=blocks))[0]


@pytest.mark.parametrize("name", NAMES)
def test_every_arm_has_parameters(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = composed_identify(f"arm={name}")
    assert settings.arm.name == name
    driving = settings.arm.actuation.driving(settings.arm.n_tendons)
    recorded_with(settings, max(driving) + 1, len(settings.arm.sensor_places()), monkeypatch)
    assert len(parameters(settings)) > 40
    assert len(parameters(settings).holding(settings.fit.geometric)) > 20


def test_an_arm_is_started_with_the_settings_of_another() -> None:
    settings = composed_identify("arm=trunk", "identification=ftdcr_v6")
    assert (settings.arm.name, settings.recording.time, settings.spread.gravity) == ("trunk", "timestamp", 5.0)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["spread.offset=[1,2]"], r"spread\.offset must have 9 entries, got 2"),
        (["spread.offset=much"], r"spread\.offset must be a number, a list of numbers or .*, got 'much'"),
        (["arm.tendons.ends=[1,1,1,2,2,2,3,3,4]"], r"^arm\.tendons\.ends must be sections from 1 to 3"),
        (["arm.actuation.inputs=[0,1,2,3,4,5,6,7,9]"], "names input 9, the recording has 9"),
        (["arm.sensors=[0.1,0.2]", "arm.mounts=null"], r"arm\.sensors must name 1 places, .* got 2"),
        (["split.fold=7"], r"split\.fold must be from 0 to folds - 1"),
        (["fit.geometric=[colour]"], r"fit\.geometric must be one of rest_length, "),
        (["arm.actuation.friction=0"], r"arm\.actuation\.friction must be positive .*; spread\.friction=0 holds it"),
        (["+spread.colour=1"], r"spread\.colour is no setting"),
        (["arm=trunk", "++arm.lengths=???"], r"^arm\.lengths must be given"),
    ],
)
def test_settings_that_do_not_fit_are_refused(
    overrides: list[str], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def begin() -> None:
        settings = composed_identify("arm=ftdcr_v6", *overrides)
        recorded_with(settings, 9, 1, monkeypatch)
        parameters(settings)

    with pytest.raises(ConfigError, match=words):
        begin()


def test_something_must_be_fitted() -> None:
    settings = composed_identify("arm=ftdcr_v6")
    nothing = settings.spread.changed(**dict.fromkeys(defaults(type(settings.spread)), 0.0))
    with pytest.raises(ConfigError, match="nothing to fit"):
        parameters(settings.changed(spread=nothing))


def test_data_and_its_layout_must_be_given() -> None:
    with pytest.raises(ConfigError, match="data must name"):
        recorded(composed_identify("arm=ftdcr_v6"))
    with pytest.raises(ConfigError, match=r"recording\.layout must be"):
        composed_identify("arm=ftdcr_v6", "data=x.csv", "recording.layout=odd")
    with pytest.raises(DataError, match=r"x\.csv cannot be read"):
        recorded(composed_identify("arm=ftdcr_v6", "data=x.csv"))


def test_the_arm_is_told_by_the_recording(tmp_path: Path) -> None:
    table = tmp_path / "a.csv"
    table.write_text("timestamp,servo_1_mm,tip_x\n")
    assert known_arm(str(table)) == "ftdcr_v6"
    (tmp_path / "observations_x.csv").write_text("ID\n")
    assert known_arm(str(tmp_path)) == "trunk"
    table.write_text("a,b\n")
    assert known_arm(str(table)) is None
    with pytest.raises(DataError, match="no such file"):
        known_arm(str(tmp_path / "none.csv"))

"""Plain values to settings and back: what is refused, and by which sentence, and every class there and back."""

from __future__ import annotations

import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import pytest
import torch

from apcc_torch.classes import ALLOWED, Trust, class_named, name_of
from apcc_torch.control.adaptation import AdaptiveLaw, NormalisedLaw
from apcc_torch.control.control_settings import ControlSettings
from apcc_torch.control.length_law import LengthLaw
from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.model.affine import AffineBackbone
from apcc_torch.model.arm import Arm
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.reading import MUST, defaults, deviations, plain, read
from apcc_torch.settings import Setting, Settings, about_of, default_of, keys, setting
from apcc_torch.spread import Numbers
from every_class import needed, settings_classes

LAW = "apcc_torch.control.adaptation.AdaptiveLaw"


@dataclass(frozen=True, kw_only=True)
class Inner(Settings):
    """Settings within others."""

    size: float = setting(1.0, "m", meaning="of it", above=0)
    count: int = setting(2, meaning="of them", least=1)


@dataclass(frozen=True, kw_only=True)
class Outer(Settings):
    """Settings of every form."""

    name: str = setting(meaning="of it")
    inner: Inner = setting(factory=Inner, meaning="always there")
    other: Inner | None = setting(None, meaning="there once it has a key")
    many: dict[str, Inner] = setting(factory=dict, meaning="by name")
    law: Settings | None = setting(None, meaning="a part", base=LengthLaw)
    shipped: Settings | None = setting(factory=NormalisedLaw.settings_type, meaning="a part", base=LengthLaw)
    on: bool = setting(False, meaning="a switch")
    gain: Setting = setting(1.0, meaning="a number", rows="number", above=0)
    weights: Numbers | None = setting(None, meaning="one a section", rows="sections", least=0)
    ids: tuple[int, ...] = setting((), meaning="whole numbers")
    places: tuple[float, ...] = setting((), meaning="numbers")
    words: tuple[str, ...] = setting((), meaning="texts")
    mode: str = setting("plain", meaning="plain or squared", choices=("plain", "squared"))
    secret: float = setting(3.0, meaning="code alone sets it", key=False)


def outer(**values: Any) -> Outer:
    return read({"name": "it", **values}, Outer)


def test_what_is_left_out_has_its_default_and_numbers_become_what_they_stand_for() -> None:
    assert outer() == Outer(name="it")
    read_in = outer(
        inner={"size": 2}, other={"count": 5}, many={"a": {}, "b": {"size": 3}}, gain=2, on=True, weights=[1, 2.5],
        ids=[1, 2], places=[1, 2.5], words=["a"],
    )  # fmt: skip
    assert read_in.inner == Inner(size=2.0) and isinstance(read_in.inner.size, float)
    assert read_in.other == Inner(count=5) and read_in.many == {"a": Inner(), "b": Inner(size=3.0)}
    assert isinstance(read_in.gain, float) and read_in.ids == (1, 2) and read_in.places == (1.0, 2.5)
    assert all(isinstance(place, float) for place in read_in.places) and read_in.words == ("a",)
    assert read_in.weights == (1, 2.5) and read_in.on is True


def test_a_part_that_may_be_left_out_is_there_once_it_has_a_key() -> None:
    assert outer(other=None).other is None and outer(other={}).other is None
    assert outer(other={"size": 1.0}).other == Inner()
    started = read({"other": {"count": 3}}, Outer, start=Outer(name="it", other=Inner(size=7.0)))
    assert started.other == Inner(size=7.0, count=3)


@pytest.mark.parametrize(
    ("values", "error", "message"),
    [
        ({"gian": 1.0}, ConfigError, r"^gian is no setting; did you mean gain\?$"),
        ({"qqqq": 1.0}, ConfigError, r"^qqqq is no setting; it has name, inner, other, .*, mode$"),
        ({"secret": 1.0}, ConfigError, "^secret is no setting"),
        ({"inner": {"sice": 1.0}}, ConfigError, r"^inner\.sice is no setting; did you mean size\?$"),
        ({"many": {"a": {"sice": 1.0}}}, ConfigError, r"^many\.a\.sice is no setting"),
        ({"name": MUST}, ConfigError, "^name must be given$"),
        ({"name": 3}, ConfigError, "^name must be a text, got 3$"),
        ({"inner": 3}, ConfigError, "^inner must hold keys and values, got 3$"),
        ({"inner": None}, ConfigError, "^inner must hold keys and values, got None$"),
        ({"inner": {"size": "long"}}, ConfigError, r"^inner\.size must be a number, got 'long'$"),
        ({"inner": {"count": 2.5}}, ConfigError, r"^inner\.count must be a whole number, got 2\.5$"),
        ({"inner": {"count": True}}, ConfigError, r"^inner\.count must be a whole number, got True$"),
        ({"inner": {"size": -1.0}}, ValueRangeError, r"^inner\.size must be positive and finite, got -1\.0$"),
        ({"inner": {"size": None}}, ConfigError, r"^inner\.size must be a number, got None$"),
        ({"on": "yes"}, ConfigError, "^on must be true or false, got 'yes'$"),
        ({"on": 1}, ConfigError, "^on must be true or false, got 1$"),
        ({"gain": "much"}, ConfigError, "^gain must be a number, got 'much'$"),
        ({"gain": False}, ConfigError, "^gain must be a number, got False$"),
        ({"weights": "all"}, ConfigError, "^weights must be a number, a list of numbers or"),
        ({"weights": [1.0, -1.0]}, ValueRangeError, "^weights must be zero or positive and finite, got -1.0$"),
        ({"ids": 3}, ConfigError, "^ids must be a list, got 3$"),
        ({"ids": "12"}, ConfigError, "^ids must be a list, got '12'$"),
        ({"ids": [1, 2.5]}, ConfigError, "^ids must be a list of whole numbers, got"),
        ({"places": [1, "2"]}, ConfigError, "^places must be a list of numbers, got"),
        ({"words": ["a", 2]}, ConfigError, "^words must be a list of texts, got"),
        ({"mode": "cubed"}, ConfigError, "^mode must be one of plain, squared, got 'cubed'$"),
    ],
)
def test_what_has_no_meaning_is_refused_by_its_key(
    values: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        outer(**values)
    # Within a whole the key is longer by where it stands.
    within = "^" + r"run\." + message.removeprefix("^")
    with pytest.raises(error, match=within):
        read({"name": "it", **values}, Outer, "run")


def test_what_must_be_given_is_asked_for() -> None:
    with pytest.raises(ConfigError, match=r"^lengths must be given$"):
        read({}, Arm)
    with pytest.raises(ConfigError, match=r"^arm\.lengths must be given$"):
        read({"mass": 1.0}, Arm, "arm")
    with pytest.raises(ConfigError, match=r"^the settings must hold keys and values, got \[\]$"):
        read([], Arm)  # type: ignore[arg-type]


def test_a_part_is_named_by_its_class() -> None:
    law = outer(law={"kind": LAW, "gamma": 3, "regressor": "partial"}).law
    assert law == AdaptiveLaw.settings_type(gamma=3.0, regressor="partial")
    # Without a kind it is the default's, changed.
    assert outer(shipped={"gamma": 7.0}).shipped == NormalisedLaw.settings_type(gamma=7.0)
    assert outer(shipped={}).shipped == NormalisedLaw.settings_type()
    started = read({"law": {"rate": 0.1}}, Outer, start=Outer(name="it", law=AdaptiveLaw.settings_type(gamma=2.0)))
    assert started.law == AdaptiveLaw.settings_type(gamma=2.0, rate=0.1)
    for none in (None, {}, {"kind": None}):
        assert outer(law=none).law is None
    assert outer(shipped=None).shipped is None and outer(shipped={"kind": None}).shipped is None
    model = read({"model": {"kind": name_of(PCCBackbone)}}, ControlSettings).model
    assert type(model) is PCCBackbone.settings_type


@pytest.mark.parametrize(
    ("law", "message"),
    [
        ({"kind": None, "gamma": 1.0}, "^law.gamma is read by nothing: there is no law here, choose one$"),
        ({"gamma": 1.0}, "^law.kind must name a class, as package.module.Class$"),
        ({"kind": MUST}, "^law.kind must name a class, as package.module.Class$"),
        ({"kind": 3}, "^law.kind must name a class"),
        ("AdaptiveLaw", "^law.kind must name a class"),
        ({"kind": LAW, "gama": 1.0}, r"^law.gama is no setting; did you mean gamma\?$"),
        ({"kind": LAW, "gamma": "much"}, "^law.gamma must be a number"),
        ({"kind": LAW + "s"}, "^law.kind must be a class, as package.module.Class, got '.*AdaptiveLaws'"),
        ({"kind": "apcc_torch.nothing.Law"}, "^law.kind must be a class, .*No module named"),
        ({"kind": "Law"}, "^law.kind must be a class, as package.module.Class, got 'Law'"),
        ({"kind": "apcc_torch.model.affine.AffineBackbone"}, "^law.kind must be a LengthLaw, got"),
        ({"kind": "apcc_torch.control.bounds.within"}, "^law.kind must be a LengthLaw, got"),
        (
            {"kind": "apcc_torch.control.length_law.LengthLaw"},
            "^law.kind must be a class that is complete, .* lacks speed$",
        ),
    ],
)
def test_a_part_without_a_class_of_its_own_is_refused(law: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        outer(law=law)


SPY = """
from pathlib import Path
from apcc_torch.control.adaptation import AdaptiveLaw
Path(__file__).with_suffix(".imported").touch()
class Law(AdaptiveLaw):
    pass
"""


def test_a_class_from_elsewhere_is_not_even_imported_unless_it_is_trusted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "spying_law.py").write_text(SPY)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    values = {"name": "it", "law": {"kind": "spying_law.Law", "gamma": 3.0}}
    with pytest.raises(ConfigError, match=r"^law\.kind names spying_law\.Law, which is not of this package"):
        read(values, Outer, trust=Trust.OWN)
    for name in ("apcc_torchx.Law", "os.path.join", "apcc_torch"):
        with pytest.raises(ConfigError, match="which is not of this package"):
            class_named("law.kind", name, LengthLaw, Trust.OWN)
    assert not (tmp_path / "spying_law.imported").exists() and "spying_law" not in sys.modules
    assert read({**values, "law": {"kind": LAW}}, Outer, trust=Trust.OWN).law == AdaptiveLaw.settings_type()
    # Allowed by name, or typed by a user, it is taken from the working folder.
    ALLOWED.add("spying_law.Law")
    try:
        law = read(values, Outer, trust=Trust.OWN).law
    finally:
        ALLOWED.discard("spying_law.Law")
        sys.modules.pop("spying_law", None)
    assert (tmp_path / "spying_law.imported").exists() and law is not None and law.gamma == 3.0  # type: ignore[attr-defined]
    assert type(read(values, Outer).law).__module__ == "spying_law"
    sys.modules.pop("spying_law", None)


def test_nothing_within_a_part_is_trusted_more_than_the_whole() -> None:
    with pytest.raises(ConfigError, match=r"^adaptation\.kind names elsewhere\.Law, which is not of this package"):
        read({"adaptation": {"kind": "elsewhere.Law"}}, ControlSettings, trust=Trust.OWN)


@pytest.mark.parametrize("kind", settings_classes(), ids=lambda kind: f"{kind.__module__}.{kind.__name__}")
def test_settings_are_read_back_from_their_plain_values(kind: type[Settings]) -> None:
    settings = kind(**needed(kind))
    values = plain(settings)
    assert set(values) == {each.name for each in keys(kind)}
    again = read(values, kind)
    assert again == settings and plain(again) == values
    # What differs from the defaults says as much.
    assert read(deviations(settings), kind) == settings
    given = {each.name for each in keys(kind) if each.name in needed(kind)}
    assert set(deviations(settings)) == given


@pytest.mark.parametrize("kind", settings_classes(), ids=lambda kind: f"{kind.__module__}.{kind.__name__}")
def test_defaults_are_the_plain_values_of_what_needs_nothing(kind: type[Settings]) -> None:
    values = defaults(kind)
    assert set(values) == {each.name for each in keys(kind)}
    given = needed(kind)
    if not given:
        assert values == plain(kind()) and read(values, kind) == kind()
        return
    for name in given:
        assert values[name] == MUST or isinstance(values[name], dict), name
    with pytest.raises(ConfigError, match=r"must be given$"):
        read(values, kind)


@pytest.mark.parametrize("kind", settings_classes(), ids=lambda kind: f"{kind.__module__}.{kind.__name__}")
def test_every_setting_says_what_it_is(kind: type[Settings]) -> None:
    for each in fields(kind):
        about = about_of(each)
        assert about.meaning and about.source in ("paper", "ours") and "\n" not in about.meaning, each.name
        assert not about.meaning.endswith("."), each.name
        default = default_of(each)
        assert not about.choices or default in (*about.choices, None), each.name


def test_tensors_and_changes_are_told_as_plain_values() -> None:
    settings = Outer(
        name="it", gain=torch.tensor([1.0, 2.0]), inner=Inner(size=2.0), shipped=AffineLike.settings_type(gamma=9.0)
    )
    values = plain(settings)
    assert values["gain"] == [1.0, 2.0] and "secret" not in values
    assert values["shipped"] == {"kind": f"{__name__}.AffineLike", **plain(AffineLike.settings_type(gamma=9.0))}
    assert deviations(settings) == {
        "name": "it", "gain": [1.0, 2.0], "inner": {"size": 2.0}, "shipped": values["shipped"]
    }  # fmt: skip
    assert plain(Outer(name="it", many={"a": Inner()}))["many"] == {"a": {"size": 1.0, "count": 2}}


class AffineLike(AdaptiveLaw):
    """A law that inherits its settings: its kind is its own."""


def test_a_class_that_inherits_settings_is_read_back_as_itself() -> None:
    chosen = ControlSettings(adaptation=AdaptiveLaw.settings_type(), model=AffineBackbone.settings_type(rods=2))
    assert read(plain(chosen), ControlSettings) == chosen
    assert read(deviations(chosen), ControlSettings) == chosen

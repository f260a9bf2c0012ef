"""A default stands in one place: beside the part. Files hold deviations, constructors hold nothing."""

from __future__ import annotations

import inspect
import pkgutil
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, fields
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from hydra import compose, initialize_config_dir
from torch import Tensor

import apcc_torch
from apcc_torch.classes import class_named
from apcc_torch.composition.benchmark import BenchmarkSettings
from apcc_torch.composition.build import Builder
from apcc_torch.composition.evaluate import EvaluateSettings
from apcc_torch.composition.identify import IdentifySettings
from apcc_torch.composition.realtime import RealtimeSettings
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.composition.schema import typed
from apcc_torch.conf_path import conf_path
from apcc_torch.control.gain import gain_matrix
from apcc_torch.part import Configurable, Part
from apcc_torch.reading import nested_in, plain
from apcc_torch.settings import Settings, about_of, default_of, keys
from composed import composed, composed_realtime

CONF = Path(conf_path())
ROOTS = {"grid": BenchmarkSettings, "data_set": EvaluateSettings, "identification": IdentifySettings}
ON_AN_ARM = ("guards", "hardware", "calibration", "experiment_1", "experiment_2")

ALLOWED = {
    ("experiment/experiment_1.yaml", "experiment.setpoints"): "the set-point of the experiment that it starts from",
    ("experiment/tracking.yaml", "experiment.setpoints"): "the set-points of the experiment that it starts from",
    ("state/exact.yaml", "controller.rate"): "the experiment's rate, that of its sensors",
}
"""(file, key) of a value that is the default, and what it takes back."""


def subclasses(kind: Any) -> Iterator[Any]:
    for each in kind.__subclasses__():
        yield each
        yield from subclasses(each)


@cache
def everything() -> tuple[type[Any], ...]:
    """Every class with settings, and every class of settings, of this package."""
    for module in pkgutil.walk_packages(apcc_torch.__path__, "apcc_torch."):
        if "__main__" not in module.name and "sweeps" not in module.name:
            try:
                import_module(module.name)
            except ImportError:
                assert "hardware" in module.name or "envs" in module.name, module.name  # libraries that are extras
    return tuple(
        dict.fromkeys(c for base in (Settings, Configurable) for c in subclasses(base) if "apcc_torch" in c.__module__)
    )


def kind_in(folder: Path, name: str) -> str | None:
    """The class that a choice names, or the choice that it starts from."""
    values = yaml.safe_load((folder / f"{name}.yaml").read_text(encoding="utf-8")) or {}
    if "kind" in values:
        return None if values["kind"] is None else str(values["kind"])
    for base in values.get("defaults", []):
        if isinstance(base, str) and base != "_self_":
            return kind_in(folder, base)
    return None


def told(
    values: Mapping[str, Any], root: type[Settings], path: str = "", start: Any = None
) -> Iterator[tuple[str, Any, Any]]:
    """(key, value, default) of every value in plain nested values; defaults are those of `start`, if there is one."""
    known = {each.name: each for each in keys(root)}
    for name, value in values.items():
        key, each = f"{path}{name}", known[name]
        nested, default = nested_in(root, name), default_of(each) if start is None else getattr(start, name)
        base = about_of(each).base
        if base is not None and isinstance(value, Mapping):
            if value.get("kind") not in (None, "package.module.Class"):
                nested = class_named(key, value["kind"], base).settings_type
            elif default not in (None, MISSING):
                nested = type(default)
            value = {inner: entry for inner, entry in value.items() if inner != "kind"}
        if nested is not None and isinstance(value, Mapping):
            yield from told(value, nested, f"{key}.", default if isinstance(default, nested) else None)
        else:
            yield key, value, plain(None if default is MISSING else default)


def file_values(path: Path) -> tuple[dict[str, Any], type[Settings]]:
    """What a file of conf/ sets, from the root on, and the root."""
    text = path.read_text(encoding="utf-8")
    read = yaml.safe_load(text) or {}
    values = {k: v for k, v in read.items() if k not in ("defaults", "hydra")}
    for chosen in read.get("defaults", []):
        for key, choice in chosen.items() if isinstance(chosen, dict) else ():
            other = key.removeprefix("override /")
            kind = kind_in(CONF / other, choice) if isinstance(values.get(other), dict) else None
            if kind is not None:  # keys beside a choice are those of its class
                values[other] = {"kind": kind, **values[other]}
    group = path.parent.name
    root = ROOTS.get(group, RealtimeSettings if {group, path.stem} & set(ON_AN_ARM) else SimulateSettings)
    if "@package _global_" in text or group == "data_set":
        return values, root
    kind = kind_in(path.parent, path.stem)
    if kind is not None and "kind" not in values:
        values = {"kind": kind, **values}
    return ({group: values} if values else {}), root


FILES = sorted(path.relative_to(CONF).as_posix() for path in CONF.glob("*/*.yaml"))


@pytest.mark.parametrize("name", [name for name in FILES if not name.startswith("hydra/")])
def test_a_file_holds_what_differs_from_the_defaults(name: str) -> None:
    values, root = file_values(CONF / name)
    same = {
        key
        for key, value, default in told(values, root)
        if value == default and isinstance(value, bool) == isinstance(default, bool)
    }
    assert same == {key for file, key in ALLOWED if file == name}


def test_settings_that_inherit_tell_only_what_differs() -> None:
    for kind in everything():
        if not issubclass(kind, Settings):
            continue
        inherited = {each.name: each for base in kind.__bases__ if issubclass(base, Settings) for each in fields(base)}
        for name in inspect.get_annotations(kind):
            if name in inherited:
                own = next(each for each in fields(kind) if each.name == name)
                assert default_of(own) != default_of(inherited[name]), f"{kind.__name__}.{name}"


def test_constructors_repeat_no_default() -> None:
    told_twice = []
    for part in everything():
        if not issubclass(part, Configurable) or part.__init__ is Part.__init__:
            continue
        settings = {each.name for each in fields(part.settings_type)}
        arguments = inspect.signature(part.__init__).parameters.values()
        told_twice += [
            f"{part.__name__}({a.name}={a.default})"
            for a in arguments
            if a.name in settings and a.default not in (inspect.Parameter.empty, None)
        ]
    assert not told_twice


def test_no_class_of_settings_is_there_twice() -> None:
    names = [k.__qualname__ for k in everything() if issubclass(k, Settings) and not k.__qualname__.endswith("_type")]
    assert len(set(names)) == len(names), sorted({name for name in names if names.count(name) > 1})


PLAIN = "# @package _global_\nexperiment: {name: plain, kind: kinematic}\n"
"""An experiment that deviates in nothing."""


@pytest.fixture(scope="module")
def plain_run(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Settings as the command line makes them of the choices alone: plain_run("simulate", "model=affine")."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "experiment").mkdir()
    (folder / "experiment" / "plain.yaml").write_text(PLAIN)
    roots = {"simulate": SimulateSettings, "realtime": RealtimeSettings}

    def compose_plain(root: str, *words: str) -> Any:
        with initialize_config_dir(conf_path(), version_base="1.3"):
            cfg = compose(root, ["experiment=plain", f"hydra.searchpath=[file://{folder}]", *words])
        return typed(cfg, roots[root])

    return compose_plain


def parts_in(settings: Settings, path: str = "") -> Iterator[tuple[str, Settings]]:
    """(key, settings) of every part in settings, whole ones before those that they hold."""
    for each in fields(settings):
        value = getattr(settings, each.name)
        if isinstance(value, Settings):
            yield f"{path}{each.name}", value
            yield from parts_in(value, f"{path}{each.name}.")


def test_what_the_command_line_builds_is_what_the_class_is(plain_run: Any) -> None:
    config = plain_run("simulate")
    compared = dict(parts_in(config))
    assert {"model", "feedback", "controller", "adaptation", "bounds", "plant.pid", "sensors"} <= set(compared)
    for key, settings in compared.items():
        if key not in ("arm", "experiment"):
            assert settings == type(settings)(), key
    given = {each.name: getattr(config, each.name) for each in fields(config) if default_of(each) is MISSING}
    assert config == SimulateSettings(**given), "nor do values at the root deviate"


def test_the_arm_in_real_time_is_what_its_classes_are(plain_run: Any) -> None:
    config = plain_run("realtime", "sensors=perfect")
    for key, settings in parts_in(config):
        if key not in ("arm", "experiment", "guards.sensing.gate"):
            assert settings == type(settings)(), key
    # An arm under control is believed more than a recording.
    assert config.guards.sensing.gate == type(config.guards.sensing)().gate


@pytest.mark.parametrize(
    "words",
    [
        (),
        ("adaptation=estimator_aware", "model=affine"),
        ("adaptation=none", "pose_filter.delay=0", "integral={}", "feedback=pose"),
    ],
)
def test_every_module_of_the_controller_has_its_classs_settings(plain_run: Any, words: tuple[str, ...]) -> None:
    build = Builder(plain_run("simulate", *words))
    for module in (build.controller(), build.plant(torch.zeros(1).double()), build.pose_sensors()):
        for name, part in module.named_modules():
            if isinstance(part, Part) and not any(default_of(each) is MISSING for each in fields(part.settings_type)):
                compare(part.settings, type(part).settings_type(), f"{type(part).__name__} {name}")


def compare(settings: Settings, defaults: Settings, name: str) -> None:
    for each in fields(settings):
        value, default, key = getattr(settings, each.name), getattr(defaults, each.name), f"{name}.{each.name}"
        if isinstance(value, Tensor) and about_of(each).rows in ("gain", "task"):
            default = gain_matrix(key, default, value.shape[-1])
        if isinstance(value, Tensor):
            assert default is not None, key
            torch.testing.assert_close(value, torch.as_tensor(default).to(value), msg=key)
        else:
            assert value == default, key


@pytest.mark.parametrize(
    ("group", "choice"),
    [
        *(("adaptation", "normalised"), ("adaptation", "estimator_aware"), ("adaptation", "shape")),
        *(("dynamics_law", "composite"), ("lookahead", "mppi"), ("model", "pcc"), ("model", "affine")),
        *(("plant", "sections"), ("sensors", "perfect"), ("feedback", "pose")),
    ],
)
def test_the_choice_that_names_a_class_is_that_class(group: str, choice: str) -> None:
    chosen = getattr(composed("experiment=kinematic", f"{group}={choice}"), group)
    assert chosen == type(chosen)()


def test_simulated_hardware_is_the_default() -> None:
    config = composed_realtime("experiment=setpoint")
    assert config.hardware == type(config.hardware)()

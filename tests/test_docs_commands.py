"""Every command, key and Python block of README.md and docs/ is one that works, or is listed here with the reason.

Settings are composed and read, arguments parsed, and Python blocks executed; no experiment is run.
"""

from __future__ import annotations

import argparse
import re
import runpy
import sys
import warnings
from collections.abc import Callable, Iterator
from functools import cache
from itertools import zip_longest
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser

from apcc_torch import benchmark, new_arm  # the import of the first registers their settings with hydra
from apcc_torch.composition.benchmark import BenchmarkSettings
from apcc_torch.composition.help import rows
from apcc_torch.composition.identify import IdentifySettings
from apcc_torch.composition.schema import typed
from apcc_torch.conf_path import conf_path
from composed import composed, composed_evaluate, composed_export, composed_identify, composed_realtime
from doc_pages import PAGES, ROOT, Block, Command, commands, keys, name_of, python_blocks

UNCHECKED_COMMANDS: dict[str, str] = {
    "simulate -cd my_conf experiment=kinematic sweep=mine": "the folder is the reader's; test_simulate has such a one",
    "simulate experiment=kinematic adaptation=custom adaptation.kind=my_laws.Leak adaptation.time=2": (
        "the module is the reader's"
    ),
    "simulate experiment=kinematic model=custom model.kind=my_models.Quadratic model.rods=4": "the reader's module",
    "robot experiment=setpoint hardware.actuator.kind=my_motors.Motors hardware.actuator.port=/dev/ttyUSB0": (
        "the module is the reader's"
    ),
    "identify arm=mine.yaml data=mine.csv recording.inputs=[a,b,c,d,e,f] recording.bodies=[[x1,y1,z1],[x2,y2,z2]]": (
        "the file is the reader's"
    ),
    "identify arm=mine.yaml data=mine.csv": "the files are the reader's",
    "evaluate data=data.yaml": "tests/recordings/test_worked_examples.py runs it",
    "evaluate data=rod.yaml": "tests/recordings/test_worked_examples.py runs it",
    "identify data=data.yaml": "tests/recordings/test_worked_examples.py runs it",
    "simulate experiment=replay data=data.yaml feedback=position replay.direction=[0,0,-1] "
    "replay.base_position=[0,0,0]": "tests/recordings/test_worked_examples.py runs it",
    "export arm=mine.yaml out=mine_library": "the file is the reader's; tests/exporting has such arms",
    "evaluate data=mine.yaml": "the file is the reader's; tests/evaluation has such a one",
    "identify arm=runs/identify/FOLDER/parameters.json identification=ftdcr_v6 data=train.csv": (
        "the run is the reader's"
    ),
}
"""Command -> why it is not checked."""

UNRUN_BLOCKS: dict[str, str] = {
    "docs/environments.md 4": "trains for minutes; tests/envs/test_libraries.py runs the adapter",
    "docs/gradients.md 2": "builds libraries; tests/native/test_gradient.py does",
    "docs/report.md 1": "pandas is not among the dev requirements, and the sweep is the reader's",
    "docs/speed.md 1": "builds a library for half a minute; tests/native/test_steps.py calls one",
    "docs/speed.md 2": "builds three libraries; tests/native/test_kinematics.py does, of smaller arms",
    "docs/speed.md 3": "goes on from the first; tests/native/test_standing.py calls one",
}
"""Block -> why it is not run."""

NEEDS = {
    "sweep=optuna": "hydra_plugins.hydra_optuna_sweeper",
    "torchrl_reach.py": "torchrl",
    "skrl_reach.py": "skrl",
    "model_files.py": "mujoco",
    "docs/messages.md 1": "rosbags",
    "docs/environments.md 5": "torchrl",
    "docs/environments.md 6": "skrl",
    "docs/environments.md 7": "minari",
}
"""What a command holds, or a block -> the package that it cannot do without."""

YOUR_ARM = "docs/your_arm.md"
CHOSEN = ("plant", "adaptation", "model", "dynamics_law", "lookahead")
"""Groups whose choices have keys of their own."""

COMMANDS = list({command.text: command for page in PAGES for command in commands(page)}.values())
CHECKED = [command for command in COMMANDS if command.text not in UNCHECKED_COMMANDS]
BLOCKS = [block for page in PAGES for block in python_blocks(page)]
RUN = [block for block in BLOCKS if block.name not in UNRUN_BLOCKS]
FLAGS = {"-m", "--multirun", "--batch"}


def composed_benchmark(*overrides: str) -> BenchmarkSettings:
    """The benchmark's settings, with those of the runs that the overrides name, else of a comparison's first run."""
    with initialize_config_dir(conf_path(), version_base="1.3"):
        config = typed(compose("benchmark", list(overrides)), BenchmarkSettings)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            benchmark, "experiment", lambda name, changes: settings("simulate", f"experiment={name}", *changes)
        )
        for name, comparison in config.grid.comparisons.items():
            named = [run for run in comparison.runs if f"{name}.runs.{run}" in " ".join(overrides)]
            for run in named or [*comparison.runs][:1]:
                assert benchmark.rows(config, comparison, run)
    return config


def composed_with_arm(*overrides: str) -> IdentifySettings:
    """Identification's settings; the program finds the arm in a recording that names none."""
    arm = () if any(o.startswith("arm=") for o in overrides) else ("arm=trunk",)
    return composed_identify(*overrides, *arm)


PROGRAMS: dict[str, Callable[..., Any]] = {
    "simulate": composed,
    "robot": composed_realtime,
    "benchmark": composed_benchmark,
    "identify": composed_with_arm,
    "evaluate": composed_evaluate,
    "export": composed_export,
}
"""A program of hydra's -> what composes and reads its settings."""


@cache
def settings(program: str, *overrides: str) -> Any:
    """A program's settings; composing them is what takes the time here."""
    return PROGRAMS[program](*overrides)


def points(overrides: list[str]) -> Iterator[list[str]]:
    """The overrides without sweeps: each value of a swept group, and the first of a swept key, which has one type."""
    parsed = OverridesParser.create().parse_overrides(overrides)
    values = []
    for o in parsed:
        swept = o.is_sweep_override()
        values.append([f"{o.key_or_group}={v}" for v in o.sweep_string_iterator()] if swept else [o.input_line])
    first = [choice[0] for choice in values]
    yield first
    for k, choice in enumerate(values):
        if "." not in parsed[k].key_or_group:
            yield from ([*first[:k], other, *first[k + 1 :]] for other in choice[1:])


class Parsed(BaseException):
    """A program parsed its arguments: it is stopped there."""


def run_until_parsed(program: str) -> None:
    """Starts a program of ours that uses argparse, from its arguments in sys.argv."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # its module may be imported already
        if program.endswith(".py"):
            runpy.run_path(program, run_name="__main__")
        else:
            runpy.run_module(f"apcc_torch.{program}", run_name="__main__")


def options_of(command: Command, monkeypatch: pytest.MonkeyPatch) -> argparse.Namespace:
    """What a program that uses argparse makes of its arguments."""
    whole = argparse.ArgumentParser.parse_args

    def stop(self: argparse.ArgumentParser, args: Any = None, namespace: Any = None) -> Any:
        raise Parsed(whole(self, args, namespace))

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", stop)
    monkeypatch.setattr(sys, "argv", [command.program, *command.arguments])
    monkeypatch.chdir(ROOT)
    monkeypatch.syspath_prepend(str((ROOT / command.program).parent))
    with pytest.raises(Parsed) as caught:
        run_until_parsed(command.program)
    options: argparse.Namespace = caught.value.args[0]
    return options


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where a reader of docs/your_arm.md is: with the files of its arms, as its own commands write them."""
    made = tmp_path_factory.mktemp("reader")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(made)
        for command in COMMANDS:
            if command.program == "new_arm" and command.page == YOUR_ARM:
                new_arm.main(command.arguments)
    return made


def place(page: str, folder: Path) -> Path:
    """Where what stands on a page is run."""
    return folder if page == YOUR_ARM else ROOT


@pytest.mark.parametrize("command", CHECKED, ids=lambda command: command.text)
def test_command(command: Command, monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    monkeypatch.chdir(place(command.page, folder))
    for held, needed in NEEDS.items():
        if held in command.text:
            pytest.importorskip(needed)
    if command.program not in PROGRAMS:
        options = options_of(command, monkeypatch)
        if "settings" in options and "comparisons" in (ROOT / command.program).read_text(encoding="utf-8"):
            settings("benchmark", *options.settings)
        return
    for overrides in points([argument for argument in command.arguments if argument not in FLAGS]):
        assert settings(command.program, *overrides)


@cache
def names_in(page: str) -> dict[str, Any]:
    """The names that a page's blocks make: each block may use what the ones before it made, as a reader would."""
    module = ModuleType(re.sub(r"\W", "_", page))
    sys.modules[module.__name__] = module  # where dataclasses look for the names in their annotations
    return module.__dict__


@pytest.mark.parametrize("block", RUN, ids=lambda block: block.name)
def test_python_block(block: Block, monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    if block.name in NEEDS:
        pytest.importorskip(NEEDS[block.name])
    monkeypatch.chdir(place(block.page, folder))
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    torch.manual_seed(0)
    exec(compile(block.code, block.name, "exec"), names_in(block.page))


@cache
def known_keys() -> set[str]:
    """Every key of every program, whatever is chosen."""
    choices = [[f"{g}={path.stem}" for path in sorted((Path(conf_path()) / g).glob("*.yaml"))] for g in CHOSEN]
    own = [[choice for choice in group if not choice.endswith("=custom")] for group in choices]
    some = zip_longest(*own, fillvalue="figures=false")
    every = [settings("simulate", "experiment=dynamic_run_2", *dict.fromkeys(chosen)) for chosen in some]
    for platform in ("dynamixel_optitrack", "dynamixel_qualisys", "feetech_optitrack"):
        every += [settings("robot", "experiment=setpoint", f"hardware={platform}")]
    every += [settings("robot", "experiment=setpoint", "arm=soft_trunk", "hardware=modbus_optitrack")]
    every += [settings("robot", "experiment=setpoint"), settings("identify", "data=PATH")]
    every += [settings("evaluate", "data=trunk_payload"), settings("export", "arm=arm_2")]
    told = [row for each in every for row in rows(each)]
    return {row.key for row in told} | {f"{row.key}.kind" for row in told if not row.source}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_key_that_a_page_names_exists(page: Path) -> None:
    groups = {key.partition(".")[0] for key in known_keys() if "." in key}
    named = {re.sub(r"\.[A-Z]{3,}$", "", key) for key in keys(page)}  # bounds.KEY names a group
    for key in named - known_keys():
        assert key.partition(".")[0] not in groups, f"{name_of(page)}: {key} is no key"


def test_every_listed_exception_is_still_there() -> None:
    assert set(UNCHECKED_COMMANDS) <= {command.text for command in COMMANDS}
    assert set(UNRUN_BLOCKS) <= {block.name for block in BLOCKS}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        assert "://" in target or (page.parent / target).exists(), target

"""A law, a kinematic model and a plant from a folder of the user's own run by the command line, with no edit here."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path

import pytest
import yaml

from apcc_torch.errors import ApccError, DataError
from apcc_torch.experiments.redrawing import load_run
from commands import QUICK, jobs, simulate
from composed import composed

OWN = '''"""Parts of a laboratory's own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from apcc_torch import AffineBackbone, LengthLaw, Settings, StateFeedback, resolved, setting
from apcc_torch.part import hold_rows
from apcc_torch.settings import Setting, aligned
from apcc_torch.simulation.plant import Plant, PlantSettings


@dataclass(frozen=True, kw_only=True)
class LeakSettings(Settings):
    """Settings of `Leak`."""

    time: Setting = setting(5.0, "s", meaning="in which the estimate leaks to the first one", rows="number", above=0)


class Leak(LengthLaw):
    """The estimate leaks towards the first one."""

    settings_type = LeakSettings
    time: Setting
    nominal: Tensor

    def __init__(self, nominal: Tensor, feedback: StateFeedback, *settings: Any, **changes: Any) -> None:
        super().__init__()
        hold_rows(self, nominal=(0.9 * nominal, 1))
        self.hold(resolved(LeakSettings, settings, changes))

    def speed(self, step: Any, memory: Any) -> tuple[Tensor, Any]:
        return (self.nominal - step.pi_hat) / aligned(self.time, 1), memory


class TwoRods(AffineBackbone):
    """Affine sections."""


@dataclass(frozen=True, kw_only=True)
class HeavySettings(PlantSettings):
    """Settings of `Heavy`."""

    ballast: float = setting(0.1, "kg", meaning="beside every payload", least=0)


class Heavy(Plant):
    """A plant with a ballast at its tip."""

    settings_type = HeavySettings
    ballast: float

    @classmethod
    def on(cls, arm: Any, payload: Tensor, settings: HeavySettings) -> Heavy:
        return super().on(arm, payload + settings.ballast, settings)
'''

LAW = ("adaptation=custom", "adaptation.kind=my_parts.Leak")
DYNAMIC = (
    *("experiment=dynamic_single", "experiment.duration=0.1", "controller.rate=50", "figures=false"),
    *("plant.settle=0.1", "progress=false"),
)


@pytest.fixture
def laboratory(tmp_path: Path) -> Path:
    (tmp_path / "my_parts.py").write_text(OWN)
    return tmp_path


def settings_in(run: Path) -> dict[str, dict[str, object]]:
    loaded: dict[str, dict[str, object]] = yaml.safe_load((run / "config.yaml").read_text())
    return loaded


def metrics_in(run: Path) -> dict[str, float]:
    loaded: dict[str, float] = json.loads((run / "metrics.json").read_text())
    return loaded


def test_a_law_of_ones_own(laboratory: Path) -> None:
    done = simulate(laboratory, *QUICK, *LAW, "adaptation.time=2", "hydra.run.dir=run")
    assert done.returncode == 0, done.stderr + done.stdout
    assert settings_in(laboratory / "run")["adaptation"] == {"kind": "my_parts.Leak", "time": 2.0}
    # Four steps of 0.02 s, each by a hundredth of what is left to 0.9 of the first estimate.
    first, share = 0.12, (1.0 - 0.02 / 2.0) ** 4
    end = metrics_in(laboratory / "run")["pi_hat_1_end_m"]
    assert end == pytest.approx(first * (0.9 + 0.1 * share), rel=1e-6)


def test_its_keys_are_swept_in_jobs_and_in_a_batch(laboratory: Path) -> None:
    times = "adaptation.time=1,2,3"
    done = simulate(laboratory, "-m", "hydra/launcher=basic", *QUICK, *LAW, times, "hydra.sweep.dir=sweep")
    assert done.returncode == 0, done.stderr + done.stdout
    single = jobs(laboratory / "sweep")
    assert len(single) == 3 and len({metrics["pi_hat_1_end_m"] for metrics in single.values()}) == 3
    done = simulate(laboratory, *QUICK, *LAW, "hydra.run.dir=batch", "--batch", times)
    assert done.returncode == 0, done.stderr + done.stdout
    with (laboratory / "batch" / "points.csv").open(newline="") as file:
        points = {row["adaptation.time"]: row for row in csv.DictReader(file)}
    for name, metrics in single.items():
        row = points[next(word for word in name.split() if "time" in word).partition("=")[2]]
        numbers = {key: float(row[key]) for key in metrics}
        assert numbers == pytest.approx(metrics, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("adaptation.tim=2", "adaptation.tim is no setting; did you mean time?"),
        ("adaptation.time=-2", "adaptation.time must be positive and finite, got -2.0"),
        ("adaptation.kind=my_parts.Leek", "has no attribute 'Leek'"),
        ("adaptation.kind=my_parts.Heavy", "adaptation.kind must be a LengthLaw"),
    ],
)
def test_what_it_does_not_have_is_refused(
    laboratory: Path, monkeypatch: pytest.MonkeyPatch, word: str, said: str
) -> None:
    monkeypatch.syspath_prepend(laboratory)
    with pytest.raises(ApccError) as caught:
        composed(*QUICK, *LAW, word)
    assert said in str(caught.value)
    del sys.modules["my_parts"]


def test_its_keys_are_in_the_manual(laboratory: Path) -> None:
    done = simulate(laboratory, "--help", *LAW)
    assert "adaptation.time=5 s" in done.stdout and "in which the estimate leaks to the first one" in done.stdout


def test_a_model_and_a_plant_of_ones_own(laboratory: Path) -> None:
    own = ("model=custom", "model.kind=my_parts.TwoRods", "model.rods=2")
    plant = ("plant=custom", "plant.kind=my_parts.Heavy", "plant.ballast=0.3", "plant.pid.K_P=700")
    done = simulate(laboratory, *DYNAMIC, *own, *plant, "experiment.payloads=[0.2]", "hydra.run.dir=run")
    assert done.returncode == 0, done.stderr + done.stdout
    config = settings_in(laboratory / "run")
    assert config["model"] == {"kind": "my_parts.TwoRods", "rods": 2}
    assert config["plant"]["ballast"] == 0.3 and config["plant"]["kind"] == "my_parts.Heavy"
    ours = ("plant=sections", "plant.pid.K_P=700", "model=affine", "model.rods=2", "experiment.payloads=[0.5]")
    done = simulate(laboratory, *DYNAMIC, *ours, "hydra.run.dir=same")
    assert done.returncode == 0, done.stderr + done.stdout
    same, run = metrics_in(laboratory / "same"), metrics_in(laboratory / "run")
    assert {**run, "wall_s": 0} == pytest.approx({**same, "wall_s": 0})


def test_a_report_builds_no_class_that_a_file_names(laboratory: Path) -> None:
    """A run's settings may come from elsewhere: reading them imports nothing that is not of this package."""
    done = simulate(laboratory, *QUICK, *LAW, "hydra.run.dir=run")
    assert done.returncode == 0, done.stderr + done.stdout
    (laboratory / "my_parts.py").write_text("raise SystemExit('imported')\n")
    with pytest.raises(DataError, match=r"adaptation\.kind names my_parts\.Leak, which is not of this package"):
        load_run(laboratory / "run")

"""An arm of two or of five sections, in a file of its own, runs with every preset: no preset knows their number."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.conf_path import conf_path
from apcc_torch.experiments.kinds import BATCHED
from composed import ON_AN_ARM, composed

FILES = {
    2: "lengths: [0.25, 0.3]\nmass: 0.8\n",
    5: "lengths: [0.1, 0.12, 0.12, 0.13, 0.13]\nsensors: [0.09, 0.2, 0.33, 0.46, 0.6]\n",
}
QUICK = ("experiment.duration=0.05", "controller.rate=100", "plant.settle=0.02", "progress=false")
CONF = Path(conf_path())


def choices(group: str, *but: str) -> list[str]:
    return sorted({path.stem for path in (CONF / group).glob("*.yaml")} - set(but))


@pytest.fixture(params=sorted(FILES))
def arm(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, int]:
    """The word that names its file, and how many sections it has."""
    (tmp_path / "mine.yaml").write_text(FILES[request.param])
    return f"arm={tmp_path / 'mine.yaml'}", request.param


def check(config: SimulateSettings, n: int) -> None:
    """Runs a few steps."""
    outcome: Any = BATCHED[config.experiment.kind].simulate(config, points=None, progress=None)
    log = outcome.log
    assert config.arm.n_sections == log.pi_hat.shape[-1] == n
    assert log.q_bar.shape[0] == 6 and bool(torch.isfinite(log.q_bar).all() and torch.isfinite(log.pi_hat).all())


@pytest.mark.parametrize("experiment", choices("experiment", "replay", *ON_AN_ARM))
def test_every_experiment_runs_on_it(arm: tuple[str, int], experiment: str) -> None:
    word, n = arm
    check(composed(f"experiment={experiment}", word, *QUICK), n)


@pytest.mark.parametrize("adaptation", choices("adaptation", "custom"))
def test_every_law_runs_on_it(arm: tuple[str, int], adaptation: str) -> None:
    word, n = arm
    check(composed("experiment=kinematic", word, f"adaptation={adaptation}", *QUICK), n)


@pytest.mark.parametrize("words", [("state=exact",), ("feedback=position",), ("model=affine", "sensors=mocap")])
def test_what_else_can_be_chosen_runs_on_it(arm: tuple[str, int], words: tuple[str, ...]) -> None:
    word, n = arm
    check(composed("experiment=kinematic", word, *QUICK, *words), n)


def test_a_replay_takes_its_tendons_and_base_and_measures_the_rest(arm: tuple[str, int]) -> None:
    word, n = arm
    config = composed("experiment=replay", word, "data=somewhere")
    assert config.arm.n_sections == n and config.arm.base == "hanging"

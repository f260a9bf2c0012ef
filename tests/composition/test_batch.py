"""Which runs can share a tensor batch, and what their settings look like side by side."""

from __future__ import annotations

import pytest
import torch

from apcc_torch.composition.batch import ROWS, stacked, structure
from apcc_torch.composition.build import Builder
from apcc_torch.composition.schema import SimulateConfig
from composed import changed


def same(*changes: str, experiment: str = "dynamic_run_2") -> bool:
    return len({structure(changed(experiment, change)) for change in ("seed=0", *changes)}) == 1


@pytest.mark.parametrize(
    "change",
    [
        *("controller.gamma=3", "controller.K=2", "controller.damping=0.1", "controller.bend_bound=2"),
        *("adaptation.gain_scale=1", "adaptation.lower=[0.05,0.1,0.1]", "adaptation.dead_zone=0.2"),
        *("robot.rest_lengths=[0.1,0.2,0.3]", "robot.sensors=[0.1,0.2,0.3]", "velocity_filter.window=5"),
        *("feedback.angular_weight=0.2", "plant.mass=2", "plant.lengths=[0.1,0.1,0.1,0.1,0.1,0.1]", "plant.K_P=500"),
        *("experiment.payloads=[0.1,0.2,0.3]", "residual.time_constant=2", "residual.total_range=0.2"),
    ],
)
def test_other_numbers_share_a_batch(change: str) -> None:
    assert same(change)


@pytest.mark.parametrize(
    "change",
    [
        *("velocity_filter.order=3", "feedback.mode=position", "feedback.max_iterations=3", "controller.rate=50"),
        *("controller.adaptive=false", "adaptation.regressor=partial", "adaptation.reach=0.5", "adaptation.rate=0.2"),
        *("robot.rest_lengths=[0.1,0.2]", "robot.racks=[0.1,0.2,0.3]", "robot.base=standing", "plant.substeps=4"),
        *("experiment.duration=1", "experiment.payloads=[0.1]", "plant.layout=independent", "seed=1", "dtype=float32"),
        *("sensors.position_noise=1e-3", "sensors.delay=1", "controller.gamma=[1,2,3]"),
        *("residual.memory=1", "residual.target=bank", "residual.gains=[1,1,2]", "residual.samples=4"),
    ],
)
def test_another_form_has_a_batch_of_its_own(change: str) -> None:
    assert not same(change)


def test_every_key_of_rows_is_a_setting() -> None:
    config = SimulateConfig()
    assert all(hasattr(getattr(config, section), name) for section, names in ROWS.items() for name in names)


def test_what_agrees_stays_and_what_differs_is_a_number_a_run() -> None:
    two = stacked([changed("dynamic_run_2", *c) for c in (("controller.K=1", "plant.lengths=[0.1,0.2]"),
                                                         ("controller.K=2", "plant.lengths=[0.3,0.4]"))])  # fmt: skip
    assert two.controller.K.tolist() == [[1.0], [2.0]]
    assert two.plant.lengths.tolist() == [[[0.1, 0.2]], [[0.3, 0.4]]]  # type: ignore[attr-defined]
    assert two.controller.gamma == 24.5 and two.adaptation.lower == [0.079, 0.191, 0.18]
    bends = [changed("dynamic_run_2", f"controller.null_bends=[0,{b},0]") for b in (0.1, 0.2)]
    assert stacked(bends).controller.null_bends.tolist() == [[[0, 0.1, 0]], [[0, 0.2, 0]]]  # type: ignore[union-attr]
    times = [changed("dynamic_run_2", f"pose_filter.angular_time={t}") for t in (0.0, 0.04)]
    assert stacked(times).pose_filter.angular_time.tolist() == [[0.0], [0.04]]  # type: ignore[attr-defined]
    windows = stacked([changed("kinematic", f"velocity_filter.window={n}") for n in (5, 9)]).velocity_filter.window
    assert windows.dtype == torch.int64 and windows.tolist() == [[5], [9]]  # type: ignore[attr-defined]


def test_the_builder_puts_runs_in_front_of_rows() -> None:
    changes = (
        ("controller.gamma=1", "adaptation.gain_scale=0.5", "adaptation.reach=0.5", "experiment.payloads=[0,1]"),
        ("controller.gamma=4", "adaptation.gain_scale=0.1", "adaptation.reach=0.6", "experiment.payloads=[2,3]"),
    )
    build = Builder(stacked([changed("dynamic_run_2", *c) for c in changes]), points=2)
    law = build.controller().law
    assert law.gamma.shape == (2, 1, 3, 3) and law.gamma[:, 0, 1, 1].tolist() == [0.5, 0.4]
    assert law.reach is not None and law.reach[:, 0].tolist() == [[0.0, 0.0, 0.5], [0.0, 0.0, 0.6]]
    points, payloads = build.grid()
    assert points.x_d.shape == (20, 3) and payloads.shape == (2, 20) and payloads[:, :4].tolist()[1] == [2, 3, 2, 3]
    assert build.first_estimate().shape == (2, 1, 3) and build.pose_sensors().shared == 1


def test_a_gain_that_is_a_list_is_scaled_run_by_run() -> None:
    changes = [(f"controller.gamma=[1,2,{g}]", f"adaptation.gain_scale={s}") for g, s in ((3, 1), (5, 2))]
    gamma = Builder(stacked([changed("kinematic", *c) for c in changes]), points=2).controller().law.gamma
    assert torch.diagonal(gamma[:, 0], dim1=-2, dim2=-1).tolist() == [[1.0, 2.0, 3.0], [2.0, 4.0, 10.0]]

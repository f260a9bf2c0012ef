"""Which runs can share a tensor batch, and what their settings look like side by side."""

from __future__ import annotations

import pytest
import torch

from apcc_torch.composition.build import Builder
from apcc_torch.composition.stacking import leaves, stacked, structure
from apcc_torch.control.adaptation import AdaptiveLaw
from apcc_torch.control.controller import APCCController
from composed import changed, composed


def same(*changes: str, experiment: str = "dynamic_run_2") -> bool:
    return len({structure(changed(experiment, change)) for change in ("seed=0", *changes)}) == 1


def law_of(controller: APCCController) -> AdaptiveLaw:
    law = controller.laws[0]
    assert isinstance(law, AdaptiveLaw)
    return law


@pytest.mark.parametrize(
    "change",
    [
        *("controller.K=2", "controller.K=[1,2,3]", "controller.bend_bound=2", "controller.null_gain=3"),
        *("arm.lengths=[0.1,0.2,0.3]", "velocity_filter.window=5", "feedback.angular_weight=0.2", "arm.mass=2"),
        *("bounds.lower=0.5", "bounds.lower=[0.5,0.6,0.7]", "plant.pid.K_P=500", "plant.tendon_damping=100"),
        *("experiment.payloads=[0.1,0.2,0.3]", "experiment.first_estimate=[1,1.1,1.2]"),
        *("experiment.first_estimate=[along,1.1]", "adaptation.time_constant=2", "adaptation.load=0.2"),
    ],
)
def test_other_numbers_share_a_batch(change: str) -> None:
    assert same(change)


@pytest.mark.parametrize(
    "change", ["adaptation.gamma=3", "adaptation.gamma=[1,2,3]", "adaptation.gain_scale=2", "adaptation.dead_zone=0.2"]
)
def test_other_numbers_of_the_law_share_a_batch(change: str) -> None:
    assert same(change, experiment="kinematic")


@pytest.mark.parametrize(
    "change",
    [
        *("velocity_filter.order=3", "feedback.mode=position", "feedback.max_iterations=3", "controller.rate=50"),
        *("controller.adaptive=false", "bounds.reach=each", "integral.gain=0.5", "controller.velocity=commanded"),
        *("arm.lengths=[0.1,0.2]", "arm.racks=[0.1,0.2,0.3]", "arm.base=standing", "plant.substeps=4"),
        *("experiment.duration=1", "experiment.payloads=[0.1]", "plant.arm.layout=independent", "seed=1"),
        *("sensors.position_noise=1e-3", "sensors.delay=1", "dtype=float32", "bounds.lower=null"),
        *("adaptation.refine=3", "plant.arm.mass=2", "arm.sensors=[0.1,0.3,0.5]"),
        *("plant.refine=3", "plant.transmission.friction=0.1", "model.kind=apcc_torch.model.affine.AffineBackbone"),
    ],
)
def test_another_form_has_a_batch_of_its_own(change: str) -> None:
    assert not same(change)


def test_every_class_is_part_of_the_form() -> None:
    paths = {path for path, _, value in leaves(changed("dynamic_run_2"))}
    assert {("plant", "kind"), ("model", "kind"), ("adaptation", "kind"), ("plant", "arm", "mass")} <= paths
    assert ("integral",) in paths and ("pose_filter",) in paths, "what is not there is told too"


def test_what_agrees_stays_and_what_differs_is_a_number_a_run() -> None:
    lengths = ("arm.lengths=[0.1,0.2]", "arm.lengths=[0.3,0.4]")
    two = stacked(
        [changed("kinematic", f"controller.K={k}", length) for k, length in zip((1, 2), lengths, strict=True)]
    )
    assert two.controller.K.tolist() == [[[[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]], [[[2.0, 0, 0], [0, 2, 0], [0, 0, 2]]]]
    assert two.arm.lengths.tolist() == [[[0.1, 0.2]], [[0.3, 0.4]]]  # type: ignore[union-attr]
    torch.testing.assert_close(two.controller.null_gain, torch.tensor([[0.5], [0.7 / 0.6]]).double())
    assert two.bounds.lower == 0.6
    bends = [changed("dynamic_run_2", f"controller.null_bends=[0,{b},0]") for b in (0.1, 0.2)]
    assert stacked(bends).controller.null_bends.tolist() == [[[0, 0.1, 0]], [[0, 0.2, 0]]]  # type: ignore[union-attr]
    times = [changed("dynamic_run_2", f"pose_filter.angular_time={t}") for t in (0.0, 0.04)]
    assert stacked(times).pose_filter.angular_time.tolist() == [[0.0], [0.04]]  # type: ignore[union-attr]
    windows = stacked([changed("kinematic", f"velocity_filter.window={n}") for n in (5, 9)]).velocity_filter.window
    assert isinstance(windows, torch.Tensor) and windows.dtype == torch.int64 and windows.tolist() == [[5], [9]]
    loads = stacked([changed("dynamic_run_2", f"plant.arm.mass={m}") for m in (1.1, 1.2)])
    assert loads.plant.arm.mass.tolist() == [[1.1], [1.2]]  # type: ignore[attr-defined]


def test_the_builder_puts_runs_in_front_of_rows() -> None:
    base = ("experiment=dynamic_run_2", "adaptation=normalised")
    runs = [
        composed(*base, f"adaptation.gamma={g}", f"adaptation.gain_scale={s}", f"experiment.payloads={loads}")
        for g, s, loads in ((1, 0.5, [0, 1]), (4, 0.1, [2, 3]))
    ]
    build = Builder(stacked(runs), points=2)
    law = law_of(build.controller())
    assert law.gamma.shape == (2, 1, 3, 3) and law.metric[:, 0, 1, 1].tolist() == [0.5, 0.4]
    points, payloads = build.grid()
    assert points.x_d.shape == (20, 3) and payloads.shape == (2, 20) and payloads[:, :4].tolist()[1] == [2, 3, 2, 3]
    assert build.first_estimate().shape == (2, 1, 3) and build.pose_sensors().shared == 1


def test_bounds_follow_each_runs_own_lengths() -> None:
    runs = [
        changed("kinematic", f"arm.lengths=[0.1,0.2,{last}]", f"bounds.lower={low}")
        for last, low in ((0.3, 0.5), (0.4, 0.6))
    ]
    bounds = Builder(stacked(runs), points=2).controller().bounds
    assert bounds is not None and bounds.least is not None and bounds.ends is not None
    torch.testing.assert_close(bounds.least[:, 0], torch.tensor([[0.05, 0.1, 0.15], [0.06, 0.12, 0.24]]).double())
    torch.testing.assert_close(bounds.ends[:, 0, -1], torch.tensor([0.6, 0.7]).double())


def test_a_gain_that_is_a_list_is_scaled_run_by_run() -> None:
    changes = [(f"adaptation.gamma=[1,2,{g}]", f"adaptation.gain_scale={s}") for g, s in ((3, 1), (5, 2))]
    law = law_of(Builder(stacked([changed("kinematic", *c) for c in changes]), points=2).controller())
    assert torch.diagonal(law.metric[:, 0], dim1=-2, dim2=-1).tolist() == [[1.0, 2.0, 3.0], [2.0, 4.0, 10.0]]


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("arm.masses=[1,1,1]", "arm.masses=[1,1,2]"),
        ("arm.axial_rigidity=3", "arm.axial_rigidity=[3,4,5]"),
        ("arm.sensors=[0.1,0.2,0.4]", "arm.sensors=[0.1,0.2,0.5]"),
        ("arm.damping_ratio=0.1", "arm.damping_ratio=0.2"),
        ("plant.arm.lengths=[0.1,0.25,0.24]", "plant.arm.lengths=[0.1,0.26,0.24]"),
        ("plant.arm.true_sensors=[0.1,0.25,0.54]", "plant.arm.true_sensors=[0.1,0.26,0.54]"),
        ("plant.places.tendons=0.001", "plant.places.tendons=0.002"),
        ("plant.events.growth=0.1", "plant.events.growth=[0,0.1,0.2]"),
        ("arm.tendon_offset=0.02", "arm.tendon_offset=0.03"),
    ],
)
def test_arms_that_differ_are_built_side_by_side(one: str, other: str) -> None:
    runs = [changed("dynamic_run_2", change) for change in (one, other)]
    assert structure(runs[0]) == structure(runs[1])
    build = Builder(stacked(runs), 2)
    plant = build.plant(build.grid()[1])
    assert plant.straight(plant.payload.shape).arm.q.shape == (2, 30, 18) and build.controller().adaptive

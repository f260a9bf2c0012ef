"""Settings become the objects they describe, and every refusal names its key."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from apcc_torch.composition.build import Builder
from apcc_torch.control.adaptation import AdaptiveLaw
from apcc_torch.errors import ApccError, ConfigError
from composed import changed, composed


def builder(*overrides: str, experiment: str = "dynamic_run_2") -> Builder:
    return Builder(changed(experiment, *overrides))


def tensors(module: torch.nn.Module) -> list[Tensor]:
    return [buffer for buffer in module.buffers() if buffer.is_floating_point()]


def test_lengths_and_first_estimate() -> None:
    build = builder("arm.lengths=[0.1,0.2]", "experiment.first_estimate=[1.1,0.95]", "arm.sensors=[0.1,0.25]")
    assert build.n_sections == 2 and build.sensors_at().tolist() == [0.1, 0.25]
    assert build.rest_lengths().tolist() == [0.1, 0.2]
    assert build.first_estimate().tolist() == pytest.approx([0.11, 0.19], abs=1e-15)
    assert builder().first_estimate().tolist() == builder().rest_lengths().tolist() == [0.105, 0.255, 0.24]


def test_the_hanging_arm_points_down_and_the_standing_one_up() -> None:
    q = torch.zeros(9, dtype=torch.float64)
    for base, z in (("hanging", -0.6), ("standing", 0.6)):
        build = builder(f"arm.base={base}")
        torch.testing.assert_close(build.backbone().tip(q, build.rest_lengths()), q.new_tensor([0.0, 0.0, z]))


def test_controller_takes_its_settings() -> None:
    build = builder(
        "adaptation.kind=apcc_torch.control.adaptation.AdaptiveLaw",
        "adaptation.gamma=[1,2,3]",
        "adaptation.gain_scale=0.5",
        "adaptation.regressor=partial",
        "adaptation.rate=0.2",
        "bounds.lower=[0.5,0.4,0.3]",
        "bounds.upper=null",
        "controller.K=[[1,0,0],[0,2,0],[0,0,4]]",
        "feedback.mode=position",
        "feedback.max_iterations=9",
        "velocity_filter.window=21",
        "velocity_filter.order=3",
        "controller.velocity=commanded",
        "controller.bend_bound=2.5",
        "controller.null_weights=[1,2,0.5]",
        "controller.null_bends=[0.1,0,-0.1]",
        "controller.null_step=0.4",
        "controller.null_speed=5.0e-3",
        "integral.gain=0.5",
        "integral.reach=2.0e-3",
        "pose_filter.angular_time=0.04",
    )
    c = build.controller()
    (law,) = c.laws
    assert type(law) is AdaptiveLaw and c.shape is None
    torch.testing.assert_close(law.metric, torch.diag(torch.tensor([0.5, 1.0, 1.5], dtype=torch.float64)))
    assert law.regressor == "partial" and law.rate == 0.2
    assert c.bounds is not None and c.bounds.largest is None and c.bounds.least is not None
    torch.testing.assert_close(c.bounds.least, torch.tensor([0.0525, 0.102, 0.072], dtype=torch.float64))
    assert (c.feedback.mode, c.feedback.max_iterations) == ("position", 9)
    assert (c.velocity_filter.window, c.velocity_filter.order, c.velocity) == (21, 3, "commanded")
    ik = c.inverse_kinematics
    assert torch.diagonal(ik.K).tolist() == [1.0, 2.0, 4.0]
    assert ik.null_weights is not None and ik.null_weights.tolist() == [1.0, 2.0, 0.5]
    assert ik.null_bends is not None and ik.null_bends.tolist() == [0.1, 0.0, -0.1]
    assert (ik.null_step, ik.null_speed) == (0.4, 5e-3)
    assert c.integral is not None and (c.integral.gain, c.integral.reach) == (0.5, 2e-3)
    assert c.pose_filter is not None
    assert (c.pose_filter.angular_time, c.pose_filter.linear_time, c.pose_filter.follow) == (0.04, 0.0, 0.8)
    late = builder("pose_filter.delay=2").controller().pose_filter
    assert late is not None and (late.delay, late.angular_time, late.linear_time) == (2, 0.0, 0.0)
    plain = builder().controller()
    assert plain.integral is None and plain.pose_filter is None
    assert c.bend_bound == 2.5 and c.routing is not None and c.routing.n_tendons == 9
    assert build.controller(adaptive=False).adaptive is False and build.controller(adaptive=True).adaptive is True


def test_grid_pairs_every_set_point_with_every_payload() -> None:
    build = builder("experiment.setpoints=[[0.1,0.2,0.3],[0.4,0.5,0.6]]", "experiment.payloads=[0,0.25,0.5]")
    points, payloads = build.grid()
    assert payloads.tolist() == [0.0, 0.25, 0.5] * 2
    assert points.x_d.tolist() == [[0.1, 0.2, 0.3]] * 3 + [[0.4, 0.5, 0.6]] * 3


def test_tuning_sees_half_of_the_set_points_and_is_judged_by_the_others() -> None:
    points = [[0.25 * k, 0.0, 0.0] for k in range(5)]
    for subset, indices in {"all": range(5), "training": (0, 2, 4), "held_out": (1, 3)}.items():
        chosen = builder(f"experiment.setpoints={points}", f"experiment.subset={subset}").setpoints()
        assert chosen[:, 0].tolist() == [0.25 * k for k in indices]


def test_plant_is_the_arm_described() -> None:
    plant = builder("arm.mass=2", "plant.pid.K_P=10", "plant.pid.force_limit=7", "plant.tendon_damping=3").plant(
        torch.tensor([0.0, 0.5], dtype=torch.float64)
    )
    d = plant.dynamics
    assert float(d.masses.sum()) == pytest.approx(2.0) and plant.backbone.n == 18
    torch.testing.assert_close(d.masses / d.lengths, torch.full_like(d.lengths, 2.0 / 0.6))
    # Series: a section of half the reference length is twice as stiff. D = 0.1 K.
    torch.testing.assert_close(d.stiffness_diagonal[2::3], 100.0 * 0.1 / d.lengths)
    torch.testing.assert_close(d.stiffness_diagonal[0::3], 0.778 * 0.1 / d.lengths)
    torch.testing.assert_close(d.damping_diagonal, 0.1 * d.stiffness_diagonal)
    assert (plant.pid.K_P, plant.pid.force_limit, plant.tendon_damping) == (10.0, 7.0, 3.0)


def test_sine_and_its_default_frequency() -> None:
    target = builder(experiment="kinematic").sine()(torch.tensor(2.5, dtype=torch.float64))
    # 0.2 pi * 2.5 s is a quarter turn: r_0 + A.
    torch.testing.assert_close(target.x_d, torch.tensor([0.5, 0.3, -0.4], dtype=torch.float64))
    assert builder("experiment.omega=2", experiment="kinematic").sine().omega == 2.0 != 0.2 * math.pi


def test_sensors_take_their_settings() -> None:
    config = composed("experiment=dynamic_run_2", "sensors=mocap", "sensors.delay=2", "sensors.dropout=0.1")
    s = Builder(config).pose_sensors()
    assert (s.position_noise, s.delay, s.dropout) == (2e-4, 2, 0.1)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_one_dtype_throughout(dtype: str) -> None:
    build = builder(f"dtype={dtype}")
    want = getattr(torch, dtype)
    plant = build.plant(build.grid()[1])
    assert {t.dtype for t in (plant.B, *tensors(plant.dynamics))} == {want}
    assert {t.dtype for t in tensors(build.controller().backbone)} == {want}
    assert build.first_estimate().dtype == build.setpoints().dtype == want


@pytest.mark.parametrize(
    ("key", "value", "method"),
    [
        ("experiment.first_estimate", "[1,1]", "first_estimate"),
        ("controller.K", "[1,2]", "controller"),
        ("controller.K", "[[1,0,0],[0,1,0]]", "controller"),
        ("controller.K", "[[1,2,0],[0,1,0],[0,0,1]]", "controller"),
        ("controller.K", "-1", "controller"),
        ("bounds.lower", "[0.1]", "controller"),
        ("bounds.lower", "5.5", "controller"),
        ("controller.null_weights", "[1,1]", "controller"),
        ("controller.null_bends", "[0]", "controller"),
        ("experiment.setpoints", "null", "setpoints"),
        ("experiment.setpoints", "[]", "setpoints"),
        ("experiment.setpoints", "[[0,0,1],[0,0]]", "setpoints"),
        ("experiment.setpoints", "[0,0,1]", "setpoints"),
        ("experiment.setpoints", "[[0,0,low]]", "setpoints"),
        ("experiment.payloads", "[]", "payloads"),
        ("experiment.payloads", "[-0.1]", "payloads"),
        ("experiment.r_0", "null", "sine"),
        ("experiment.A", "[1,2]", "sine"),
    ],
)
def test_what_does_not_fit_the_rest_is_refused_where_it_is_built(key: str, value: str, method: str) -> None:
    experiment = "kinematic" if method == "sine" else "dynamic_run_2"
    with pytest.raises(ApccError) as caught:
        getattr(builder(f"{key}={value}", experiment=experiment), method)()
    assert key.rpartition(".")[2] in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("dtype", "float16"), ("arm.base", "lying"), ("arm.lengths", "[0.1,-0.2,0.3]"), ("arm.lengths", "[]")),
        *(("arm.sensors", "[0.1,0.9]"), ("arm.sensors", "[0.3,0.1]"), ("experiment.first_estimate", "[1,1,0]")),
        *(
            ("controller.K", "true"),
            ("controller.K", "much"),
            ("controller.K", "[1,2,x]"),
            ("controller.bend_bound", "{a: 1}"),
        ),
        *(("experiment.subset", "most"), ("feedback.mode", "both")),
        *(("adaptation.refine", "0"), ("velocity_filter.window", "0"), ("controller.velocity", "guessed")),
        *(("controller.bend_bound", "-1"), ("plant.pid.K_P", "-1"), ("plant.pid.force_limit", "0")),
        *(("plant.tendon_damping", "-1"), ("arm.stiffness_rule", "cubic"), ("plant.arm.layout", "crossed")),
        ("sensors.dropout", "1"),
    ],
)
def test_what_has_no_meaning_alone_is_refused_before_anything_is_built(key: str, value: str) -> None:
    with pytest.raises(ApccError, match=key) as caught:
        changed("dynamic_run_2", f"{key}={value}")
    assert "\n" not in str(caught.value)


def test_a_missing_gpu_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match="device"):
        builder("device=cuda")

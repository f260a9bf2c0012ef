"""Settings become the objects they describe, and every refusal names its key."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from apcc_torch.composition.build import Builder
from apcc_torch.errors import ApccError, ConfigError
from composed import changed, composed


def builder(*overrides: str, experiment: str = "dynamic_run_2") -> Builder:
    return Builder(changed(experiment, *overrides))


def tensors(module: torch.nn.Module) -> list[Tensor]:
    return [buffer for buffer in module.buffers() if buffer.is_floating_point()]


def test_lengths_and_first_estimate() -> None:
    build = builder("robot.rest_lengths=[0.1,0.2]", "robot.initial_estimate=[0.11,0.19]", "robot.sensors=[0.1,0.3]")
    assert build.n_sections == 2
    assert build.rest_lengths().tolist() == [0.1, 0.2] and build.first_estimate().tolist() == [0.11, 0.19]
    assert builder("robot.initial_estimate=null").first_estimate().tolist() == [0.105, 0.255, 0.24]


def test_the_hanging_arm_points_down_and_the_standing_one_up() -> None:
    q = torch.zeros(9, dtype=torch.float64)
    for base, z in (("hanging", -0.6), ("standing", 0.6)):
        build = builder(f"robot.base={base}")
        torch.testing.assert_close(build.backbone().tip(q, build.rest_lengths()), q.new_tensor([0.0, 0.0, z]))


def test_controller_takes_its_settings() -> None:
    build = builder(
        "controller.gamma=[1,2,3]",
        "adaptation.gain_scale=0.5",
        "adaptation.regressor=partial",
        "adaptation.lower=[0.05,0.1,0.1]",
        "adaptation.upper=null",
        "adaptation.rate=0.2",
        "controller.K=[1,2,4]",
        "feedback.mode=position",
        "feedback.max_iterations=9",
        "velocity_filter.window=21",
        "velocity_filter.order=3",
        "velocity_filter.velocity=commanded",
        "controller.bend_bound=2.5",
        "controller.null_weights=[1,2,0.5]",
        "controller.null_bends=[0.1,0,-0.1]",
        "controller.null_step=0.4",
        "controller.null_speed=5.0e-3",
        "controller.integral_gain=0.5",
        "controller.integral_reach=2.0e-3",
        "pose_filter.angular_time=0.04",
    )
    c = build.controller()
    torch.testing.assert_close(c.law.gamma, torch.diag(torch.tensor([0.5, 1.0, 1.5], dtype=torch.float64)))
    assert c.law.regressor == "partial" and c.law.rate == 0.2 and c.law.upper is None
    assert c.law.lower is not None and c.law.lower.tolist() == [0.05, 0.1, 0.1]
    assert (c.feedback.mode, c.feedback.max_iterations) == ("position", 9)
    assert (c.velocity_filter.window, c.velocity_filter.order, c.velocity) == (21, 3, "commanded")
    ik = c.inverse_kinematics
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
    build = builder("experiment.setpoints=[[1,2,3],[4,5,6]]", "experiment.payloads=[0,0.25,0.5]")
    points, payloads = build.grid()
    assert payloads.tolist() == [0.0, 0.25, 0.5] * 2
    assert points.x_d.tolist() == [[1.0, 2.0, 3.0]] * 3 + [[4.0, 5.0, 6.0]] * 3


def test_tuning_sees_half_of_the_set_points_and_is_judged_by_the_others() -> None:
    points = [[float(k), 0.0, 0.0] for k in range(5)]
    for subset, indices in {"all": range(5), "training": (0, 2, 4), "held_out": (1, 3)}.items():
        chosen = builder(f"experiment.setpoints={points}", f"experiment.subset={subset}").setpoints()
        assert chosen[:, 0].tolist() == list(indices)


def test_plant_is_the_arm_described() -> None:
    plant = builder("plant.mass=2", "plant.K_P=10", "plant.force_limit=7", "plant.tendon_damping=3").plant(
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
    target = builder("experiment.omega=null", experiment="kinematic").sine()(torch.tensor(2.5, dtype=torch.float64))
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
        ("dtype", "float16", "backbone"),
        ("robot.base", "lying", "backbone"),
        ("robot.rest_lengths", "[0.1,-0.2,0.3]", "rest_lengths"),
        ("robot.initial_estimate", "[0.1,0.2]", "first_estimate"),
        ("robot.initial_estimate", "[0.1,0.2,0]", "first_estimate"),
        ("controller.gamma", "[1,2]", "controller"),
        ("controller.gamma", "much", "controller"),
        ("controller.gamma", "true", "controller"),
        ("controller.gamma", "null", "controller"),
        ("controller.K", "[1,2,x]", "controller"),
        ("controller.K", "{a: 1}", "controller"),
        ("adaptation.lower", "[0.1]", "controller"),
        ("controller.null_weights", "[1,1]", "controller"),
        ("controller.null_bends", "[0]", "controller"),
        ("experiment.setpoints", "null", "setpoints"),
        ("experiment.setpoints", "[]", "setpoints"),
        ("experiment.setpoints", "[[0,0,1],[0,0]]", "setpoints"),
        ("experiment.setpoints", "[0,0,1]", "setpoints"),
        ("experiment.setpoints", "[[0,0,low]]", "setpoints"),
        ("experiment.subset", "most", "setpoints"),
        ("experiment.payloads", "[]", "payloads"),
        ("experiment.payloads", "[-0.1]", "payloads"),
        ("experiment.r_0", "null", "sine"),
        ("experiment.A", "[1,2]", "sine"),
    ],
)
def test_a_refusal_names_the_key(key: str, value: str, method: str) -> None:
    experiment = "kinematic" if method == "sine" else "dynamic_run_2"
    with pytest.raises(ConfigError) as caught:
        getattr(builder(f"{key}={value}", experiment=experiment), method)()
    assert key in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("feedback.mode", "both"),
        ("adaptation.regressor", "total"),
        ("velocity_filter.window", "0"),
        ("velocity_filter.velocity", "guessed"),
        ("controller.bend_bound", "-1"),
        ("plant.K_P", "-1"),
        ("plant.force_limit", "0"),
        ("plant.tendon_damping", "-1"),
        ("plant.stiffness_rule", "cubic"),
        ("plant.layout", "crossed"),
        ("sensors.dropout", "1"),
    ],
)
def test_a_refusal_from_below_names_the_setting(key: str, value: str) -> None:
    build = builder(f"{key}={value}")
    payload = torch.zeros(1, dtype=torch.float64)
    makers = {"plant": lambda: build.plant(payload), "sensors": build.pose_sensors}
    make = makers.get(key.split(".")[0], build.controller)
    with pytest.raises(ApccError, match=key.rsplit(".", 1)[-1].replace("stiffness_", "")):
        make()


def test_a_missing_gpu_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match="device"):
        builder("device=cuda")

"""The law of the shape in its loop: what it remembers, what it leaves alone, and that it wins."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from apcc_torch import APCCController, Arm, Measurement, Target, compose, decouple
from apcc_torch.control.adaptation import AdaptiveLawSettings
from apcc_torch.control.composite_controller import CompositeController
from apcc_torch.control.shape_law import ShapeLaw, ShapeLawSettings
from apcc_torch.errors import ConfigError
from apcc_torch.estimation.feedback import FeedbackStatus
from apcc_torch.estimation.shape_feedback import ShapeFeedback
from apcc_torch.experiments.dynamic import curves, simulate
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.statics import equilibrium

D = torch.float64
ARM = Arm(lengths=[0.105, 0.255, 0.24])


@cache
def held(arm: Arm, payload: float, steps: int, first: float = 1.0, **changes: Any):  # type: ignore[no-untyped-def]
    """An arm at rest under tendons and a payload, watched for some steps: the controller, its state, and the truth.

    Tests only read what they are given, which several share.
    """
    pulls = torch.zeros(arm.n_tendons, dtype=D)
    pulls[[0, 4, 8]] = 6.0
    lengths = arm.refined(2)
    q = equilibrium(arm.dynamics(2), routing=arm.routing(), tensions=pulls, payload=torch.tensor(payload, dtype=D)).q
    fine = PCCBackbone(lengths.shape[-1], arm.base_rotation())
    T = fine.pose(q, lengths, *decouple(arm.sensor_places(), lengths))
    y = q @ arm.routing().matrix(lengths)
    controller = APCCController.for_arm(arm, **changes)
    state = controller.initial_state(torch.zeros(9, dtype=D), first * arm.rest_lengths())
    target = Target(T[-1, :3, 3], torch.zeros(3, dtype=D))
    for k in range(steps):
        time = torch.tensor(0.02 * (k + 1), dtype=D)
        state, command = controller(state, Measurement(T, time, tendons=y), target)
    return controller, state, command, q, y


@pytest.mark.parametrize("first", [0.8, 1.0, 1.2])
def test_psi_falls_to_nothing_and_the_shape_is_followed_from_any_start(first: float) -> None:
    controller, state, _, q, _ = held(ARM, 0.4, 200, first)
    assert state.q_bar[2::3].abs().max() < 1e-4
    fine = PCCBackbone(6, ARM.base_rotation()).points(q, ARM.refined(2), 31)
    off = (controller.backbone.points(state.q_bar, state.pi_hat, 31) - fine).norm(dim=-1)
    assert off.mean() < 3e-3
    assert state.shape is not None
    assert abs(float(state.shape.shape.load) - 0.4) < 0.05


def test_without_a_time_constant_its_estimator_works_alone() -> None:
    law, alone = (held(ARM, 0.4, 100, **changes)[1] for changes in ({}, {"time_constant": None}))
    assert torch.equal(alone.pi_hat, ARM.rest_lengths())
    assert (law.pi_hat - ARM.rest_lengths()).abs().max() > 1e-2
    for ours, want in zip(alone.shape.shape, law.shape.shape, strict=True):
        torch.testing.assert_close(ours, want, rtol=0, atol=1e-9)
    torch.testing.assert_close(alone.shape.lengths, law.shape.lengths, rtol=0, atol=1e-6)
    assert alone.q_bar[2::3].norm() > 10.0 * law.q_bar[2::3].norm(), "what the law makes rest length is elongation here"


def test_a_row_of_a_batch_is_the_run_alone() -> None:
    words = ["experiment=dynamic_run_2_tuned", "experiment.setpoints=[[0.325,0.15,-0.275]]", "controller.rate=25"]
    words += ["experiment.duration=0.4", "plant.settle=0.2", "plant.substeps=4", "progress=false"]
    both, alone = (simulate(compose(*words, f"experiment.payloads={p}").settings).log for p in ("[0,0.5]", "[0.5]"))
    for name in ("x", "q_true", "q_bar", "q_d", "pi_hat", "y", "y_d"):
        row, want = getattr(both, name)[:, 1], getattr(alone, name)[:, 0]
        torch.testing.assert_close(row, want, rtol=0, atol=1e-9, msg=lambda m, name=name: f"{name}: {m}")


def test_the_tendons_are_told_what_the_arm_s_own_sections_do() -> None:
    controller, state, _, _, y = held(ARM, 0.4, 200, 1.0)
    assert state.shape is not None
    assert controller.shape is not None
    told = controller.tendons(controller.shape.strain(state.shape), state.pi_hat)
    assert told is not None
    assert (told - y).abs().max() < 1e-3


def test_a_gap_in_the_sensors_holds_the_rest_lengths_and_q_d() -> None:
    controller, state, _, _, y = held(ARM, 0.4, 100)
    T = torch.full((3, 4, 4), torch.nan, dtype=D)
    target = Target(torch.zeros(3, dtype=D), torch.zeros(3, dtype=D))
    later, _ = controller(state, Measurement(T, state.time + 0.02, tendons=y), target)
    assert torch.equal(later.pi_hat, state.pi_hat)
    assert torch.equal(later.q_d, state.q_d)
    assert bool(torch.isfinite(later.q_bar).all())


def test_the_standard_controller_has_algorithm_2_alone() -> None:
    controller = APCCController.for_arm(ARM, adaptive=False)
    assert controller.shape is None
    assert controller.initial_state(torch.zeros(9, dtype=D), ARM.rest_lengths()).shape is None


def test_over_a_long_period_no_more_than_the_elongation_is_taken_over() -> None:
    controller, state, _, _, _ = held(ARM, 0.4, 3)
    law = ShapeLaw(ARM.rest_lengths(), controller.feedback, ShapeLawSettings(time_constant=0.1))
    T = controller.backbone.pose(state.q_bar, state.pi_hat, *decouple(ARM.sensor_places(), state.pi_hat))
    step = SimpleNamespace(
        q_bar=state.q_bar,
        backbone=controller.backbone,
        dt=torch.tensor(0.5, dtype=D),
        inference=controller.feedback.infer(state.q_bar, state.pi_hat, T),
    )
    speed, _ = law.speed(step, None)  # type: ignore[arg-type]
    assert torch.allclose(0.5 * speed, state.q_bar[2::3])


def test_in_contact_the_rest_lengths_rest_and_the_status_says_why() -> None:
    controller, state, _, q, y = held(ARM, 0.4, 100, time_constant=0.5)
    lengths = ARM.refined(2)
    T = PCCBackbone(6, ARM.base_rotation()).pose(q, lengths, *decouple(ARM.sensor_places(), lengths))
    # What pushes at the middle moves it by 10 cm against both its neighbours.
    T[1, 0, 3] += 0.1
    target = Target(T[-1, :3, 3], torch.zeros(3, dtype=D))
    for _ in range(400):
        before = state.pi_hat
        state, command = controller(state, Measurement(T, state.time + 0.02, tendons=y), target)
    assert int(command.feedback.status) == FeedbackStatus.MISFIT
    assert torch.equal(state.pi_hat, before)
    assert state.q_bar[2::3].abs().max() > 1e-3, "there is something to take over"


def test_what_cannot_run_beside_it_is_refused() -> None:
    with pytest.raises(ConfigError, match="needs q_bar of algorithm 2"):
        CompositeController(APCCController.for_arm(ARM))
    eq_15 = APCCController.for_arm(ARM, adaptation=AdaptiveLawSettings())
    shape = ShapeFeedback.on(ARM, eq_15.backbone, ShapeLawSettings())
    with pytest.raises(ConfigError, match="beside a law of the shape"):
        APCCController(
            eq_15.backbone,
            eq_15.feedback,
            eq_15.velocity_filter,
            eq_15.inverse_kinematics,
            list(eq_15.laws),
            shape=shape,
        )


ARMS = {
    "reversed, a sensor at the tip alone": ["arm.lengths=[0.24,0.255,0.105]", "arm.sensors=[0.6]"],
    "softer than believed": ["plant.arm.bending_stiffness=0.545", "plant.arm.axial_stiffness=70"],
}


@pytest.mark.parametrize("name", ARMS)
def test_on_any_arm_it_is_nearer_than_the_nominal_lengths(name: str) -> None:
    """Two held-out set-points of section V-B with 0.5 kg, once the arm is there."""
    changes = ["experiment=dynamic_run_2_tuned", "controller.rate=20", "plant.substeps=5", "experiment.duration=7"]
    changes += ["experiment.payloads=[0.5]", "experiment.setpoints=[[0.215,0.03,-0.515],[0.275,-0.235,-0.42]]"]
    changes += ["plant.settle=1"]  # it swings on for longer than that, and for less than the seven seconds
    settings = compose(*changes, "adaptation=shape", "progress=false", "figures=false", *ARMS[name]).settings
    outcomes = [simulate(settings, adaptive) for adaptive in (False, True)]
    standard, law = (curves(each.log, each.arms) for each in outcomes)
    end = slice(-20, None)
    assert law.shape_error[end].mean() < 0.85 * standard.shape_error[end].mean()
    assert law.psi[end].mean() < standard.psi[end].mean()
    assert law.e[-1].max() < 0.015


def test_a_sensor_is_judged_where_it_is_along_the_arm() -> None:
    controller, state, command, q, _ = held(ARM, 0.4, 200, 1.0)
    assert state.shape is not None
    assert controller.shape is not None
    X, pieces = ARM.sensor_places(), ARM.refined(2)
    fine = PCCBackbone(6, ARM.base_rotation())
    sensors = fine.pose(q, pieces, *decouple(X, pieces))[..., :3, 3]
    # The same places by length along either curve, finely sampled.
    along = fine.section_lengths(q, pieces)
    share = torch.stack([along[: 2 * (i + 1)].sum() / along.sum() for i in range(3)])
    model = controller.backbone.curve(state.q_bar.unsqueeze(0), state.pi_hat.unsqueeze(0), share)[0].mT
    assert torch.allclose(command.feedback.linear_error, (model - sensors).norm(dim=-1), atol=2e-4)

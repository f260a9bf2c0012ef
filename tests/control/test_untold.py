"""Rest lengths rest where nothing tells them, and the status says why: few sensors, none, unknown tendons, gaps."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from apcc_torch import APCCController, Arm, ControllerState, FeedbackStatus, Measurement, Target, decouple
from apcc_torch.estimation.loaded_shape import LoadedShape
from apcc_torch.estimation.tension_prior import UNTOLD
from apcc_torch.lie import so3
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.statics import equilibrium

D = torch.float64
LENGTHS = [0.105, 0.255, 0.24]
S = FeedbackStatus


class Held(NamedTuple):
    """An arm at rest: a controller and its state, the sensors' poses (k, 4, 4), the tendons' lengths (n_a,)."""

    controller: APCCController
    state: ControllerState
    T: Tensor
    y: Tensor

    def watched(self, steps: int, mask: Tensor, y: Tensor) -> tuple[Held, Tensor, Tensor]:
        """After some steps: the arm, the status (...) of the last one, and by how much that moved pi_hat (...), m."""
        before, state, status = self.state.pi_hat, self.state, torch.empty(0)
        target = Target(self.T[-1, :3, 3], torch.zeros(3, dtype=D))
        for _ in range(steps):
            before = state.pi_hat
            seen = Measurement(self.T, state.time + 0.02, mask=mask, tendons=y)
            state, command = self.controller(state, seen, target)
            status = command.feedback.status
        return self._replace(state=state), status, (state.pi_hat - before).abs().amax(-1)


def held(sensors: list[float], rows: int = 1) -> Held:
    """An arm of three sections that hangs with 0.4 kg under three of its tendons."""
    arm = Arm(lengths=LENGTHS, sensors=sensors)
    pulls = torch.zeros(arm.n_tendons, dtype=D)
    pulls[[0, 4, 8]] = 6.0
    lengths, payload = arm.refined(2), torch.tensor(0.4, dtype=D)
    q = equilibrium(arm.dynamics(2), routing=arm.routing(), tensions=pulls, payload=payload).q
    T = PCCBackbone(6, arm.base_rotation()).pose(q, lengths, *decouple(arm.sensor_places(), lengths))
    controller = APCCController.for_arm(arm)
    start = torch.zeros(rows, dtype=D)
    state = controller.initial_state(torch.zeros(rows, 9, dtype=D), arm.rest_lengths(), start)
    return Held(controller, state, T, q @ arm.routing().matrix(lengths))


def deviations(shape: LoadedShape, state: ControllerState, mask: Tensor, tendons: bool) -> tuple[Tensor, Tensor]:
    """What is known of the strains (n,) over what is known of each from the others, and the deviations themselves.

    Information is added up from differences of what sensors and tendons would say, and conditional variances are taken
    from the prior's covariance.
    """
    assert state.shape is not None
    of = state.shape.shape
    n, own = of.sections.shape[-1], shape.dynamics.lengths
    place = decouple(shape.abscissae, own)
    R = shape.backbone.pose(shape.configuration(of), own, *place)[..., :3, :3]

    def said(change: Tensor) -> Tensor:
        moved = of._replace(sections=of.sections + change[:-1], load=of.load + change[-1])
        q = shape.configuration(moved)
        T = shape.backbone.pose(q, own, *place)
        turned = so3.log(R.mT @ T[..., :3, :3])
        rows = torch.cat((T[..., :3, 3] / shape.position_noise, turned / shape.angular_noise), dim=-1)[mask]
        return torch.cat((rows.flatten(), (q @ shape.B / shape.tendon_noise)[: shape.B.shape[-1] if tendons else 0]))

    step = 1e-6 * torch.eye(n + 1, dtype=D)
    J = torch.stack([(said(each) - said(-each)) / 2e-6 for each in step], dim=-1)
    unmeasured = torch.tensor([[shape.bend] * 2 + [shape.elongation * L] for L in LENGTHS], dtype=D).flatten()
    prior = torch.linalg.inv(shape.information) * unmeasured * unmeasured.unsqueeze(-1)
    H = J.mT @ J
    H[:-1, :-1] += torch.linalg.inv(prior)
    H[-1, -1] += 1.0 / (0.5 * shape.dynamics.masses.sum()) ** 2
    variance = torch.linalg.inv(H).diagonal()[:-1]
    alone = []
    for i in range(n):
        others = [j for j in range(n) if j != i]
        gain = torch.linalg.solve(prior[others][:, others], prior[others][:, i])
        alone.append(prior[i, i] - prior[i, others] @ gain)
    return (variance / torch.stack(alone)).sqrt(), variance.sqrt()


def test_they_rest_wherever_a_section_is_told_by_what_was_believed_alone() -> None:
    """Every choice of four sensors, two of them in one section, with and without the tendons' lengths."""
    sensors = [0.05, 0.1, 0.36, 0.6]
    masks = torch.tensor(list(itertools.product([False, True], repeat=4))).repeat(2, 1)
    tendons = torch.arange(32) < 16
    arm = held(sensors, 32)
    y = torch.where(tendons.unsqueeze(-1), arm.y, torch.nan)
    after, status, moved = arm.watched(30, masks, y)
    shape = after.controller.shape
    assert shape is not None and after.state.shape is not None
    known = after.state.shape.shape.deviation[..., :-1]
    judged = 0
    for i in range(32):
        if not masks[i].any():
            assert (int(status[i]), float(moved[i])) == (S.INVALID, 0.0)
            continue
        one = after.state._replace(shape=after.state.shape._replace(shape=_row(after.state.shape.shape, i)))
        ratio, deviation = deviations(shape.shape, one, masks[i], bool(tendons[i]))
        # A load that was felt longer is known better than the oracle has it, which knows one step alone.
        assert (known[i] < 1.02 * deviation).all() and (known[i] > 0.5 * deviation).all(), masks[i]
        if 0.8 * UNTOLD < float(ratio.max()) < 1.2 * UNTOLD:
            continue
        judged += 1
        assert (ratio.max() > UNTOLD) == (status[i] == S.UNTOLD), (masks[i], ratio)
        assert (status[i] == S.UNTOLD) == (moved[i] == 0.0), (masks[i], moved[i])
    assert judged > 24
    assert not (status[:16] == S.UNTOLD).any(), "tendons of known length tell of every section"
    assert (status[16:] == S.UNTOLD).sum() > 8


def _row(state, i: int):  # type: ignore[no-untyped-def]
    return type(state)(*(part[i] for part in state))


@pytest.mark.parametrize("known", [True, False])
def test_two_sensors_in_one_section_and_none_in_the_others(known: bool) -> None:
    arm = held([0.05, 0.1])
    both = torch.tensor([True, True])
    after, status, _ = arm.watched(40, both, arm.y if known else torch.full_like(arm.y, torch.nan))
    rested = torch.equal(after.state.pi_hat, arm.state.pi_hat)
    assert (int(status) == S.UNTOLD, rested) == (not known, not known)


def test_they_rest_through_a_gap_and_go_on_after_it() -> None:
    arm = held(sensors=list(torch.tensor(LENGTHS).cumsum(0).tolist()))
    every, unknown = torch.ones(3, dtype=torch.bool), torch.full_like(arm.y, torch.nan)
    first, status, moved = arm.watched(15, every, unknown)
    assert status != S.UNTOLD and moved > 0.0
    tip_lost = torch.tensor([True, True, False])
    gap, status, _ = first.watched(10, tip_lost, unknown)
    assert status == S.UNTOLD and torch.equal(gap.state.pi_hat, first.state.pi_hat)
    _, status, moved = gap.watched(3, every, unknown)
    assert status != S.UNTOLD and moved > 0.0


def test_of_an_arm_that_stands_still_they_come_to_rest() -> None:
    arm = held(sensors=list(torch.tensor(LENGTHS).cumsum(0).tolist()))
    after, _, moved = arm.watched(120, torch.ones(3, dtype=torch.bool), arm.y)
    assert moved < 1e-5
    assert (after.state.pi_hat - arm.state.pi_hat).abs().max() > 1e-2

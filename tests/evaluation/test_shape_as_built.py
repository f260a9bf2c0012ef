"""The law's estimator on recordings, on one that a finer arm under weight, load and tensions made."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from apcc_torch import Arm, PCCBackbone, decouple
from apcc_torch.estimation.tension_prior import tension_scatter
from apcc_torch.evaluation.frames import Frames, Past
from apcc_torch.evaluation.method import Known
from apcc_torch.evaluation.sections_methods import ThroughSensors
from apcc_torch.evaluation.shape_as_built import ShapeAsBuilt
from apcc_torch.evaluation.tasks import Task
from apcc_torch.identification.arm_blocks import Spreads, arm_parameters
from apcc_torch.identification.fit import FitSettings
from apcc_torch.identification.tendon_arm import Drive
from apcc_torch.model.arm_placement import Placement
from apcc_torch.model.statics import equilibrium

D = torch.float64
# Hangs along y of a recording whose y axis points down, off its origin.
ARM = Arm(
    lengths=[0.15, 0.2, 0.15],
    mass=0.3,
    axial_stiffness=5000.0,
    placement=Placement(position=(0.1, 0.2, -0.3), rotation=(-1.5707963267948966, 0.0, 0.0), gravity=(0.0, 9.81, 0.0)),
)


def known(arm: Arm) -> Known:
    blocks = arm_parameters(arm, Spreads(friction=0.0))
    return Known(arm, blocks, blocks, None, FitSettings(), 10, 0, lambda line: None)


def recording(count: int = 12) -> Frames:
    """Bodies at the sections' ends of the arm in two pieces a section, at rest under what its motors hold."""
    draw = torch.Generator().manual_seed(3)
    pulls = 3.0 * tension_scatter(ARM) * torch.rand(count, ARM.n_tendons, generator=draw, dtype=D)
    payload = torch.linspace(0.0, 0.2, count, dtype=D)
    solved = equilibrium(ARM.dynamics(2), routing=ARM.routing(), tensions=pulls, payload=payload)
    assert bool(solved.converged.all())
    lengths = ARM.refined(2)
    T = PCCBackbone(6, ARM.base_rotation()).pose(solved.q, lengths, *decouple(ARM.sensor_places(), lengths))
    upright, base = ARM.placement.upright(), torch.tensor(ARM.placement.position, dtype=D)
    none = torch.zeros(count, dtype=D)
    drive = Drive(none.view(-1, 1, 1).expand(count, 1, 9), none.view(-1, 1), none.view(-1, 1).expand(count, 9))
    p, R = T[..., :3, 3] @ upright + base, upright.mT @ T[..., :3, :3]
    past = Past(torch.full((count, 2, 3, 3), torch.nan, dtype=D), drive)
    return Frames(torch.arange(count, dtype=D), drive, p, R, none.long(), past)


def off(found: Tensor, frames: Frames, body: int) -> float:
    return float((found - frames.positions)[:, body].norm(dim=-1).square().mean().sqrt())


@pytest.mark.parametrize("turned", [False, True], ids=["positions", "orientations"])
def test_what_is_shown_is_met_and_what_is_hidden_is_nearer_than_on_arcs(turned: bool) -> None:
    frames, ours, arcs = recording(), ShapeAsBuilt(known(ARM)), ThroughSensors(known(ARM))
    ours.fit(frames)
    arcs.fit(frames)
    everything = Task((0, 1, 2), False, turned)
    whole = ours.predict(frames.showing(everything), everything)
    assert max(off(whole, frames, body) for body in range(3)) < 3e-4
    for hidden, shown in ((0, (1, 2)), (1, (0, 2))):
        task = Task(shown, False, turned)
        seen = frames.showing(task)
        assert off(ours.predict(seen, task), frames, hidden) < off(arcs.predict(seen, task), frames, hidden)


def test_it_takes_part_where_bodies_and_no_motors_are_shown() -> None:
    method = ShapeAsBuilt(known(ARM))
    assert (
        method.answers(Task((1,), False))
        and not method.answers(Task((1,), True))
        and not method.answers(Task((), True))
    )

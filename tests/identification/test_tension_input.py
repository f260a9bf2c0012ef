"""Inputs that set tensions: against equilibria under told tensions, which are other code, and what they reveal."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from apcc_torch.errors import ConfigError
from apcc_torch.identification.arm_blocks import Spreads, arm_parameters
from apcc_torch.identification.fit import fit
from apcc_torch.identification.intervals import unknown_directions
from apcc_torch.identification.parameters import Parameters
from apcc_torch.identification.tendon_arm import Drive, TendonArm
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.arm import Arm
from apcc_torch.model.statics import equilibrium
from apcc_torch.settings import names
from identified_arms import KEYS, SMALL, random_drive

ARM = SMALL.changed(actuation=SMALL.actuation.changed(sets="tension", pulls=2.0, pre_stretch=0.0))


def blocks(**spreads: float) -> Parameters:
    return arm_parameters(ARM, Spreads(**(dict.fromkeys(names(Spreads), 0.0) | spreads)))


def at_rest(drive: Drive) -> Tensor:
    """Bodies (N, 2, 3) of the arm under its motors' tensions, m; one that is told to push pulls nothing."""
    tensions = (2.0 * drive.history[:, 0]).clamp(min=0.0)
    found = equilibrium(ARM.dynamics(), routing=ARM.routing(), tensions=tensions)
    assert bool(found.converged.all())
    lengths = ARM.rest_lengths()
    places = ARM.backbone().pose(found.q, lengths, *decouple(ARM.sensor_places(), lengths))
    return places[..., :3, 3] @ ARM.placement.upright()


def test_it_comes_to_rest_where_told_tensions_hold_it() -> None:
    drive, told = random_drive(20, seed=1, reach=0.2), blocks()
    found = TendonArm(ARM).predict(drive, told.values(told.nominal()))
    torch.testing.assert_close(found, at_rest(drive), rtol=0.0, atol=2e-7)  # the corner where tendons go slack is round
    assert float((found - found.mean(0)).norm(dim=-1).max()) > 0.01


def test_told_tensions_tell_the_stiffness_itself() -> None:
    """With lengths for inputs, stiffness is known by its ratio to others' alone: tests of the fit have that."""
    told = blocks(bending_rigidity=0.5, axial_rigidity=0.5, offset=0.1)
    drive = random_drive(60, seed=2, reach=0.2)
    noise = 1e-4 * torch.randn(60, 2, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    begun = torch.full((len(told),), 0.6, dtype=torch.float64)
    found = fit(TendonArm(ARM), told, drive, at_rest(drive) + noise, z=begun)
    EI = told.values(found.z)["bending_rigidity"]
    torch.testing.assert_close(EI, torch.full((2,), KEYS["bending_rigidity"], dtype=torch.float64), rtol=0.05, atol=0.0)
    assert not [d for d in unknown_directions(told, found) if "bending_rigidity" in d.parts[0][0]]


def test_lengths_are_refused_where_tensions_are_told() -> None:
    drive, told = random_drive(2, seed=1), blocks()
    with pytest.raises(ConfigError, match=r"actuation\.sets is tension"):
        TendonArm(ARM, kinematic=True).predict(drive, told.values(told.nominal()))
    with pytest.raises(ConfigError, match=r"actuation\.sets is tension"):
        ARM.actuation.pulled(drive.history[:, 0], 6)
    with pytest.raises(ConfigError, match="sets"):
        Arm(lengths=[0.1], actuation=SMALL.actuation.changed(sets="torque"))

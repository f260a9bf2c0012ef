"""The kinematic model of a configuration: the shipped ones, one of a user's own, and refusals that name their key."""

from __future__ import annotations

import pytest
import torch

from apcc_torch.composition.build import Builder
from apcc_torch.composition.kinematic_model import kinematic_model
from apcc_torch.errors import ConfigError
from apcc_torch.model.affine import AffineBackbone
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.constant_strain import ConstantStrainBackbone
from composed import composed

BASE = torch.eye(3, dtype=torch.float64)


@pytest.mark.parametrize(
    ("name", "kind", "n"),
    [("pcc", PCCBackbone, 9), ("constant_strain", ConstantStrainBackbone, 12), ("affine", AffineBackbone, 15)],
)
def test_the_shipped_models_reach_the_whole_controller(name: str, kind: type, n: int) -> None:
    build = Builder(composed("experiment=dynamic_run_2", f"model={name}"))
    c = build.controller()
    assert type(c.backbone) is kind and c.backbone.n == n
    assert c.feedback.backbone is c.backbone and c.inverse_kinematics.coordinates == c.backbone.coordinates


def test_their_settings() -> None:
    affine = Builder(composed("experiment=kinematic", "model=affine", "model.settings.rods=2")).backbone()
    assert isinstance(affine, AffineBackbone) and affine.rods == 2
    strains = "model.settings.strains=[[elongation],[bend_x,elongation],[elongation]]"
    mixed = Builder(composed("experiment=kinematic", "model=constant_strain", strains)).backbone()
    assert mixed.coordinates.names(4) == ["elongation 1", "bend x 2", "elongation 2", "elongation 3"]


class OneRod(AffineBackbone):
    """A model that the package does not know."""


def test_a_model_of_ones_own() -> None:
    assert type(kinematic_model(f"{__name__}.OneRod", 2, BASE, {"rods": 1})) is OneRod


@pytest.mark.parametrize(
    ("kind", "settings", "message"),
    [
        ("affine", {}, "model.kind must be a class, as package.module.Class"),
        ("apcc_torch.model.nothing.Model", {}, "No module named"),
        ("apcc_torch.model.affine.Nothing", {}, "has no attribute"),
        ("torch.nn.Linear", {}, "model.kind must be a KinematicModel"),
        ("apcc_torch.model.affine.AffineBackbone", {"steps": 3}, "model.settings do not fit .*steps"),
    ],
)
def test_bad_models_are_named(kind: str, settings: dict[str, int], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        kinematic_model(kind, 2, BASE, settings)

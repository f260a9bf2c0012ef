"""The kinematic model of a configuration: the shipped ones, one of a user's own, and refusals that name their key."""

from __future__ import annotations

import sys

import pytest
import torch

from apcc_torch.composition.build import Builder
from apcc_torch.errors import ConfigError
from apcc_torch.model.affine import AffineBackbone
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.constant_strain import ConstantStrainBackbone
from composed import composed


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
    affine = Builder(composed("experiment=kinematic", "model=affine", "model.rods=2")).backbone()
    assert isinstance(affine, AffineBackbone) and affine.rods == 2
    strains = "model.strains=[[elongation],[bend_x,elongation],[elongation]]"
    mixed = Builder(composed("experiment=kinematic", "model=constant_strain", strains)).backbone()
    assert mixed.coordinates.names(4) == ["elongation 1", "bend x 2", "elongation 2", "elongation 3"]


class OneRod(AffineBackbone):
    """A model that the package does not know."""


def test_a_model_of_ones_own() -> None:
    own = f"{OneRod.__module__}.OneRod"
    assert sys.modules[OneRod.__module__].OneRod is OneRod
    backbone = Builder(composed("experiment=kinematic", "model=custom", f"model.kind={own}", "model.rods=1")).backbone()
    assert type(backbone) is OneRod and backbone.rods == 1
    torch.testing.assert_close(backbone.base_rotation, torch.diag(torch.tensor([1.0, -1.0, -1.0]).double()))


@pytest.mark.parametrize(
    ("kind", "changes", "message"),
    [
        ("affine", (), "model.kind must be a class, as package.module.Class"),
        ("apcc_torch.model.nothing.Model", (), "No module named"),
        ("apcc_torch.model.affine.Nothing", (), "has no attribute"),
        ("torch.nn.Linear", (), "model.kind must be a KinematicModel"),
        ("apcc_torch.model.affine.AffineBackbone", ("model.rod=3",), "model.rod is no setting; did you mean rods"),
        ("apcc_torch.model.backbone.PCCBackbone", ("model.rods=3",), "model.rods is no setting; it has none"),
    ],
)
def test_bad_models_are_named(kind: str, changes: tuple[str, ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        composed("experiment=kinematic", "model=custom", f"model.kind={kind}", *changes)


def test_a_class_of_ones_own_must_be_named() -> None:
    with pytest.raises(ConfigError, match=r"model\.kind must be a class, .*got 'package\.module\.Class'"):
        composed("experiment=kinematic", "model=custom")

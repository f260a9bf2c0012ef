"""The most probable shape against central differences, closed forms of linear beliefs, and known shapes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from apcc_torch.estimation.rest_calibration import RestCalibration
from apcc_torch.evaluation.sections_methods import wide
from apcc_torch.evaluation.shape_posterior import Gaussian, Sections, information_root, shrunk_covariance
from apcc_torch.identification.fit import correlation_length
from apcc_torch.lie import so3
from apcc_torch.model.affine import AffineBackbone
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.kinematic_model import KinematicModel
from laws import generator, normal

D = torch.float64


def sections(model: KinematicModel) -> Sections:
    """Three bodies whose markers sit askew, 10 mm beside the axis."""
    rng = generator(1)
    turns = so3.exp(0.4 * normal((4, 3), D, rng))
    places = torch.tensor([[0.0, 0.0, 0.1], [0.0, 0.0, 0.2], [0.0, 0.0, 0.3]], dtype=D)
    beside = 0.01 * normal((3, 3), D, rng) * torch.tensor([1.0, 1.0, 0.0], dtype=D)
    base = torch.tensor([0.3, -0.2, 0.5], dtype=D)
    calibration = RestCalibration.at_rest(
        ("1", "2", "3"), base, turns[0], base + (places + beside) @ turns[0].mT, turns[1:]
    )
    return Sections(model, calibration.rest_lengths, calibration)


def shapes(model: KinematicModel, count: int) -> Tensor:
    scale = model.coordinates.per_unit(0.4, 0.005, model.n, torch.zeros(model.n, dtype=D))
    return scale * normal((count, model.n), D, generator(2))


@pytest.mark.parametrize("model", [PCCBackbone(3), AffineBackbone(3)])
def test_places_and_slopes_are_those_of_the_calibrated_poses(model: KinematicModel) -> None:
    arm = sections(model)
    q = shapes(model, 4)
    _, rotations, slope = arm.bodies(q)
    base = arm.calibration
    # A marker and its axes in the recording are where the calibration takes the model's frames back from.
    turned = base.base_rotation @ rotations @ base.mount_rotation.mT
    poses = base.poses(arm.positions(q), turned)
    ends = model.pose(q, arm.lengths.expand(4, 3), torch.ones(3, dtype=D), torch.arange(3))
    torch.testing.assert_close(poses, ends, rtol=1e-9, atol=1e-11)
    steps = 1e-6 * torch.eye(model.n, dtype=D)
    ahead, behind = (arm.bodies((q.unsqueeze(1) + s * steps).flatten(0, 1))[0] for s in (1.0, -1.0))
    moved = ((ahead - behind) / 2e-6).unflatten(0, (4, model.n)).movedim(1, -1)
    torch.testing.assert_close(slope[..., 3:, :], moved, rtol=1e-6, atol=1e-9)
    step = 1e-6 * normal((model.n,), D, generator(5))
    about = so3.log(rotations.mT @ arm.bodies(q + step)[1])
    torch.testing.assert_close(slope[..., :3, :] @ step, about, rtol=1e-4, atol=1e-11)


def test_shapes_that_are_seen_whole_are_found() -> None:
    arm = sections(PCCBackbone(3))
    q = shapes(arm.model, 6)
    places, turns = arm.positions(q), arm.bodies(q)[1]
    base = arm.calibration
    seen = base.base_rotation @ turns @ base.mount_rotation.mT
    unseen = torch.full_like(seen, torch.nan)
    for rotations in (unseen, seen):
        found = arm.most_probable(places, rotations, [wide(arm.model)])
        # What is left is what the prior pulls: a hundredth of the noise.
        torch.testing.assert_close(found, q, rtol=0, atol=1e-3)
        torch.testing.assert_close(arm.positions(found), places, rtol=0, atol=1e-5)
    alone = torch.cat([arm.most_probable(places[i : i + 1], unseen[:1], [wide(arm.model)]) for i in range(6)])
    torch.testing.assert_close(arm.most_probable(places, unseen, [wide(arm.model)]), alone, rtol=1e-9, atol=1e-9)


def test_unseen_bodies_and_other_moments_change_nothing() -> None:
    arm = sections(PCCBackbone(3))
    places = arm.positions(shapes(arm.model, 5))
    hidden = places.clone()
    hidden[:, 1] = torch.nan
    unseen = torch.full((5, 3, 3, 3), torch.nan, dtype=D)
    found = arm.most_probable(hidden, unseen, [wide(arm.model)])
    assert bool(found.isfinite().all())
    other = hidden.clone()
    other[3:] = torch.nan
    less = arm.most_probable(other, unseen, [wide(arm.model)])
    torch.testing.assert_close(less[:3], found[:3], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(less[3:], torch.zeros(2, 9, dtype=D), rtol=0, atol=1e-12)  # the prior's mean


def test_linear_beliefs_alone_have_a_closed_form() -> None:
    arm = sections(PCCBackbone(3))
    rng = generator(7)
    samples = normal((60, 9), D, rng) * wide(arm.model).root.diagonal().reciprocal() * 0.2
    A, inputs = normal((4, 9), D, rng), normal((60, 4), D, rng)
    values = samples @ A.mT + 0.5 + 0.1 * inputs
    prior, rows = Gaussian.of(samples, 1e-6), Gaussian.regressed(samples, values, 1e-6)
    ones = np.column_stack([samples.numpy(), np.ones(60)])
    want, *_ = np.linalg.lstsq(ones, values.numpy(), rcond=None)
    np.testing.assert_allclose(np.vstack([rows.matrix.mT.numpy(), rows.value.numpy()]), want, rtol=1e-8, atol=1e-10)
    residual = values.numpy() - ones @ want
    S = shrunk_covariance(torch.from_numpy(residual)).numpy()
    np.testing.assert_allclose((rows.root.mT @ rows.root).numpy(), np.linalg.inv(S), rtol=1e-5)

    unseen = torch.full((60, 3, 3), torch.nan, dtype=D)
    askew = torch.full((60, 3, 3, 3), torch.nan, dtype=D)
    told = rows._replace(value=values - rows.value)
    found = arm.most_probable(unseen, askew, [prior, told]).numpy()
    P = np.cov(samples.numpy().T, bias=True)
    B = rows.matrix.numpy()
    mean = samples.numpy().mean(0)
    gain = P @ B.T @ np.linalg.inv(B @ P @ B.T + S)
    innovation = values.numpy() - rows.value.numpy() - mean @ B.T
    np.testing.assert_allclose(found, mean + innovation @ gain.T, rtol=1e-4, atol=1e-7)


def test_a_root_is_of_the_information() -> None:
    scatter = torch.tensor([[1.0, 0.3, 0.0], [0.3, 4.0, 0.0], [0.0, 0.0, 0.0]], dtype=D)
    root = information_root(scatter, least=0.5)
    eye = torch.eye(3, dtype=D)
    torch.testing.assert_close(root.mT @ root @ (scatter + 0.25 * eye), eye, rtol=1e-9, atol=1e-9)


def test_correlations_by_chance_shrink_and_real_ones_stay() -> None:
    """Schaefer and Strimmer's share, by their own sums over products of standard scores, of independent samples."""
    rng = generator(9)
    mixed = normal((40, 4), D, rng) @ (torch.eye(4, dtype=D) + 0.5 * normal((4, 4), D, rng))
    samples = mixed * torch.tensor([1.0, 2.0, 3.0, 0.1], dtype=D)
    found, plain = shrunk_covariance(samples).numpy(), (samples.mT @ samples / 40).numpy()
    np.testing.assert_allclose(found.diagonal(), plain.diagonal(), rtol=1e-12)
    scale = np.sqrt(plain.diagonal())
    apart = ~np.eye(4, dtype=bool)
    r = (plain / scale / scale[:, None])[apart]
    kept = (found / plain)[apart]
    np.testing.assert_allclose(kept, kept[0], rtol=1e-9)  # one share of them all
    length = correlation_length(samples / torch.from_numpy(scale))
    np.testing.assert_allclose(kept[0], 1.0 - ((1.0 - r**2) ** 2).sum() * length / 40 / (r**2).sum(), rtol=1e-9)

    # Numbers that know nothing of each other: what correlates by chance all but goes; repeated samples say no more.
    left = before = 0.0
    for n in (30, 40, 50):
        x = normal((n, 6), D, generator(n))
        left += float(shrunk_covariance(x).triu(1).abs().sum())
        before += float((x.mT @ x / n).triu(1).abs().sum())
    assert left < 0.4 * before
    often = shrunk_covariance(samples.repeat_interleave(5, 0))
    assert bool((often[apart].abs() <= torch.from_numpy(found)[apart].abs() + 1e-9).all())
    # What goes together in truth stays.
    same = normal((40, 1), D, rng) * torch.tensor([1.0, 2.0], dtype=D)
    torch.testing.assert_close(shrunk_covariance(same), same.mT @ same / 40, rtol=1e-9, atol=1e-9)

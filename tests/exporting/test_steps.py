"""The exported library gives the eager modules' numbers: random steps of several arms, in every mode."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from apcc_torch.control.pid import TendonReference
from apcc_torch.estimation.feedback import FeedbackStatus
from apcc_torch.exporting.functions import blank, kinematic
from apcc_torch.exporting.tuples import Beginning, TendonInput, TendonMemory
from apcc_torch.model.abscissae import decouple
from apcc_torch.native.structure import flattened, rebuilt
from exported_library import Built
from laws import generator, normal

D = torch.float64
ROWS = 1000
STANDARD = "controller.adaptive=false"
MINE = ("arm.lengths=[0.2,0.25]", "arm.sensors=[0.2,0.45]")


def worst(have: Any, want: Any) -> float:
    """Largest difference, of large numbers relative to the largest of their tensor; what is no number is no number."""
    largest = 0.0
    for a, b in zip(flattened(have), flattened(want), strict=True):
        assert a.shape == b.shape
        if b.numel():
            a, b = a.double(), b.double()
            assert torch.equal(a.isnan(), b.isnan())
            scale = b.nan_to_num(0.0, 0.0, 0.0).abs().max().clamp(min=1.0)
            off = torch.where((a == b) | b.isnan(), 0.0, (a - b).abs())
            largest = max(largest, float(off.max() / scale))
    return largest


def one(item: Any, like: Any, row: int) -> Any:
    """A row of nested tuples, some of whose tensors are one for all rows."""
    pairs = zip(flattened(item), flattened(like), strict=True)
    return rebuilt(like, iter([leaf[row] if leaf.dim() > form.dim() else leaf for leaf, form in pairs]))


def stacked(rows: list[Any]) -> Any:
    """Rows side by side."""
    columns = zip(*(flattened(row) for row in rows), strict=True)
    return rebuilt(rows[0], iter([torch.stack(column) for column in columns]))


def steps(built: Built, rows: int, missing: bool) -> tuple[Any, Any, Any]:
    """States that are under way, what the sensors then see of arms that are longer than believed, and targets.

    Args:
        built: The library.
        rows: How many.
        missing: Whether sensors, orientations and tendons are missing here and there.
    """
    controller, rng = built.parts.controller, generator(3)
    inner, pi_hat = kinematic(controller), built.parts.pi_hat
    n_b, n = pi_hat.shape[-1], inner.backbone.n
    q = normal((rows, n), D, rng) * inner.backbone.coordinates.per_unit(0.4, 0.01, n, pi_hat.double())
    true = (1.03 * pi_hat.double()).expand(rows, n_b)
    first = pi_hat * (1.0 + 0.02 * normal((rows, n_b), D, rng)).to(pi_hat)
    state = built.module("start")(Beginning(torch.zeros_like(q).to(pi_hat), first, torch.zeros(rows, dtype=D)))
    _, measurement, target = blank(controller, pi_hat)
    X = inner.feedback.abscissae.double()
    arm = copy.deepcopy(inner.backbone).double()
    target = target._replace(x_d=0.05 * normal((rows, 3), D, rng).to(pi_hat))
    for k in range(4):
        moved = (1.0 + 0.02 * k) * q
        T = arm.pose(moved, true, *decouple(X.expand(rows, -1), true)).to(pi_hat)
        measurement = measurement._replace(T=T, time=torch.full((rows,), 0.01 * (k + 1), dtype=D))
        if measurement.tendons is not None:
            y = inner.tendons(moved.to(pi_hat), first)
            measurement = measurement._replace(tendons=y + 1e-3 * normal(tuple(y.shape), D, rng).to(y))
        if measurement.forces is not None:
            measurement = measurement._replace(forces=normal((rows, measurement.forces.shape[-1]), D, rng))
        if k < 3:
            state, _ = built.module("step")(state, measurement, target)
    if missing:
        there = torch.rand(rows, len(X), generator=rng) < 0.7
        oriented = there & (torch.rand(there.shape, generator=rng) < 0.7)
        measurement = measurement._replace(mask=there, angular_mask=oriented)
        if measurement.tendons is not None:
            gone = torch.rand(measurement.tendons.shape, generator=rng) < 0.3
            measurement = measurement._replace(tendons=measurement.tendons.masked_fill(gone, torch.nan))
    return state, measurement, target


def off(built: Built, name: str, arguments: tuple[Any, ...], rows: int) -> float:
    """By how much a function is off its module, which works on all rows at once."""
    each = built.compiled[name]
    want = built.module(name)(*arguments)
    results = (want,) if len(each.function.gives) == 1 else want
    forms = tuple(each.function.example)
    found = [built.call(name, *(one(a, f, row) for a, f in zip(arguments, forms, strict=True))) for row in range(rows)]
    have = tuple(stacked([row[k] for row in found]) for k in range(len(results)))
    whole = tuple(stacked([one(r, f, row) for row in range(rows)]) for r, f in zip(results, each.results, strict=True))
    return worst(have, whole)


@pytest.fixture(autouse=True)
def no_grad() -> Iterator[None]:
    with torch.no_grad():
        yield


QUICK = "feedback.max_iterations=3"
PAPER = "experiment=dynamic_run_2_tuned"
ARM_2 = ("experiment=robot_2_tuned", "feedback=position", "covariance=false")
CASES = {
    "paper": (PAPER, STANDARD),
    "paper, adaptive": (PAPER,),
    "arm 2, positions": (*ARM_2, STANDARD, QUICK),
    "arm 2, positions, adaptive": ARM_2,
    "mine, a law along the total derivative": (*MINE, "adaptation=normalised", "pose_filter=predictive", QUICK),
    "mine, forces": (*MINE, "adaptation=none", "dynamics_law=composite", "actuation=forces", QUICK),
}


@pytest.mark.parametrize("words", CASES.values(), ids=CASES.keys())
def test_a_library_gives_the_eager_numbers(words: tuple[str, ...], tmp_path: Path) -> None:
    built = Built(tmp_path, *words)
    state, measurement, target = steps(built, ROWS, missing=False)
    later, answer = built.module("step")(state, measurement, target)
    assert (answer.status != int(FeedbackStatus.INVALID)).all() and answer.q_d.isfinite().all()
    assert off(built, "step", (state, measurement, target), ROWS) < 1e-12
    assert off(built, "restart", (later, torch.full((ROWS,), 7.0, dtype=D)), 20) < 1e-12
    if "covariance" in built.compiled:
        # Of a matrix that is inverted, whose largest entries are a thousand times its smallest.
        assert off(built, "covariance", (state, later, measurement), 50) < 1e-10
    # Where sensors are missing, damping alone holds what they do not tell, and rounding shows as much more.
    state, measurement, target = steps(built, 50, missing=True)
    assert off(built, "step", (state, measurement, target), 50) < 1e-6
    if "loop_step" in built.compiled:
        rng = generator(1)
        y = [1e-2 * normal((ROWS, built.parts.functions[-1].example[0].z.numel()), D, rng) for _ in range(6)]
        tendons = TendonInput(*y[:5], torch.full((ROWS,), 0.01, dtype=D))
        assert off(built, "loop_step", (TendonMemory(y[5]), tendons), ROWS) < 1e-12


def test_the_plant_gives_the_eager_numbers(tmp_path: Path) -> None:
    words = ("arm.lengths=[0.2]", "arm.sensors=[0.2]", STANDARD, QUICK, "covariance=false", "plant.settle=0.2")
    built = Built(tmp_path, *words, "with_plant=true", "plant.backlash=1e-3", "experiment.payloads=[0.1]")
    (now,) = built.call("plant_start")
    want = built.module("plant_start")()
    assert worst(now, want) == 0.0 and float(now.arm.q.abs().max()) > 1e-4
    rng, n_a = generator(5), now.z.shape[-1]
    for k in range(200):
        reference = TendonReference(*(5e-3 * normal((2, n_a), D, rng)).unbind())
        (have, seen), (want, view) = (
            built.call("plant_step", want, reference),
            built.module("plant_step")(want, reference),
        )
        assert worst((have, seen), (want, view)) < 1e-12, k


def test_single_precision_is_near(tmp_path: Path) -> None:
    words = ("arm.lengths=[0.2]", "arm.sensors=[0.2]", STANDARD, QUICK, "precision=single", "covariance=false")
    built = Built(tmp_path, *words)
    state, measurement, target = steps(built, 200, missing=False)
    assert state.q_bar.dtype == torch.float32 and state.time.dtype == D
    assert off(built, "step", (state, measurement, target), 200) < 1e-4
    # A day later the times have no digits left in single precision, and the step goes on as before.
    late = 86400.0
    moved = state._replace(
        time=state.time + late, velocity_filter=state.velocity_filter._replace(times=state.velocity_filter.times + late)
    )
    seen = measurement._replace(time=measurement.time + late)
    forms = built.compiled["step"].function.example
    for row in range(20):
        early = built.call("step", *(one(a, f, row) for a, f in zip((state, measurement, target), forms, strict=True)))
        later = built.call("step", *(one(a, f, row) for a, f in zip((moved, seen, target), forms, strict=True)))
        assert float(later[0].time - early[0].time) == pytest.approx(late, abs=1e-9)
        assert worst(later[1], early[1]) < 1e-4

"""The law's estimator beside motors, on recordings of an arm at rest under elastic tendons that they pull."""

from __future__ import annotations

import pytest
import torch
from scipy.optimize import minimize_scalar
from torch import Tensor

from apcc_torch import Arm
from apcc_torch.evaluation.frames import Frames, Past
from apcc_torch.evaluation.method import Known
from apcc_torch.evaluation.shape_as_built import held
from apcc_torch.evaluation.shape_identified import ShapeIdentified
from apcc_torch.evaluation.tasks import Task
from apcc_torch.identification.arm_blocks import Spreads, arm_parameters
from apcc_torch.identification.fit import FitSettings
from apcc_torch.identification.tendon_arm import TIP_MASS, Drive, TendonArm
from apcc_torch.model.arm_placement import Placement

D = torch.float64
PLACES = [0.15, 0.35, 0.5]
ARM = Arm(
    lengths=[0.15, 0.2, 0.15],
    mass=0.3,
    axial_rigidity=400.0,
    bending_rigidity=0.02,
    placement=Placement(position=(0.1, 0.2, -0.3), rotation=(-1.5707963267948966, 0.0, 0.0), gravity=(0.0, 9.81, 0.0)),
)
FINE = ARM.changed(lengths=[0.05] * 10, racks=PLACES, sensors=PLACES)
"""The same in pieces, which weight and load bend each by itself."""
NOISE = 2e-4
"""Of what motors say, m: each reading for itself."""
BETWEEN, BESIDE = Task((0, 2), True), Task((0, 1), True)
PAYLOAD = 0.15


def recording(payload: float, count: int, seed: int) -> Frames:
    """Moments at which motors have pulled at random, and say so with an error."""
    draw = torch.Generator().manual_seed(seed)
    arm, nominal = TendonArm(FINE), arm_parameters(FINE, Spreads(friction=0.0))
    pulled = 0.01 * torch.rand(count, 9, generator=draw, dtype=D)
    none = torch.zeros(count, 1, dtype=D)
    values = nominal.values(nominal.nominal()) | {TIP_MASS: torch.tensor([payload], dtype=D)}
    places = arm.predict(Drive(pulled.unsqueeze(1), none, none.expand(count, 9)), values)
    assert bool(places.isfinite().all())
    said = pulled + NOISE * torch.randn(count, 9, generator=draw, dtype=D)
    drive = Drive(said.unsqueeze(1), none, none.expand(count, 9))
    past = Past(torch.full((count, 2, 3, 3), torch.nan, dtype=D), drive)
    axes = torch.full((count, 3, 3, 3), torch.nan, dtype=D)
    return Frames(torch.arange(count, dtype=D), drive, places, axes, torch.zeros(count).long(), past)


@pytest.fixture(scope="module")
def method() -> ShapeIdentified:
    """Learned without a load."""
    held_back = dict.fromkeys(("angle", "offset", "input_scale", "rest_bend", "friction", "damping_ratio"), 0.0)
    blocks = arm_parameters(ARM, Spreads(**held_back))
    found = ShapeIdentified(Known(ARM, blocks, blocks, None, FitSettings(rounds=1), 60, 0, lambda line: None))
    found.fit(recording(0.0, 90, 1))
    return found


def unlikely(method: ShapeIdentified, some: Frames, load: float) -> float:
    """Twice the negative logarithm of what is believed of all moments, where all of them settled."""
    y = method.told(some).under(torch.tensor(load, dtype=D))
    state = method.settled(some, y, load)
    r, _ = method.shape.residual(state, method.measured(some, state, y))
    known, away = method.shape.believed(state)
    believed = float(method.shape.load * method.shape.dynamics.masses.sum())
    each = r.square().sum(-1) + (away * (known @ away.unsqueeze(-1)).squeeze(-1)).sum(-1)
    return float(each.sum()) + (load / believed) ** 2


def off(found: Tensor, frames: Frames) -> float:
    """Of the last body, m."""
    return float((found - frames.positions)[:, 2].square().sum(-1).mean().sqrt())


def test_the_load_is_the_most_likely_of_all_moments(method: ShapeIdentified) -> None:
    some = recording(PAYLOAD, 25, 2).showing(BETWEEN)
    load = float(method.load(some))
    best = minimize_scalar(lambda m: unlikely(method, some, m), bounds=(0.0, 0.6), method="bounded").x
    assert load == pytest.approx(best, abs=2e-3)
    # Arcs that were identified know no sag within a section, so what they weigh a load with is not its mass.
    assert 0.5 * PAYLOAD < load < 1.2 * PAYLOAD


def test_no_load_is_less_than_none(method: ShapeIdentified) -> None:
    assert 0.0 <= float(method.load(recording(0.0, 25, 3).showing(BETWEEN))) < 0.02


def test_what_tendons_are_off_by_is_learned(method: ShapeIdentified) -> None:
    """What motors say errs by itself, and so do the equilibria: in the space that strains make, as much."""
    weights = method.shape.tendon_weights
    assert weights is not None
    deviation = 1.0 / weights[1].diagonal()
    assert bool((deviation > 0.2 * NOISE).all()) and bool((deviation < 3.0 * NOISE).all())


def test_the_hidden_tip_is_as_near_under_a_load_as_without_one(method: ShapeIdentified) -> None:
    empty, loaded = recording(0.0, 60, 4), recording(PAYLOAD, 60, 5)
    found = [off(method.predict(each.showing(BESIDE), BESIDE), each) for each in (empty, loaded)]
    seen = loaded.showing(BESIDE)
    ignorant = off(method.placed(method.settled(seen, method.told(seen).empty, 0.0)), loaded)
    assert found[1] < 0.5 * ignorant and found[1] < 1.2 * found[0]


def test_a_known_load_stays(method: ShapeIdentified) -> None:
    some = recording(PAYLOAD, 5, 6)
    state = held(method.begun(5), 0.05)
    state = method.stepped(state, method.measured(some, state, None))
    torch.testing.assert_close(state.load, torch.full((5,), 0.05, dtype=D), rtol=1e-6, atol=0.0)


def test_it_takes_part_where_bodies_and_motors_are_shown() -> None:
    blocks = arm_parameters(ARM, Spreads(friction=0.0))
    method = ShapeIdentified(Known(ARM, blocks, blocks, None, FitSettings(), 10, 0, lambda line: None))
    assert method.answers(BETWEEN)
    assert not any(map(method.answers, (Task((0, 2), False), Task((), True), Task((), True, online=True))))

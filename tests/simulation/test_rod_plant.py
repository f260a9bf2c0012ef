"""The Cosserat rod as the true arm: against statics, beam formulas, many sections of constant curvature."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.composed import compose
from apcc_torch.control.pid import TendonReference
from apcc_torch.experiments.dynamic import simulate
from apcc_torch.model.arm import Arm
from apcc_torch.model.statics import equilibrium
from apcc_torch.simulation.plant import Plant, PlantSettings
from apcc_torch.simulation.rod_plant import RodPlant
from true_arms import ARM, D, numbers, plant, run, tip


def test_rod_rests_where_statics_says() -> None:
    arm = plant(numbers(0.0, 0.3), RodPlant, pid=PlantSettings().pid.changed(K_I=0.0))
    y = 0.02 * torch.sin(torch.arange(6, dtype=D)).expand(2, 6)
    want = equilibrium(
        arm.dynamics, routing=arm.routing, tendon_lengths=y, compliance=1.0 / arm.pid.K_P, payload=arm.payload
    )
    held, now = TendonReference(y, torch.zeros_like(y)), arm.straight((2,))
    now = now._replace(arm=now.arm._replace(q=want.q))
    torch.testing.assert_close(arm.forces(now, held), want.u)
    for k in range(5):
        now = arm.advance(now, held, 0.02, k)
    torch.testing.assert_close(now.arm.q, want.q, rtol=0, atol=1e-8)
    twist, shear = want.q[1, 2::6].abs().max(), want.q[1, [3, 4, 9, 10]].abs().max()
    assert float(twist) > 1e-4 and float(shear) > 1e-4, "it twists and shears, or this says nothing of either"


def test_torsion_and_shear_are_those_of_a_round_section() -> None:
    arm = plant(numbers(0.0), RodPlant, radius=0.02, poisson=0.25, spacing=None)
    springs = {name: getattr(arm.dynamics, name) for name in set(arm.dynamics.springs)}
    # E I = E pi r^4 / 4, G = E / (2 (1 + nu)), J = 2 I, A = pi r^2.
    EI = ARM.section_stiffness()[1] * ARM.rest_lengths()
    E = EI / (torch.pi * 0.02**4 / 4.0)
    G = E / 2.5
    torch.testing.assert_close(springs["torsional_stiffness"], G * torch.pi * 0.02**4 / 2.0 / ARM.rest_lengths())
    torch.testing.assert_close(springs["shear_stiffness"], G * torch.pi * 0.02**2 / ARM.rest_lengths())


def test_torsion_and_shear_are_those_of_rods_between_discs() -> None:
    r, s = 0.02, 0.03
    springs = plant(numbers(0.0), RodPlant, radius=r, poisson=0.25, spacing=s).dynamics
    EI = ARM.section_stiffness()[1] * ARM.rest_lengths()
    # A rod w(z) = a + b z + c z^2 + d z^3 that is upright at both discs, one of which is moved by 1 m: Q = -E I w'''.
    upright = torch.tensor([[1, 0, 0, 0], [0, 1, 0, 0], [1, s, s**2, s**3], [0, 1, 2 * s, 3 * s**2]], dtype=D)
    force = -6.0 * EI * torch.linalg.solve(upright, numbers(0.0, 0.0, 1.0, 0.0))[3]
    torch.testing.assert_close(springs.shear_stiffness, force * s / ARM.rest_lengths())
    # Twisted by 1 rad, a rod at r is moved by r, with a lever of r; and is twisted itself by G J = E I / (1 + nu).
    torque = r * force * r * s + EI / 1.25
    torch.testing.assert_close(springs.torsional_stiffness, torque / ARM.rest_lengths())


def test_a_solid_arm_falls_sideways_where_discs_hold_it() -> None:
    """Arm 1 with 0.5 kg under the tendons of the paper's set-point, by the second derivative of its energy."""
    y = numbers(-0.026, 0.019, 0.0, -0.041, 0.087, -0.028, 0.007, 0.129, -0.081)
    payload, K_P = numbers(0.5), PlantSettings().pid.K_P
    discs, solid = (plant(payload, RodPlant, Arm.load("arm_1"), refine=2, **s) for s in ({}, {"spacing": None}))
    held = equilibrium(
        discs.dynamics, routing=discs.routing, tendon_lengths=y.expand(1, 9), compliance=1.0 / K_P, payload=payload
    )
    assert bool(held.converged.all())

    def least(arm: Plant) -> float:
        def force(q: Tensor) -> Tensor:
            pulled = K_P * (arm.B @ (arm.B.mT @ q - y))
            return arm.dynamics.static_load(q, payload[0]) + arm.dynamics.stiffness_diagonal * q + pulled

        H = torch.autograd.functional.jacobian(force, held.q[0])
        assert (H - H.mT).abs().max() < 1e-9
        values, directions = torch.linalg.eigh(H)
        if values[0] < 0:
            assert directions[2::6, 0].abs().max() > 0.1, "torsion is what gives way"
        return float(values[0])

    assert least(discs) > 0.2
    assert least(solid) < -2.0


def test_a_rod_of_close_discs_is_the_other_plant() -> None:
    """It neither shears nor twists: many elements and as many more sections of constant curvature are one arm."""
    y, payload = 0.02 * torch.sin(torch.arange(6, dtype=D)).expand(2, 6), numbers(0.0, 0.2)
    rod, pieces = plant(payload, RodPlant, refine=4, spacing=2e-3), plant(payload, refine=12)
    still = (
        equilibrium(a.dynamics, routing=a.routing, tendon_lengths=y, compliance=1.0 / a.pid.K_P, payload=payload).q
        for a in (rod, pieces)
    )
    tips = [a.backbone.tip(q, a.dynamics.lengths) for a, q in zip((rod, pieces), still, strict=True)]
    assert (tips[0] - tips[1]).norm(dim=-1).max() < 2e-4
    ways = [torch.stack([tip(a, run(a, y, k, 0.02)) for k in (5, 15)]) for a in (rod, pieces)]
    assert (ways[0] - ways[1]).norm(dim=-1).max() < 1e-3


def test_the_loop_holds_a_rod_as_it_holds_the_other_plant() -> None:
    """The paper's set-point with 0.5 kg, on the way."""
    words = ["experiment=dynamic_run_2_tuned", "experiment.setpoints=[[0.325,0.15,-0.275]]", "controller.rate=25"]
    words += ["experiment.payloads=[0.5]", "experiment.duration=1", "plant.settle=0.5", "progress=false"]
    words += ["controller.adaptive=false"]
    plants = (["plant=rod", "plant.refine=4", "plant.spacing=2e-3"], ["plant.refine=8"])
    rod, pieces = (simulate(compose(*words, *each).settings).log for each in plants)
    assert (rod.x - pieces.x).norm(dim=-1).max() < 4e-3
    assert (rod.x_d - rod.x)[-1].norm() < 0.6 * (rod.x_d - rod.x)[0].norm()


def test_rod_is_the_plant_of_the_experiment_that_names_it() -> None:
    composed = compose("experiment=dynamic_run_2", "plant=rod", "plant.radius=0.02", "plant.refine=1")
    made = composed.plant()
    assert type(made) is RodPlant and made.radius == 0.02 and made.backbone.n == 18
    # Its tendons are those of the other plant, and feel bends and elongations alone.
    other = compose("experiment=dynamic_run_2", "plant.refine=1").plant()
    felt = made.B.unflatten(0, (3, 6))
    torch.testing.assert_close(felt[:, [0, 1, 5]].flatten(0, 1), other.B)
    assert not bool(felt[:, 2:5].any())

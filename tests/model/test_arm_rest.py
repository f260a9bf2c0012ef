"""An arm at rest as it was built, against the equilibrium of its tendons by Newton's method."""

from __future__ import annotations

import torch

from apcc_torch import Arm
from apcc_torch.identification.arm_blocks import Spreads, arm_parameters
from apcc_torch.identification.tendon_arm import Drive, TendonArm
from apcc_torch.model.arm_placement import Placement
from apcc_torch.model.arm_rest import strain_at_rest
from apcc_torch.model.arm_tendons import Actuation

D = torch.float64


def test_it_is_the_equilibrium_of_taut_tendons_on_a_bent_arm() -> None:
    arm = Arm(
        lengths=[0.2, 0.25],
        rest_bend=[[0.2, -0.1], [0.05, 0.3]],
        bending_rigidity=[0.08, 0.05],
        actuation=Actuation(pre_stretch=[0.02, 0.03, 0.02, 0.01, 0.02, -0.05], stiffness=800.0),
        placement=Placement(gravity=(0.0, 0.0, 0.0)),
    )
    parameters = arm_parameters(arm, Spreads(friction=0.0))
    still = Drive(torch.zeros(1, 1, 6, dtype=D), torch.zeros(1, 1, dtype=D), torch.zeros(1, 6, dtype=D))
    found = TendonArm(arm).rest(still, parameters.values(parameters.nominal()))[0]
    # Where a tendon goes slack its tension is rounded off over a hundredth of a millimetre.
    torch.testing.assert_close(strain_at_rest(arm), found, rtol=0, atol=1e-5)


def test_an_arm_without_either_is_straight() -> None:
    assert torch.equal(strain_at_rest(Arm(lengths=[0.2, 0.25])), torch.zeros(6, dtype=D))


def test_slack_tendons_have_no_part_in_it() -> None:
    slack = Arm(lengths=[0.2, 0.25]).changed(actuation=Actuation(pre_stretch=-0.01))
    assert torch.equal(strain_at_rest(slack), torch.zeros(6, dtype=D))


def test_motors_that_set_tensions_hold_nothing() -> None:
    forced = Actuation(pre_stretch=0.02, sets="tension")
    assert torch.equal(strain_at_rest(Arm(lengths=[0.2, 0.25], actuation=forced)), torch.zeros(6, dtype=D))

"""From lengths to pressures: what holds the arm, what limits leave, and what follows from that for q_d."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.control.bounds import RateBounds
from apcc_torch.control.controller import APCCController
from apcc_torch.control.pressure import PressureControl, PressureControlSettings
from apcc_torch.control.step_io import Measurement, Target
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.arm import Arm
from apcc_torch.model.statics import equilibrium

TRUNK = Arm.load("soft_trunk")
DT = torch.tensor(0.01, dtype=torch.float64)
BENT = torch.tensor([0.3, -0.2, 0.004, -0.25, 0.2, 0.006], dtype=torch.float64)


def control(**changes: float) -> PressureControl:
    made = PressureControl.on(TRUNK, PressureControlSettings(**changes))
    assert made is not None
    return made


def lengths_of(q: Tensor) -> Tensor:
    return TRUNK.routing().lengths(q, TRUNK.rest_lengths())


def test_an_arm_with_tendons_has_none() -> None:
    assert PressureControl.on(Arm.load("arm_1"), PressureControlSettings()) is None
    assert APCCController.for_arm(Arm.load("arm_1")).pressure is None


def test_the_feedforward_holds_the_arm_where_it_is_to_be() -> None:
    """By the statics, which know nothing of it: under these pressures the arm comes to rest in that shape."""
    loop, y_d = control(), lengths_of(BENT)
    _, p = loop(loop.initial_state(y_d), y_d, y_d, DT)
    assert p.min() > 0.0 and p.max() < 1.2e5
    rest = equilibrium(TRUNK.dynamics(), routing=TRUNK.routing(), tensions=-loop.chambers(p))
    torch.testing.assert_close(rest.q, BENT, atol=1e-6, rtol=0.0)


def test_no_pressure_leaves_its_limits_and_bends_go_before_elongation() -> None:
    loop = control(feedforward=False, K_P=1.0, K_I=0.0, K_D=0.0)
    # Bent and short: some chambers would have to suck.
    q = torch.tensor([0.3, 0.2, -0.02, -0.3, 0.2, -0.02], dtype=torch.float64)
    y_d = lengths_of(q)
    state, p = loop(loop.initial_state(0.0 * y_d), y_d, 0.0 * y_d, DT)
    assert p.min() == 0.0 and p.max() <= 1.2e5
    got = TRUNK.routing().generalized_force(loop.chambers(p), TRUNK.rest_lengths())
    bends = torch.tensor([0, 1, 3, 4])
    torch.testing.assert_close(got[bends], (loop.spring * q)[bends], atol=1e-9, rtol=1e-9)
    assert (state.excess[[2, 5]] > 0).all() and state.excess[bends].abs().max() < 1e-9
    apart, other = control(feedforward=False, K_P=1.0, K_I=0.0, K_D=0.0, share=False), 0.0 * y_d
    cut = apart(apart.initial_state(other), y_d, other, DT)[0].excess
    assert cut[bends].abs().max() > 0.01, "chambers that are cut one by one bend less"


def test_the_integral_does_not_wind_up_at_a_limit() -> None:
    far, here = lengths_of(torch.tensor([3.0, 0.0, 0.0, 0.0, 0.0, 0.0]).double()), lengths_of(0.0 * BENT)
    left = []
    for windup_time in (0.1, 1e6):
        loop = control(windup_time=windup_time)
        state = loop.initial_state(here)
        for _ in range(300):  # thirty seconds of what it cannot do
            state, p = loop(state, far, here, 10.0 * DT)
        assert p.max() == 1.2e5
        left.append(float(state.z.abs().max()))
    assert left[0] < 0.1 * left[1], "of the integral that would have wound up, nearly nothing is left"


def test_the_reference_is_led_back_to_what_chambers_can_do() -> None:
    loop = control()
    of = APCCController.for_arm(TRUNK).backbone.coordinates
    far, here = lengths_of(torch.tensor([0.0, 0.0, -0.1, 0.0, 0.0, 0.0]).double()), lengths_of(0.0 * BENT)
    state, _ = loop(loop.initial_state(here), far, here, DT)
    lower, upper, together = loop.bounds(state, of)
    assert together == 2.0, "no task asks for faster rates"
    assert lower[2] > 0.0 and upper[2] == torch.inf and (lower[[0, 1, 3, 4]] == -2.0).all()
    free, _ = loop(loop.initial_state(here), here, here, DT)
    bends = torch.tensor([2.0, 2.0, torch.inf, 2.0, 2.0, torch.inf]).double()
    assert torch.equal(loop.bounds(free, of).upper, bends) and torch.equal(loop.bounds(free, of).lower, -bends)


def test_rows_are_what_they_are_alone_and_gradients_hold() -> None:
    loop = control()
    y_d = torch.stack((lengths_of(BENT), lengths_of(-0.5 * BENT)))
    y = 0.9 * y_d
    together, p = loop(loop.initial_state(y), y_d, y, DT.expand(2))
    for k in range(2):
        alone, p_k = loop(loop.initial_state(y[k]), y_d[k], y[k], DT)
        torch.testing.assert_close(p[k], p_k, rtol=1e-12, atol=1e-6)
        torch.testing.assert_close(together.z[k], alone.z, rtol=1e-12, atol=1e-12)

    def pressures(y_d: Tensor, y: Tensor) -> Tensor:
        made: Tensor = loop(loop.initial_state(0.0 * y_d), y_d, y, DT)[1] / 1e4
        return made

    assert torch.autograd.gradcheck(pressures, (y_d[0].clone().requires_grad_(), y[0].clone().requires_grad_()))


def test_what_is_not_finite_stays_out_of_the_memory() -> None:
    loop, y = control(), lengths_of(BENT)
    start = loop.initial_state(y)
    later, _ = loop(start, y * torch.nan, y, DT)
    assert all(torch.equal(new, old) for new, old in zip(later, start, strict=True))


def test_the_controller_of_an_arm_with_chambers_asks_for_pressures() -> None:
    controller, L0 = APCCController.for_arm(TRUNK), TRUNK.rest_lengths()
    q = torch.zeros(6).double()
    T = controller.backbone.pose(q, L0, *decouple(L0.cumsum(0), L0))
    state = controller.initial_state(q, L0)
    target = Target(torch.tensor([0.05, 0.0, -0.27]).double(), torch.zeros(3).double())
    for k in range(3):
        state, command = controller(state, Measurement(T, torch.tensor(0.01 * (k + 1)).double()), target)
    assert command.pressure is not None and state.pressure is not None
    assert (command.pressure >= 0.0).all() and command.pressure.std() > 0.0
    # Which way the first chamber, on the x axis of the base, has to give way is told by the kinematics alone.
    side = controller.backbone.tip(torch.tensor([0.1, 0, 0, 0, 0, 0]).double(), L0)[0]
    assert (command.pressure[0] < command.pressure[1]) == bool(side > 0)


def test_a_straight_arm_at_its_limits_goes_towards_its_target() -> None:
    """Elongation spent, bends hardly lift a straight arm: the tip goes sideways first, and no section bends away."""
    controller, L0 = APCCController.for_arm(TRUNK), TRUNK.rest_lengths()
    loop = control()
    q = torch.tensor([0.08, -0.03, -0.01, 0.02, -0.02, -0.01]).double()
    J = controller.backbone.tip_jacobian(q, L0)
    velocity = torch.tensor([0.28, 0.13, 0.28]).double()  # 0.3 m/s sideways, as fast upwards
    state = loop.initial_state(lengths_of(q))._replace(excess=torch.tensor([0.0, 0.0, 2e-5, 0.0, 0.0, 2e-5]).double())
    bounds = loop.bounds(state, controller.backbone.coordinates)
    solver = controller.inverse_kinematics
    sideways = torch.nn.functional.normalize(velocity[:2], dim=0)

    def share(bounds: RateBounds) -> float:
        """Of the velocity sideways that is asked, what is met."""
        qdot = solver(J, torch.zeros(3).double(), velocity, q, bounds=bounds)
        assert (qdot >= bounds.lower).all() and (qdot <= bounds.upper).all()
        return float((J @ qdot)[:2] @ sideways / velocity[:2].norm())

    assert share(bounds) > 0.7
    assert share(bounds._replace(together=None)) < 0.0, "rates that are cut one by one lead away from it"

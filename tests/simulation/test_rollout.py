"""Gradients through whole loops: against finite differences, and the same with few states kept."""

from __future__ import annotations

import weakref
from collections.abc import Iterable, Iterator
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from apcc_torch.control.adaptation import AdaptiveLaw
from apcc_torch.control.controller import APCCController
from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.control.pid import TendonPID
from apcc_torch.control.trajectory import SetPoint, SineTrajectory
from apcc_torch.estimation.savitzky_golay import SavitzkyGolay
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.model.integrators import ArmState
from apcc_torch.model.stiffness import scaled_stiffness
from apcc_torch.model.tendons import TendonRouting, rack_routing
from apcc_torch.simulation.dynamic import ClosedLoop, DynamicSettings, simulate_dynamic
from apcc_torch.simulation.exact import simulate_exact
from apcc_torch.simulation.kinematic import FeedbackLoop, FeedbackState, simulate_feedback
from apcc_torch.simulation.plant import Plant
from apcc_torch.simulation.rollout import rollout
from apcc_torch.simulation.sensors import Draws, PoseSensors
from arms import HANGING_BASE, PI, PI_HAT
from laws import bits, generator, leaves, uniform

D = torch.float64
# Neither sensors nor tendon racks at a section's boundary, where there are kinks.
SENSORS = torch.tensor([0.08, 0.2, 0.33, 0.55], dtype=D)
RACKS = torch.tensor([0.09, 0.33, 0.57], dtype=D)
PLANT = torch.tensor([0.1, 0.125, 0.135, 0.24], dtype=D)
TARGET = torch.tensor([0.1, 0.05, -0.53], dtype=D)
PATH = SineTrajectory(TARGET, torch.tensor([0.1, 0.06, 0.02], dtype=D), 1.0)
STEPS, PERIOD = 12, 0.02

# Every input of the two loops that the checks differentiate by.
GAINS = {"K": torch.tensor([1.8, 1.5, 2.0], dtype=D), "gamma": torch.tensor([2.0, 1.0, 0.7], dtype=D)}
GAINS |= {"null_gain": torch.tensor(0.3, dtype=D), "angular_weight": torch.tensor(0.2, dtype=D)}
START = {"q": 0.2 * uniform((9,), -1.0, 1.0, D, generator(3)) * torch.tensor([1, 1, 0.05] * 3), "pi_hat": PI_HAT}
KINEMATIC = GAINS | START | {"pi": PI}
DYNAMIC = GAINS | {
    "pi_hat": PI_HAT,
    "q": 0.1 * uniform((12,), -1.0, 1.0, D, generator(4)) * torch.tensor([1, 1, 0.05] * 4),
    "PID": torch.tensor([750.0, 1.0, 5.0], dtype=D),
    "lengths": PLANT,
    "stiffness": torch.tensor([100.0, 0.778], dtype=D),
    "payload": torch.tensor(0.2, dtype=D),
    "offset": torch.tensor(0.027, dtype=D),
    "model_offset": torch.tensor(0.026, dtype=D),
}


def controller(given: dict[str, Tensor], routing: TendonRouting | None = None) -> APCCController:
    backbone = PCCBackbone(3, HANGING_BASE)
    # Ended far below what a finite difference resolves.
    ends: dict[str, Any] = {"linear_threshold": 1e-13, "angular_threshold": 1e-12, "settled_step": 1e-9}
    feedback = StateFeedback(
        backbone, SENSORS, angular_weight=given["angular_weight"], max_iterations=40, gradient="implicit", **ends
    )
    law = AdaptiveLaw(3, given["gamma"], rate=0.5, normalisation=1.0)
    task = InverseKinematics(given["K"], null_gain=given["null_gain"])
    return APCCController(backbone, feedback, SavitzkyGolay(5, 2), task, law, routing=routing)


def kinematic(given: dict[str, Tensor]) -> list[Tensor]:
    """The log of 12 periods of section V-A."""
    loop = FeedbackLoop(controller(given), given["pi"], PATH, PERIOD)
    q, pi_hat = given["q"], given["pi_hat"]
    seen = loop.sensors.initial_state(loop.poses(q))
    start = FeedbackState(q, loop.controller.initial_state(q, pi_hat), seen)
    time = torch.zeros((), dtype=D)
    return rollout(loop, start, lambda k: (time + k * PERIOD, Draws(None, None)), STEPS)[1]


def plant(given: dict[str, Tensor], **settings: Any) -> Plant:
    lengths = given["lengths"]
    axial, bending = scaled_stiffness(lengths, 0.1, *given["stiffness"].unbind())
    dynamics = SoftArmDynamics(lengths, lengths / lengths.sum(), axial, bending, 0.1, base_rotation=HANGING_BASE)
    pid = TendonPID(*given["PID"].unbind())
    tendons = rack_routing(RACKS, given["offset"])
    return Plant(dynamics, tendons, pid, given["payload"], tendon_damping=50.0, **settings)


def dynamic(given: dict[str, Tensor]) -> list[Tensor]:
    """The log of 12 periods of section V-B."""
    arm = plant(given, substeps=1)
    routing = rack_routing(RACKS, given["model_offset"])
    loop = ClosedLoop(arm, controller(given, routing), PoseSensors(), SetPoint(TARGET), PERIOD)
    at_rest = arm.straight(())
    bent = at_rest._replace(arm=ArmState(given["q"], at_rest.arm.qdot))
    start = loop.start(bent, given["pi_hat"])
    time, k, draws = torch.zeros((), dtype=D), torch.zeros((), dtype=torch.int64), loop.sensors.draw(SENSORS)
    return rollout(loop, start, lambda i: (time + i * PERIOD, k + i, draws), STEPS)[1]


@pytest.mark.parametrize(("loop", "inputs"), [(kinematic, KINEMATIC), (dynamic, DYNAMIC)], ids=["V-A", "V-B"])
def test_gradients_of_a_closed_loop(loop: Any, inputs: dict[str, Tensor]) -> None:
    # Every input is scaled entry by entry along a direction of its own: one number each, in one check.
    rng = generator(5)
    ways = {name: value * uniform(value.shape, 0.5, 1.0, D, rng) for name, value in inputs.items()}

    def sizes(s: Tensor) -> Tensor:
        moved = {name: value + s[i] * ways[name] for i, (name, value) in enumerate(inputs.items())}
        fields = [each for each in loop(moved)[1:] if each.is_floating_point() and each.numel()]  # without the time
        return torch.stack([field[[STEPS // 2, -1]].norm() for field in fields])

    # Micrometres, radians, newtons: relative to its size each is of order one, and has a weight of its own.
    s = torch.zeros(len(inputs), dtype=D, requires_grad=True)
    with torch.no_grad():
        nominal = sizes(s)
    weights = uniform(nominal.shape, 0.5, 1.0, D, rng) / nominal
    (slopes,) = torch.autograd.grad((weights * sizes(s)).sum(), s)
    assert (slopes.abs() > 1e-6).all(), "every input is felt"
    with torch.no_grad():  # what differences are of needs no graph, which takes half of the time
        ends = [[(weights * sizes(h * way)).sum() for h in (1e-4, -1e-4)] for way in torch.eye(len(s), dtype=D)]
    differences = torch.stack([(ahead - behind) / 2e-4 for ahead, behind in ends])
    torch.testing.assert_close(slopes, differences, atol=3e-5, rtol=1e-4)


class Memory(TorchDispatchMode):
    """Counts the bytes of the tensors that live, and the most there ever were."""

    def __init__(self) -> None:
        super().__init__()
        self.now = self.most = 0
        self.known: set[int] = set()

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = function(*args, **(kwargs or {}))
        for leaf in leaves(result):
            storage = leaf.untyped_storage()
            if storage._cdata not in self.known:
                self.known.add(storage._cdata)
                self.now += storage.nbytes()
                self.most = max(self.most, self.now)
                weakref.finalize(storage, self.forget, storage._cdata, storage.nbytes())
        return result

    def forget(self, key: int, size: int) -> None:
        self.known.discard(key)
        self.now -= size


def used(run: Any) -> tuple[list[Tensor], list[Tensor], int]:
    """Fields of a log, their gradients, and the most bytes that lived meanwhile."""
    given = {name: value.clone().requires_grad_() for name, value in GAINS.items()}
    with Memory() as memory:
        fields = [field for field in run(given) if field.is_floating_point()]
        loss = sum((field[1:].square().sum() for field in fields), start=torch.zeros((), dtype=D))
        gradients = list(torch.autograd.grad(loss, list(given.values())))
    return fields, gradients, memory.most


def runs(checkpointed: bool) -> dict[str, Any]:
    at = {"checkpointed": checkpointed}
    settings = DynamicSettings(duration=0.24, control_rate=50.0, **at)
    noisy = PoseSensors(1e-3, 5e-3, delay=1, dropout=0.1)

    def in_motion(given: dict[str, Tensor]) -> Any:
        c = controller(given, rack_routing(RACKS))
        arm = plant(DYNAMIC, substeps=1, settle=0.1)
        return simulate_dynamic(arm, c, noisy, SetPoint(TARGET), PI, settings, generator(1))

    return {
        "feedback": lambda given: simulate_feedback(controller(given), PI, PI_HAT, PATH, 0.24, 50.0, **at),
        "dynamic": in_motion,
    }


@pytest.mark.parametrize("name", ["feedback", "dynamic"])
def test_checkpointed_is_the_same_and_keeps_less(name: str) -> None:
    fields, gradients, whole = used(runs(False)[name])
    again, regained, part = used(runs(True)[name])
    for have, want in zip(again, fields, strict=True):
        assert torch.equal(bits(have), bits(want))
    assert any(float(gradient.abs().max()) > 0.0 for gradient in gradients)
    for have, want in zip(regained, gradients, strict=True):
        torch.testing.assert_close(have, want, rtol=1e-9, atol=1e-12)
    # Segments of one of some 12 periods: what lives at once is one period's graph, the states and the log.
    assert part < 0.2 * whole


def test_checkpointed_settling_has_the_gradient_of_the_payload() -> None:
    slopes = []
    for checkpointed in (False, True):
        payload = torch.tensor(0.2, dtype=D, requires_grad=True)
        arm = plant(DYNAMIC | {"payload": payload})
        height = arm.backbone.tip(arm.settled(0.3, 0.02, checkpointed=checkpointed).arm.q, PLANT)[2]
        slopes.append(torch.autograd.grad(height, payload)[0])
    torch.testing.assert_close(slopes[1], slopes[0], rtol=1e-10, atol=0)
    assert float(slopes[0]) < -1e-3  # a heavier arm hangs lower


def test_rollout_counts_draws_in_order_and_reports() -> None:
    drawn: list[int] = []
    seen: list[int] = []

    def progress(steps: Iterable[int]) -> Iterator[int]:
        for k in steps:
            seen.append(k)
            yield k

    def given(k: int) -> tuple[float]:
        drawn.append(k)
        return (float(k),)

    def period(x: Tensor, c: float) -> tuple[Tensor, tuple[Tensor]]:
        return 0.9 * x + c, (x,)

    for checkpointed, steps in ((False, 7), (True, 7), (True, 1), (True, 0)):
        drawn.clear()
        seen.clear()
        x = torch.tensor(2.0, dtype=D, requires_grad=True)
        last, fields = rollout(period, x, given, steps, checkpointed, progress)
        assert drawn == seen == list(range(steps))
        assert [len(field) for field in fields] == ([steps] if steps else [])
        (slope,) = torch.autograd.grad(last, x)
        assert float(slope) == pytest.approx(0.9**steps)


def test_exact_loop_has_gradients_too() -> None:
    gamma = GAINS["gamma"].clone().requires_grad_()
    log = simulate_exact(controller(GAINS | {"gamma": gamma}), PI, PI_HAT, PATH, 0.2, 50.0, checkpointed=True)
    (have,) = torch.autograd.grad(log.pi_hat[-1].sum(), gamma)
    ends = []
    for h in (1e-4, -1e-4):
        c = controller(GAINS | {"gamma": GAINS["gamma"] + h})
        ends.append(simulate_exact(c, PI, PI_HAT, PATH, 0.2, 50.0).pi_hat[-1].sum())
    torch.testing.assert_close(have.sum(), (ends[0] - ends[1]) / 2e-4, rtol=1e-5, atol=1e-10)


def test_a_row_that_diverges_leaves_the_gradient_of_what_is_shared() -> None:
    slopes = []
    for rows in ([0, 1, 2], [0, 2]):
        PID = DYNAMIC["PID"].clone().requires_grad_()
        K = torch.diag_embed(torch.tensor([[1.8, 1.8, 1.8], [1.8, 2e4, 1.8], [1.8, 1.8, 1.8]], dtype=D))[rows]
        payload = torch.tensor([0.2, 0.0, 0.1], dtype=D)[rows]
        given = DYNAMIC | {"PID": PID, "K": K, "payload": payload}
        arm = plant(given, substeps=2, settle=0.1, bound=30.0)
        settings = DynamicSettings(duration=0.2, control_rate=50.0)
        c = controller(given, rack_routing(RACKS))
        log = simulate_dynamic(arm, c, PoseSensors(), SetPoint(TARGET.expand(len(rows), 3)), PI, settings)
        good = log.diverged_at < 0
        assert int(good.sum()) == 2
        slopes.append(torch.autograd.grad(log.x[:, good].square().sum(), PID)[0])
    torch.testing.assert_close(slopes[0], slopes[1], rtol=1e-6, atol=1e-12)
    assert float(slopes[1].abs().min()) > 1e-7

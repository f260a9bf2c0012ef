"""What torch may do with every public module: train, save, copy, map, export and compile it, also without values."""

from __future__ import annotations

import copy
import inspect
import io
from collections.abc import Callable
from itertools import repeat
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.export import Dim
from torch.func import grad, vmap

from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.errors import ApccError
from apcc_torch.modes import holds, known, none_left, values_of
from apcc_torch.native.structure import rebuilt
from apcc_torch.part import Part
from every_class import subclasses
from followed import begun, followed, led, seen
from laws import leaves
from part_cases import CASES
from parts import (
    WHERE,
    D,
    arguments,
    backbone,
    controlled,
    controller,
    dynamics,
    feedback,
    lengths,
    poses,
    q,
    qdot,
    solver,
)

NEEDED = {
    "Capsule": ("start", "end"),
    "DynamicsRegressor": ("base_rotation",),
    "HalfSpace": ("point", "normal"),
    "SetPoint": ("x_d",),
    "SoftWindow": ("weights",),
    "Sphere": ("centre",),
    "TendonLimits": ("lower", "upper"),
}
"""The tensors without which a case is not made."""

REFUSED = {"LengthBounds", "SavitzkyGolay", "SensorGate"}
"""Cases some of whose arguments make constants: no Parameters, and left as they are by `made`."""

every_case = pytest.mark.parametrize("name", CASES)
every_argument = pytest.mark.parametrize(
    ("name", "argument"), [(name, argument) for name, case in CASES.items() for argument in case.tensors()]
)


def needed(name: str) -> dict[str, Tensor]:
    return {each: value for each, value in CASES[name].tensors().items() if each in NEEDED.get(name, ())}


def made(name: str) -> Part:
    return CASES[name].make(**({} if name in REFUSED else CASES[name].tensors()))


def total(result: Any) -> Tensor:
    """A number that every entry of a result enters."""
    parts = [leaf[leaf.isfinite()] for leaf in leaves(result) if leaf.is_floating_point()]
    return torch.cat([part * torch.sin(1.0 + torch.arange(len(part))) for part in parts]).sum()


def same(have: Any, want: Any) -> bool:
    """Whether all tensors are equal, bit for bit."""
    pairs = zip(leaves(have), leaves(want), strict=True)
    return all(a.dtype == b.dtype and torch.equal(a.nan_to_num(), b.nan_to_num()) for a, b in pairs)


def through_a_file(item: Any) -> Any:
    file = io.BytesIO()
    torch.save(item, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def with_parameter(name: str, argument: str, given: nn.Parameter) -> Part | ApccError:
    """The part, or why it is refused."""
    try:
        return CASES[name].make(**{**needed(name), argument: given})
    except ApccError as error:
        return error


def test_every_module_is_a_part() -> None:
    others = [each for each in subclasses(nn.Module) if not issubclass(each, Part)]
    # What is traced, never kept.
    traced = ("apcc_torch.exporting.", "apcc_torch.native.", "apcc_torch.envs.machine_code")
    assert {room for each in others for room in traced if each.__module__.startswith(room)} == set(traced)
    assert not [each for each in others if not each.__module__.startswith(traced)]


def test_every_public_part_is_a_case() -> None:
    cases = {type(each) for name in CASES for each in made(name).modules()}
    parts = {each for each in subclasses(Part) if not inspect.isabstract(each) and not each.__name__.startswith("_")}
    rooms = ("model", "estimation", "control", "simulation")
    missing = {each.__name__ for each in parts - cases if each.__module__.split(".")[1] in rooms}
    # A base without a body of its own; needs a library that may not be there; one step of a Plant.
    assert missing == {"Obstacle", "ConstrainedVelocity", "PlantStep"}


@every_argument
def test_a_parameter_is_trained_or_refused_by_name(name: str, argument: str) -> None:
    case = CASES[name]
    given = nn.Parameter(case.tensors()[argument])
    part = with_parameter(name, argument, given)
    if isinstance(part, ApccError):
        assert str(part).startswith(f"{argument} is not trained here: ")
        return
    assert any(each is given for each in part.parameters())
    result = case.call(part)
    before = [leaf.detach().clone() for leaf in leaves(result)]
    total(result).backward()
    assert given.grad is not None and bool((given.grad != 0.0).any())
    torch.optim.SGD(part.parameters(), lr=float(1e-4 / given.grad.abs().max())).step()
    assert not same(case.call(part), before)


def test_a_gain_that_is_no_matrix_is_refused_as_a_parameter() -> None:
    for gain in (torch.tensor(2.0), torch.ones(3)):
        with pytest.raises(ApccError, match=r"^K is trained as a matrix: hand in nn.Parameter\("):
            InverseKinematics(K=nn.Parameter(gain))


@every_case
def test_a_part_is_saved_and_copied_whole(name: str) -> None:
    case, part = CASES[name], made(name)
    want = case.call(part)
    assert same(case.call(through_a_file(part)), want)
    assert same(case.call(copy.deepcopy(part)), want)


@every_case
def test_a_state_dict_restores_every_setting(name: str) -> None:
    case, part = CASES[name], made(name)
    other = case.make(**{**needed(name), **case.other()})
    want = case.call(part)
    assert not case.other() or not same(case.call(other), want)
    other.load_state_dict(through_a_file(part.state_dict()))
    assert same(case.call(other), want)


def test_a_state_of_another_class_or_form_is_refused_by_name() -> None:
    with pytest.raises(ApccError, match="the saved state is one of AffineBackbone, this part is PCCBackbone"):
        backbone().load_state_dict(CASES["AffineBackbone"].make().state_dict(), strict=False)
    state = solver().state_dict()
    del state["_extra_state"]["values"]["epsilon"]
    with pytest.raises(ApccError, match="the saved state and this part hold epsilon differently"):
        solver().load_state_dict(state)
    trained = solver(damping=nn.Parameter(torch.tensor(0.1, dtype=D)))
    with pytest.raises(ApccError, match="the saved state and this part hold damping differently"):
        trained.load_state_dict(solver().state_dict())


def test_a_controllers_state_is_saved() -> None:
    of = CASES["APCCController"].make()
    later, _ = of(*arguments(of, 2))
    kept = through_a_file(later)
    assert type(kept) is type(later) and same(kept, later)


def test_a_copy_of_what_asks_for_a_gradient_learns_alone() -> None:
    gain = (1.5 * torch.eye(3, dtype=D)).requires_grad_()
    of = controller(inverse_kinematics=solver(K=gain))
    for other in (copy.deepcopy(of), through_a_file(of)):
        total(controlled(other)).backward()
        assert other.inverse_kinematics.K.grad is not None and gain.grad is None
        assert same(controlled(other), controlled(of))


class Called(nn.Module):
    """A function, with the part that it is a method of, as a module, which is what torch exports."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__()
        self.part, self.function = getattr(function, "__self__", None), function

    def forward(self, *args: Any) -> Any:
        return self.function(*args)


@pytest.mark.filterwarnings("ignore:.torch.jit.trace. is deprecated")
def test_values_are_read_through_one_guard() -> None:
    yes, no = torch.tensor([True, True]), torch.tensor([True, False])
    assert (known(yes), known(no), none_left(~yes), none_left(no), holds(yes), holds(no)) == (True, False) * 3
    assert values_of(no) == [True, False] and values_of(no.all()) is False
    answers: list[Any] = []

    def asked(x: Tensor) -> Tensor:
        answers.append((values_of((x > 0).all()), known(x > 0), none_left(x < 0), holds(x < 0)))
        return x

    x = torch.ones(2)
    vmap(asked)(x)
    asked(x.to("meta"))
    torch.jit.trace(asked, x, check_trace=False)
    torch.export.export(Called(asked), (x,), strict=False)
    assert set(answers) == {(None, False, False, True)}
    grad(lambda x: asked(x).sum())(x)  # has values
    assert answers[-1] == (True, True, True, False)


def shaped(n: int) -> tuple[Tensor, Tensor]:
    return q(n), lengths().expand(n, 2).clone()


STEPS: dict[str, tuple[Callable[[], Callable[..., Any]], Callable[..., tuple[Any, ...]]]] = {
    "tip": (lambda: backbone().tip, shaped),
    "tip_jacobian": (lambda: backbone().tip_jacobian, shaped),
    "StateFeedback": (lambda: feedback(max_iterations=1, min_iterations=1), lambda n: (*shaped(n), poses(n))),
    "InverseKinematics": (
        lambda: solver(null_step=0.1),
        lambda n: (backbone().tip_jacobian(q(n), lengths()), 0.1 * q(n)[:, :3], qdot(n)[:, :3], q(n)),
    ),
    "SoftArmDynamics": (dynamics, lambda n: (q(n), qdot(n), q(n))),
    "ShapeFeedback": (followed, lambda n: (begun(followed(), n), *shaped(n), *seen(n))),
    "the control step along the shape": (led, lambda n: arguments(led(), n)),
    "the control step": (
        lambda: controller(feedback=feedback(max_iterations=1, min_iterations=1)),
        lambda n: arguments(controller(), n),
    ),
}
"""Steps, and arguments of so many rows."""

every_step = pytest.mark.parametrize("name", STEPS)


def close(have: Any, want: Any) -> None:
    torch.testing.assert_close(leaves(have), leaves(want), rtol=1e-9, atol=1e-12)


@every_step
def test_a_step_is_vectorised(name: str) -> None:
    step, inputs = STEPS[name][0](), STEPS[name][1](3)
    want = step(*inputs)
    close(vmap(step, rebuilt(inputs, repeat(0)), rebuilt(want, repeat(0)))(*inputs), want)


def test_gradients_through_algorithm_2_are_vectorised() -> None:
    of, inputs = feedback(), (*shaped(3), poses(3))

    def slope(seed: Tensor, pi_hat: Tensor, T: Tensor) -> Tensor:
        return grad(lambda pi: of(seed, pi, T).q_bar.square().sum())(pi_hat)

    close(vmap(slope)(*inputs), torch.stack([slope(*row) for row in zip(*inputs, strict=True)]))


def test_the_control_step_is_exported_for_any_batch() -> None:
    of = feedback(max_iterations=1, min_iterations=1)
    step, make = controller(feedback=of, inverse_kinematics=solver(null_step=0.1)), STEPS["the control step"][1]
    inputs = make(3)
    shapes = rebuilt(inputs, repeat({0: Dim("batch")}))
    with torch.no_grad():
        program = torch.export.export(step, inputs, dynamic_shapes=shapes, strict=False)
        for rows in (2, 300):  # on either side of where eager code takes another way
            close(program.module()(*make(rows)), step(*make(rows)))


@pytest.mark.parametrize("name", ["tip", "the control step"])
def test_a_step_is_compiled_twice_at_most(name: str) -> None:
    step, make = STEPS[name][0](), STEPS[name][1]
    graphs: list[torch.fx.GraphModule] = []

    def backend(graph: torch.fx.GraphModule, example: list[Tensor]) -> Callable[..., Any]:
        graphs.append(graph)
        return graph.forward

    torch.compiler.reset()
    fast = torch.compile(step, backend=backend, fullgraph=True)
    with torch.no_grad():
        for rows in (1, 4, 7, 32):
            close(fast(*make(rows)), step(*make(rows)))
    assert len(graphs) <= 2


def test_methods_are_compiled_side_by_side() -> None:
    torch.compiler.reset()
    of = backbone()
    for method in (of.section_lengths, of.check, feedback().used):
        for rows in ((), (2,), (3, 2), (2, 3, 2)):  # together more than torch keeps of one code
            inputs = (poses(*rows),) if method.__name__ == "used" else (q(*rows), lengths().expand(*rows, 2))
            torch.compile(method, backend="eager", fullgraph=True, dynamic=False)(*inputs)


@every_case
def test_autocast_leaves_the_numbers_alone(name: str) -> None:
    part = made(name)
    want = CASES[name].call(part)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert same(CASES[name].call(part), want)


@every_step
def test_autocast_leaves_single_precision_alone(name: str) -> None:
    step, inputs = STEPS[name][0](), STEPS[name][1](3)
    inputs = rebuilt(inputs, iter([leaf.float() if leaf.is_floating_point() else leaf for leaf in leaves(inputs)]))
    part = getattr(step, "__self__", step).float()
    step = part if part is step else getattr(part, step.__name__)
    want = step(*inputs)
    assert all(leaf.dtype != D for leaf in leaves(want))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert same(step(*inputs), want)


@every_case
def test_a_part_is_made_and_called_without_values(name: str) -> None:
    with torch.device("meta"):
        part = made(name)
        # Newton's iterations to a shape at rest do not end without values, and are too many for a test.
        result = () if name == "LoadFromShape" else CASES[name].call(part)
    held = [*part.parameters(), *part.buffers(), *leaves(result)]
    assert {leaf.device.type for leaf in held} <= {"meta"}


@every_case
def test_a_part_follows_its_tensors_whatever_the_default_device_is(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    want = CASES[name].call(made(name))
    monkeypatch.setitem(WHERE, "device", torch.device("cpu"))
    with torch.device("meta"):
        assert same(CASES[name].call(made(name)), want)

"""Stretches of a loop whose operations no gradient remembers: they are done again when the gradient comes back."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from apcc_torch.errors import GradientError
from apcc_torch.native.structure import flattened, rebuilt

Stretch = Callable[[Any, Any], Any]
"""(state, what else it is given) -> (nested) tuples of tensors; without chance of its own."""
_Leaf: Any = torch._C._functions.AccumulateGrad  # type: ignore[attr-defined]


class Forgotten:
    """Runs stretches that keep nothing but their state for a gradient.

    The gradient goes to the state, to what each stretch is given, and to every tensor that the first one uses, wherever
    it has that from. It cannot be differentiated once more.

    Example:
        >>> gain = torch.tensor(3.0, requires_grad=True)
        >>> run = Forgotten(lambda now, push: (gain * now[0].sin() + push,))
        >>> (later,) = run(run((torch.tensor(0.5),), 0.0), 0.1)
        >>> torch.autograd.grad(later, gain)
        (tensor(1.1813),)
    """

    def __init__(self, stretch: Stretch) -> None:
        self._stretch = stretch
        self._used: list[Tensor] | None = None
        self._outside: list[Tensor] = []
        self._related = False

    def __call__(self, state: Any, given: Any) -> Any:
        """The stretch's result.

        Raises:
            GradientError: In the gradient, where it is differentiated again, or leads to a tensor that the first
                stretch did not show to a function of torch.
        """
        first = flattened(state)
        plain = rebuilt(state, iter([leaf.detach() for leaf in first]))
        seen = _Seen()
        with torch.no_grad():
            if self._used is None:
                with seen:
                    after = self._stretch(plain, given)
                self._used = list(seen.tensors.values())
            else:
                after = self._stretch(plain, given)
        outcome = flattened(after)
        # What is handed out as it came in was shown to no function.
        others = [leaf for leaf in (*self._used, *_tensors(given), *outcome) if leaf.requires_grad]
        outside = list({id(leaf): leaf for leaf in others}.values())
        inputs = [*first, *outside]
        if not any(leaf.requires_grad for leaf in inputs):
            return after
        if len(outside) != len(self._outside) or any(a is not b for a, b in zip(outside, self._outside, strict=True)):
            self._outside, self._related = outside, _related(outside)
        job = self._stretch, state, given, outside, self._related
        return rebuilt(after, iter(_Again.apply(job, [leaf.detach() for leaf in outcome], *inputs)))


class _Again(torch.autograd.Function):
    """The outcome of a stretch as it is, with the stretch's gradient."""

    @staticmethod
    def forward(ctx: Any, job: Any, outcome: list[Tensor], *inputs: Tensor) -> tuple[Tensor, ...]:
        ctx.job = job
        ctx.save_for_backward(*inputs)
        ctx.mark_non_differentiable(*(leaf for leaf in outcome if not leaf.is_floating_point()))
        ctx.set_materialize_grads(False)
        return tuple(outcome)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        _ = ctx.saved_tensors  # says where one was written into meanwhile
        if torch.is_grad_enabled():
            raise GradientError(
                "a checkpointed loop has no second derivatives; checkpointed=False keeps what they need"
            )
        stretch, form, given, outside, related = ctx.job
        state = [leaf.detach().requires_grad_(leaf.requires_grad) for leaf in flattened(form)]
        # Where one tensor follows from another that is used as well, each stands for itself alone.
        alone = [leaf.detach().requires_grad_() for leaf in outside] if related else outside
        seen = _Seen({id(leaf): other for leaf, other in zip(outside, alone, strict=True)})
        with torch.enable_grad(), seen if related else nullcontext():
            after = stretch(rebuilt(form, iter(state)), given)
        outcome = [seen.shown(leaf) for leaf in flattened(after)]
        asked = [(leaf, g) for leaf, g in zip(outcome, gradients, strict=True) if g is not None and leaf.requires_grad]
        leaves, pulled = [leaf for leaf, _ in asked], [g for _, g in asked]
        inputs = [leaf for leaf in (*state, *alone) if leaf.requires_grad]
        _refuse_others(leaves, inputs)
        found = iter(torch.autograd.grad(leaves, inputs, pulled, allow_unused=True) if asked else [None] * len(inputs))
        return None, None, *(next(found) if leaf.requires_grad else None for leaf in (*state, *alone))


class _Seen(TorchFunctionMode):
    """Sees the tensors that ask for a gradient as functions of torch are given them, and may put others in their place.

    tensors: By their ids; held, so that no other gets one.
    """

    def __init__(self, instead: dict[int, Tensor] | None = None) -> None:
        super().__init__()
        self.tensors: dict[int, Tensor] = {}
        self._instead = instead or {}

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return func(*self._all(args), **{key: self._all(item) for key, item in (kwargs or {}).items()})

    def shown(self, tensor: Tensor) -> Tensor:
        """What stands in place of a tensor."""
        if tensor.requires_grad:
            self.tensors[id(tensor)] = tensor
        return self._instead.get(id(tensor), tensor)

    def _all(self, item: Any) -> Any:
        if isinstance(item, Tensor):
            return self.shown(item)
        return type(item)([self._all(part) for part in item]) if type(item) in (tuple, list) else item


def _tensors(item: Any) -> Iterator[Tensor]:
    if isinstance(item, Tensor):
        yield item
    elif isinstance(item, (tuple, list)):
        for part in item:
            yield from _tensors(part)


def _leaves(begin: Iterable[Any], ends: set[Any]) -> tuple[list[Tensor], bool]:
    """The tensors to which a graph leads, and whether it meets the ends, beyond which it is not followed."""
    stack, met, leaves = list(begin), {None}, list[Tensor]()
    while stack:
        node = stack.pop()
        if node in met:
            continue
        met.add(node)
        if node in ends:
            continue
        if type(node) is _Leaf:
            leaves.append(node.variable)
        else:
            stack += [following for following, _ in node.next_functions]
    return leaves, not met.isdisjoint(ends - {None})


def _related(tensors: list[Tensor]) -> bool:
    """Whether one of these tensors follows from another."""
    nodes: set[Any] = {leaf.grad_fn for leaf in tensors}
    before = [following for node in nodes - {None} for following, _ in node.next_functions]
    leaves, met = _leaves(before, nodes)
    return met or not {id(leaf) for leaf in leaves}.isdisjoint(map(id, tensors))


def _refuse_others(outcome: list[Tensor], inputs: list[Tensor]) -> None:
    """Raises where a graph leads to other tensors than these: their gradient would be lost."""
    known = {id(leaf) for leaf in inputs}
    for leaf in _leaves([leaf.grad_fn for leaf in outcome], {leaf.grad_fn for leaf in inputs})[0]:
        if id(leaf) not in known:
            raise GradientError(
                f"a checkpointed loop lost a tensor {tuple(leaf.shape)} that asks for a gradient: the first periods "
                "did not use it, or gave it to a function of their own alone; checkpointed=False finds it"
            )

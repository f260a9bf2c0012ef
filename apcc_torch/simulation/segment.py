"""A stretch of a loop whose operations no gradient remembers: they are done again when the gradient comes back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.autograd.graph import Node
from torch.overrides import TorchFunctionMode

from apcc_torch.errors import GradientError
from apcc_torch.native.structure import flattened, rebuilt

S = TypeVar("S")
Stretch = Callable[[Any], Any]
"""From a tree of tensors to another, without chance of its own."""


def forgotten(stretch: Stretch, state: Any) -> Any:
    """What a stretch makes of a state, with its gradient, but without a record of its operations.

    A gradient goes to the state and to every tensor that the stretch uses, wherever it has it from; the stretch runs
    again for it. It cannot be differentiated once more.

    Args:
        stretch: From (nested) tuples of tensors to such.
        state: Of the first.

    Raises:
        GradientError: In the gradient, where one is asked of a gradient, or goes to a tensor that only a function of
            the stretch's own uses, which torch does not show.

    Example:
        >>> gain = torch.tensor(3.0, requires_grad=True)
        >>> (later,) = forgotten(lambda now: (gain * now[0].sin(),), (torch.tensor(0.5),))
        >>> torch.autograd.grad(later, gain)
        (tensor(0.4794),)
    """
    first, used = flattened(state), _Used()
    given = rebuilt(state, iter([leaf.detach() for leaf in first]))
    with torch.no_grad(), used:
        after = stretch(given)
    outcome = flattened(after)
    for leaf in outcome:  # what is handed out as it came in
        used.note(leaf)
    inputs = list({id(leaf): leaf for leaf in [*first, *used.tensors.values()] if leaf.requires_grad}.values())
    if not inputs:
        return after
    made = _Forgotten.apply(stretch, state, [leaf.detach() for leaf in outcome], *inputs)
    return rebuilt(after, iter(made))


class _Used(TorchFunctionMode):
    """Sees the tensors that ask for a gradient as functions of torch are given them, and may put others in their place.

    tensors: By their ids; held, so that no other gets one.
    """

    def __init__(self, instead: dict[int, Tensor] | None = None) -> None:
        super().__init__()
        self.tensors: dict[int, Tensor] = {}
        self._instead = instead

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return func(*self._seen(args), **{key: self._seen(item) for key, item in (kwargs or {}).items()})

    def note(self, tensor: Tensor) -> Tensor:
        """What stands in place of a tensor."""
        if self._instead is not None:
            return self._instead.get(id(tensor), tensor)
        if tensor.requires_grad:
            self.tensors[id(tensor)] = tensor
        return tensor

    def _seen(self, item: Any) -> Any:
        if isinstance(item, Tensor):
            return self.note(item)
        if type(item) in (tuple, list):
            return type(item)([self._seen(part) for part in item])
        return item


class _Forgotten(torch.autograd.Function):
    """The outcome of a stretch as it is, with the gradient of the stretch."""

    @staticmethod
    def forward(ctx: Any, stretch: Stretch, state: Any, outcome: list[Tensor], *inputs: Tensor) -> tuple[Tensor, ...]:
        # The inputs themselves too: they are told by their ids.
        ctx.stretch, ctx.form, ctx.inputs = stretch, state, inputs
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
        instead = {id(leaf): leaf.detach().requires_grad_() for leaf in ctx.inputs}
        first = [instead.get(id(leaf), leaf) for leaf in flattened(ctx.form)]
        used = _Used(instead)
        with torch.enable_grad(), used:
            outcome = [used.note(leaf) for leaf in flattened(ctx.stretch(rebuilt(ctx.form, iter(first))))]
        asked = [(leaf, g) for leaf, g in zip(outcome, gradients, strict=True) if g is not None and leaf.requires_grad]
        _refuse_others([leaf for leaf, _ in asked], list(instead.values()))
        found: tuple[Tensor | None, ...] = (None,) * len(ctx.inputs)
        if asked:
            leaves, pulled = zip(*asked, strict=True)
            found = torch.autograd.grad(leaves, list(instead.values()), pulled, allow_unused=True)
        return None, None, None, *found


def _refuse_others(outcome: list[Tensor], known: list[Tensor]) -> None:
    """Raises where a graph leads to other tensors than these: their gradient would be lost."""
    inside = set(map(id, known))
    stack = [leaf.grad_fn for leaf in outcome]
    met: set[Node] = set()
    while stack:
        node = stack.pop()
        if node is None or node in met:
            continue
        met.add(node)
        leaf = getattr(node, "variable", None)
        if leaf is not None and id(leaf) not in inside:
            raise GradientError(
                f"a checkpointed loop lost a tensor {tuple(leaf.shape)} that asks for a gradient: only a function of "
                "the loop's own uses it; hand it to one of torch first, as in x * 1.0, or take checkpointed=False"
            )
        stack += [following for following, _ in node.next_functions]

"""Functions as machine code whose gradient is machine code too."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from apcc_torch.errors import CompileError, GradientError
from apcc_torch.native.fingerprint import Fingerprint
from apcc_torch.native.function import NativeFunction
from apcc_torch.native.source import Plan
from apcc_torch.native.structure import flattened, rebuilt
from apcc_torch.native.trace import traced
from apcc_torch.native.transpose import transposed


class DifferentiableFunction:
    """A function as machine code, as `NativeFunction` has it, with a gradient by its arguments: machine code too.

    What the module holds is a constant; hand in as an argument what a gradient is asked by. Gradients are torch's to
    rounding where the function is smooth. There are no second derivatives.

    Args:
        module: As of `NativeFunction`; it repeats nothing on its own result (`repetition.repeated`), and none of its
            settings differ from row to row.
        example: One row of arguments.
        threads: As of `NativeFunction`.

    Raises:
        CompileError: It cannot be compiled, or its settings differ from row to row.

    Example:
        >>> backbone, L0 = PCCBackbone(1), torch.tensor([0.2])
        >>> tip = DifferentiableFunction(backbone.tip, (torch.zeros(3), L0))
        >>> lengths = L0.clone().requires_grad_()
        >>> torch.autograd.grad(tip(torch.zeros(3), lengths)[2], lengths)
        (tensor([1.]),)
    """

    def __init__(
        self, module: nn.Module | Callable[..., Any], example: tuple[Any, ...], threads: int | None = None
    ) -> None:
        self.function = NativeFunction(module, example, threads=threads)
        self.pulled = _Pulled(self.function)

    def __call__(self, *args: Any) -> Any:
        """The module's result for these arguments, leading dimensions broadcast.

        Raises:
            ShapeError, DtypeError: As of `NativeFunction`.
            CompileError: In the gradient, where it cannot be compiled.
            GradientError: In the gradient, where it is differentiated again.
        """
        form = self.function.like
        return rebuilt(form, iter(_Called.apply(self, args, *flattened(args))))


class _Called(torch.autograd.Function):
    """One call, and its gradient."""

    @staticmethod
    def forward(ctx: Any, owner: DifferentiableFunction, args: Any, *leaves: Tensor) -> tuple[Tensor, ...]:
        ctx.owner = owner
        ctx.save_for_backward(*leaves)
        found = flattened(owner.function(*args))
        ctx.mark_non_differentiable(*(leaf for leaf in found if not leaf.is_floating_point()))
        return tuple(found)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():
            raise GradientError("a function as machine code has no second derivatives: call the module itself")
        leaves, function = ctx.saved_tensors, ctx.owner.function
        results = zip(gradients, flattened(function.like), strict=True)
        asked = tuple(gradient for gradient, like in results if like.is_floating_point())
        found = iter(flattened(ctx.owner.pulled(rebuilt(function.example, iter(leaves)), asked)))
        # One gradient a row: of what rows share the sum.
        shares = [next(found).sum_to_size(leaf.shape) if leaf.is_floating_point() else None for leaf in leaves]
        return None, None, *shares


class _Transposed(nn.Module):
    """(arguments, gradients by the results) -> gradients by the arguments; both flat, of floating-point numbers."""

    def __init__(self, of: nn.Module) -> None:
        super().__init__()
        self.of = of

    def forward(self, given: tuple[Any, ...], gradients: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        """By torch."""
        with torch.inference_mode(False), torch.enable_grad():
            leaves = [leaf.clone().requires_grad_(leaf.is_floating_point()) for leaf in flattened(given)]
            asked = [leaf for leaf in leaves if leaf.requires_grad]
            found = [leaf for leaf in flattened(self.of(*rebuilt(given, iter(leaves)))) if leaf.is_floating_point()]
            pairs = [(leaf, g.clone()) for leaf, g in zip(found, gradients, strict=True) if leaf.requires_grad]
            results, pulled = [leaf for leaf, _ in pairs], [g for _, g in pairs]
            if not pairs:
                return tuple(torch.zeros_like(leaf) for leaf in asked)
            slopes = torch.autograd.grad(results, asked, pulled, allow_unused=True, materialize_grads=True)
        return tuple(slope.detach() for slope in slopes)


class _Pulled(NativeFunction):
    """The same as machine code: written from the function's own trace."""

    def __init__(self, function: NativeFunction) -> None:
        if function.rows:
            raise CompileError("a gradient in machine code takes no settings that differ from row to row")
        self._function = function
        zeros = tuple(torch.zeros_like(leaf) for leaf in flattened(function.like) if leaf.is_floating_point())
        super().__init__(_Transposed(function.module), (function.example, zeros), threads=function.threads)

    def _plan(self, lanes: int, told: Fingerprint) -> Plan:
        with torch.inference_mode(False):
            trace = traced(self._function.module, self._function.example, told.held, told.described, shares=False)
        return Plan(transposed(trace), lanes, self._dtype, [])

"""How the numbers that a program reads follow from the tensors that its module holds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Self

from torch import Tensor

from apcc_torch.native.folding import LOOSE, Constant, folded
from apcc_torch.native.scalars import Scalars

HELD, PLAIN = "held", "plain"


class ProgramNumbers(NamedTuple):
    """The numbers of a program as a few operations, so that a module of other numbers need not be traced again.

    A trace takes its form from what a module holds only where an operation on held numbers comes to zero, to an integer
    or to a truth value. All of these are noted, and where one comes out otherwise, this program is not that module's.
    It all goes through JSON unchanged.

    steps: What is computed, each from steps before it: (operation, *steps), ("held", tensor, entry), ("plain", number).
    decided: Operations on steps that have to come to what they came to: (operation, steps, outcome).
    asked: The steps that the program reads.
    """

    steps: list[list[Any]]
    decided: list[list[Any]]
    asked: list[int]

    @classmethod
    def of(cls, scalars: Scalars, asked: list[int]) -> Self:
        """Those of a trace.

        Args:
            scalars: Its expressions.
            asked: The expressions whose numbers the program reads.
        """
        steps: list[list[Any]] = []
        place: dict[int, int] = {}

        def step(index: int) -> int:
            if index not in place:
                op, operands, _, value = scalars[index]
                if op == "held" and index in scalars.held_at:
                    made = [HELD, *scalars.held_at[index]]
                elif operands:
                    made = [op, *map(step, operands)]
                else:
                    made = [PLAIN, value]
                place[index] = len(steps)
                steps.append(made)
            return place[index]

        for index, expression in enumerate(scalars.expressions):
            # Also what this program does not read: the form hangs on its not being zero.
            if expression.operands and expression.value is not None:
                step(index)
        decided = [[op, [step(i) for i in operands], outcome] for (op, operands), outcome in scalars.decided.items()]
        return cls(steps, decided, [step(index) for index in asked])

    @classmethod
    def plain(cls, values: list[float]) -> Self:
        """Numbers that follow from nothing."""
        return cls([[PLAIN, value] for value in values], [], list(range(len(values))))

    def values(self, held: Sequence[Tensor]) -> list[float] | None:
        """The numbers of a module that holds these tensors; None where the program is not that module's."""
        entries = [tensor.detach().flatten().tolist() for tensor in held]
        found: list[Constant] = []
        loose: list[float] = []
        for op, *operands in self.steps:
            if op == PLAIN:
                found.append(operands[0])
                loose.append(0.0)
                continue
            if op == HELD:
                value = entries[operands[0]][operands[1]]
                off = LOOSE * abs(value)
            else:
                value, off = folded(op, [found[k] for k in operands], [loose[k] for k in operands])
            if value is None or (value == 0.0 and off == 0.0):
                return None
            found.append(float(value))
            loose.append(off)
        for op, operands, outcome in self.decided:
            value, off = folded(op, [found[k] for k in operands], [loose[k] for k in operands])
            if value is None or outcome is None:
                same = value is outcome
            else:
                same = repr(type(outcome)(value)) == repr(outcome) and (type(outcome) is not float or off == 0.0)
            if not same:
                return None
        return [float(found[k] or 0.0) for k in self.asked]

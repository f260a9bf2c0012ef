"""Writes a repetition out once, as a loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any, Protocol

from torch import Tensor

from apcc_torch.errors import CompileError
from apcc_torch.native.scalars import BOOL, Loop
from apcc_torch.native.structure import flattened, rebuilt
from apcc_torch.native.values import Arithmetic, Value


class Recorder(Protocol):
    """What notes torch's operations; `inner` is the innermost loop that is being written out."""

    arithmetic: Arithmetic

    @property
    def inner(self) -> int | None: ...
    def within(self, loop: int) -> AbstractContextManager[None]: ...
    def value(self, item: Any) -> Any: ...
    def symbols(self, like: list[Tensor], values: list[Value], indices: list[int]) -> Sequence[Tensor]: ...
    def truth(self, condition: Tensor) -> int: ...


def looped(
    recorder: Recorder,
    body: Callable[[Any], Any],
    state: Any,
    times: int,
    going: Callable[[Any], Tensor],
    begun: Tensor,
) -> Any:
    """As `repetition.repeated`, in expressions.

    A known number of the state that no round changes is no variable of the loop; which these are, is found by writing
    the body out until none changes. What does not depend on the state is computed before the loop.

    Args:
        recorder: What notes torch's operations.
        body, state, times, going: As `repetition.repeated`, times 2 or more.
        begun: going(state).

    Raises:
        CompileError: The body changes the form of the state.
    """
    scalars = recorder.arithmetic.scalars
    leaves = flattened(state)
    values = [recorder.value(leaf) for leaf in leaves]
    initial = [index for value in values for index in value.entries.flatten().tolist()]
    kinds = [scalars[index].kind for index in initial]
    fixed = {k for k, index in enumerate(initial) if scalars[index].op == "constant"}
    while True:
        number = len(scalars.loops)
        loop = Loop(recorder.inner, times)
        scalars.loops.append(loop)
        entered = [
            index if k in fixed else scalars.entry("variable", number, k, kinds[k]) for k, index in enumerate(initial)
        ]
        given = rebuilt(state, iter(recorder.symbols(leaves, values, entered)))
        with recorder.within(number):
            after = body(given)
            more = going(after)
        changed = flattened(after)
        outcome = [recorder.value(leaf) for leaf in changed]
        _check(values, outcome)
        results = [index for value in outcome for index in value.entries.flatten().tolist()]
        moved = {k for k in fixed if results[k] != initial[k]}
        if not moved:
            break
        fixed -= moved
    loop.initial, loop.results, loop.variables = initial, results, entered
    loop.outcomes = [
        index if k in fixed else scalars.entry("outcome", number, k, kinds[k]) for k, index in enumerate(initial)
    ]
    loop.going = len(initial)
    loop.initial.append(recorder.truth(begun))
    loop.results.append(recorder.truth(more))
    loop.variables.append(scalars.entry("variable", number, loop.going, BOOL))
    return rebuilt(after, iter(recorder.symbols(changed, outcome, loop.outcomes)))


def _check(before: list[Value], after: list[Value]) -> None:
    forms = [[(tuple(value.entries.shape), value.dtype) for value in values] for values in (before, after)]
    if forms[0] != forms[1]:
        raise CompileError(f"a repeated step must hand on what it was given: {forms[0]} became {forms[1]}")

"""Writes out once what a function does at several places, as a routine that is called."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from types import MethodType
from typing import Any, NamedTuple

from torch import Tensor

from apcc_torch.native.loops import Recorder
from apcc_torch.native.scalars import Loop, Returned
from apcc_torch.native.structure import described, flattened, rebuilt
from apcc_torch.native.values import Value

_NUMBERS = (bool, int, float, str)


class _Written(NamedTuple):
    """A routine that was written out.

    number: Among the loops. like: What the function returned, and its tensors. outcome: The expressions of these.
    places: Where in the routine's state each expression is that hangs on what is handed in.
    """

    number: int
    like: Any
    changed: list[Tensor]
    outcome: list[Value]
    places: dict[int, int]


class Routines:
    """Functions that are written out once for all calls that differ in values alone.

    Calls are alike where they are of one function, in one loop, with arguments of the same forms, numbers and known
    entries, and where the same entries of theirs are equal.

    Args:
        recorder: What notes torch's operations.
    """

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._written: dict[Any, _Written] = {}
        self._met: list[Any] = []  # what is gone leaves its id to others

    def called(self, function: Callable[..., Any], args: tuple[Any, ...], within: tuple[int, ...]) -> Any:
        """As `repetition.shared`, in expressions.

        Args:
            function, args: As there.
            within: The loops that are being written out.
        """
        scalars = self._recorder.arithmetic.scalars
        plain = tuple((k, repr(arg)) for k, arg in enumerate(args) if isinstance(arg, _NUMBERS))
        tensors = tuple(None if isinstance(arg, _NUMBERS) else arg for arg in args)
        leaves = flattened(tensors)
        values = [self._recorder.value(leaf) for leaf in leaves]
        given = _entries(values)
        handed = {index: k for k, index in enumerate(dict.fromkeys(i for i in given if scalars.known(i) is None))}
        who = (function.__func__, id(function.__self__)) if isinstance(function, MethodType) else (function, 0)
        pattern = tuple(-1 - handed[index] if index in handed else index for index in given)
        key = who, within, plain, described(tensors), tuple(leaf.stride() for leaf in leaves), pattern
        if key not in self._written:
            self._met.append(function)
            self._written[key] = self._write(function, args, values, list(handed))
        made = self._written[key]
        routine = scalars.loops[made.number]
        call = len(routine.calls)
        routine.calls.append(list(handed))
        results = [
            scalars.returned(Returned(made.number, call, made.places[index]), scalars[index].kind)
            if index in made.places
            else index
            for index in _entries(made.outcome)
        ]
        return rebuilt(made.like, iter(self._recorder.symbols(made.changed, made.outcome, results)))

    def _write(
        self, function: Callable[..., Any], args: tuple[Any, ...], values: list[Value], handed: list[int]
    ) -> _Written:
        recorder, scalars = self._recorder, self._recorder.arithmetic.scalars
        number = len(scalars.loops)
        routine = Loop(recorder.inner, 1)
        scalars.loops.append(routine)

        def variable(index: int) -> int:
            place = len(routine.variables)
            routine.variables.append(scalars.entry("variable", number, place, scalars[index].kind))
            return routine.variables[-1]

        inside = {index: variable(index) for index in handed}
        entered = [inside.get(index, index) for index in _entries(values)]
        tensors = tuple(None if isinstance(arg, _NUMBERS) else arg for arg in args)
        given = rebuilt(tensors, iter(recorder.symbols(flattened(tensors), values, entered)))
        with recorder.within(number):
            like = function(*(arg if isinstance(arg, _NUMBERS) else new for arg, new in zip(args, given, strict=True)))
        changed = flattened(like)
        outcome = [recorder.value(leaf) for leaf in changed]
        results = dict.fromkeys(index for index in _entries(outcome) if scalars.known(index) is None)
        routine.results = [*routine.variables, *results]
        places = {index: scalars.entry_of[variable(index)].place for index in results}
        return _Written(number, like, changed, outcome, places)


def _entries(values: Iterable[Value]) -> list[int]:
    return [index for value in values for index in value.entries.flatten().tolist()]

"""The environments' physics as machine code: what is compiled, and the memory that it moves to and fro."""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn

from apcc_torch.control.step_io import ControllerState
from apcc_torch.envs.dynamic import DynamicArm
from apcc_torch.envs.kinematic import KinematicState
from apcc_torch.envs.looking_ahead import RowsAhead, plans
from apcc_torch.envs.outcome import Outcome, View
from apcc_torch.envs.prepared import Draw, Listed, Prepared
from apcc_torch.envs.row_trees import map_rows
from apcc_torch.envs.sensing import Readings
from apcc_torch.envs.simulator import EnvState, Simulator
from apcc_torch.envs.streams import Stream, streams
from apcc_torch.native.function import NativeFunction, Ready
from apcc_torch.native.structure import flattened, rebuilt
from apcc_torch.simulation.plant_state import PlantState


class Moved(NamedTuple):
    """What a step changes of a row, see `EnvState` and `Readings`; queue is None where no reading is late."""

    arm: KinematicState | PlantState
    q_d: Tensor
    y: Tensor
    controller: ControllerState | None
    queue: Tensor | None
    seen: Tensor
    step: Tensor

    @classmethod
    def of(cls, state: EnvState, late: bool) -> Moved:
        """That part of a state; `late` says whether any reading is."""
        queue = state.readings.queue if late else None
        return cls(state.arm, state.q_d, state.y, state.controller, queue, state.readings.seen, state.step)

    def within(self, state: EnvState, before: Tensor) -> EnvState:
        """A state with this in place of its own, whose last readings were `before`."""
        queue = self.seen.unsqueeze(1) if self.queue is None else self.queue
        readings, step = Readings(queue, self.seen, before), self.step
        moved = {name: getattr(self, name) for name in ("arm", "q_d", "y", "controller")}
        return state._replace(**moved, readings=readings, step=step)


class Transition(nn.Module):
    """A step of one row, without leading dimensions, as a function of all that it depends on."""

    def __init__(self, simulator: Simulator) -> None:
        super().__init__()
        self.simulator = simulator

    def forward(self, state: EnvState, action: Tensor) -> tuple[Moved, Outcome, Tensor]:
        """What changes, what came of it, and what is observed again; the state's stream is `Prepared`."""
        state, action = _batched((state, action))
        later, outcome = self.simulator(state, action)
        moved = Moved.of(later, self.simulator.sensing.longest > 0)
        row: tuple[Moved, Outcome, Tensor] = _unbatched((moved, outcome, outcome.view.observation))
        return row


class Beginning(nn.Module):
    """The start of one row's episode, likewise."""

    def __init__(self, simulator: Simulator) -> None:
        super().__init__()
        self.simulator = simulator

    def forward(self, prepared: Prepared) -> tuple[EnvState, View]:
        """The state, without a stream, and what it looks like."""
        state = self.simulator.initial(cast(Stream, _batched(prepared)))  # it answers as one
        view = self.simulator.view(state)
        row: tuple[EnvState, View] = _unbatched((state._replace(stream=None), view))  # type: ignore[arg-type]
        return row


class Standing:
    """Rows that machine code moves between two pieces of memory: a step makes no tensors but those that it hands out.

    Args:
        transition: `Transition` as machine code.
        state: At which the rows stand.
        action, prepared: Of the form that every step has.
        late: Whether any reading is.
    """

    def __init__(
        self, transition: NativeFunction, state: EnvState, action: Tensor, prepared: Prepared, late: bool
    ) -> None:
        first = map_rows(torch.clone, Moved.of(state, late))
        pieces = first, map_rows(torch.empty_like, first)
        self._later, self._views, self._ready = list[EnvState](), list[Tensor](), list[Ready]()
        for here, there in (pieces, pieces[::-1]):
            # What was read before is not asked for: it is what is seen now.
            now = here.within(state, there.seen)._replace(stream=cast(Stream, prepared))
            given = flattened((now, action))
            _, outcome, again = transition.blank(given)
            self._later.append(there.within(state, here.seen))
            self._views.append(outcome.view.observation)
            self._ready.append(transition.bound(given, flattened((there, outcome, again))))
        numbers = rebuilt((now, action), iter(range(len(given))))
        self._taken = [*numbers[0].stream.numbers, numbers[1]]
        handed_out, begin = flattened((outcome[1:], again)), len(flattened(first)) + 1
        error: Tensor = outcome.view.error
        self._handed_out = [(begin + k, each.shape, each.dtype) for k, each in enumerate((error, *handed_out))]
        self._turn = 0

    def __call__(self, action: Tensor, prepared: Prepared) -> tuple[EnvState, Outcome, Tensor]:
        """The rows a step later, with the stream that they began with; what came of it; what is observed again."""
        turn, ready = self._turn, self._ready[self._turn]
        for number, tensor in zip(self._taken, (*prepared.numbers, action), strict=True):
            ready.read_from(number, tensor.contiguous())
        made = []
        for number, shape, dtype in self._handed_out:
            made.append(torch.empty(shape, dtype=dtype))
            ready.write_to(number, made[-1])
        ready()
        self._turn = 1 - turn
        error, reward, truncated, reason, again = made
        return self._later[turn], Outcome(View(self._views[turn], error), reward, truncated, reason), again


class ByMachineCode:
    """The simulator as machine code: the same numbers to rounding, on the CPU.

    The random numbers are drawn before each call, by torch, and only where some are asked for. A leaning dynamic arm
    looks for its rest in many steps, which would make much code that seldom runs: there torch begins episodes.

    Args:
        simulator: What is compiled.
        rows: How many there are.

    Raises:
        CompileError: It cannot be had.
    """

    def __init__(self, simulator: Simulator, rows: int) -> None:
        self.simulator, self.dtype = simulator, simulator.nominal.dtype
        self._single = rows == 1
        self._starts, self._draws = list[Draw](), list[Draw]()
        stream, action = streams(0, 1, simulator.nominal.device), simulator.nominal.new_zeros(1, simulator.action_size)
        with torch.no_grad():
            state = simulator.initial(cast(Stream, Listed(stream, self._starts)))
            simulator(state._replace(stream=cast(Stream, Listed(stream, self._draws))), action)
        starts, draws = (Prepared.of(stream, each, self.dtype)[1] for each in (self._starts, self._draws))
        now = state._replace(stream=cast(Stream, draws))
        self._transition = NativeFunction(Transition(simulator), _unbatched((now, action)))
        leans = isinstance(simulator.arm, DynamicArm) and simulator.arm.leans
        self._beginning = None if leans else NativeFunction(Beginning(simulator), (_unbatched(starts),))
        # Here: where it cannot be had, the first step would be late to say so.
        for function in (self._transition, self._beginning):
            if function is not None:
                function.program(function.lanes(rows))
        self._ahead = RowsAhead.of(simulator, rows, "aot")
        self._standing: Standing | None = None
        self._now: EnvState | None = None

    def begun(self, stream: Stream) -> tuple[EnvState, View]:
        """See `Stepping`."""
        if self._beginning is None:
            state = self.simulator.initial(stream)
            return state, self.simulator.view(state)
        count = len(stream.key)
        if count == 1 and not self._single:  # one of many: by the code of many, as its row has always been
            stream = map_rows(lambda each: each.expand(2), stream)
        later, prepared = Prepared.of(stream, self._starts, self.dtype)
        begun: tuple[EnvState, View] = self._beginning(prepared)
        state, view = begun[0]._replace(stream=later), begun[1]
        return map_rows(lambda each: each[:count], (state, view)) if len(later.key) > count else (state, view)

    def __call__(self, state: EnvState, action: Tensor) -> tuple[EnvState, Outcome, Tensor]:
        """See `Stepping`."""
        stream, prepared = Prepared.of(state.stream, self._draws, self.dtype)
        action = action.to(self.dtype)
        if self._standing is None or state is not self._now:
            late = self.simulator.sensing.longest > 0
            self._standing = Standing(self._transition, state, action, prepared, late)
        later, outcome, again = self._standing(action, prepared)
        if self._ahead is not None:
            # Into the rows' own memory: from there the next step begins.
            map_rows(Tensor.copy_, plans(later), self._ahead(later, outcome.truncated))
        self._now = later if stream is state.stream else later._replace(stream=stream)
        return self._now, outcome, again

    def snapshot(self, state: EnvState) -> EnvState:
        """See `Stepping`: a copy, for the state's own memory is written into."""
        return map_rows(torch.clone, state)


def _batched(tree: Any) -> Any:
    return map_rows(lambda each: each.unsqueeze(0), tree)


def _unbatched(tree: Any) -> Any:
    return map_rows(lambda each: each.squeeze(0), tree)

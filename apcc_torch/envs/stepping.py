"""How the environments' physics is run: by torch, or as machine code."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

from apcc_torch.envs.looking_ahead import RowsAhead, with_plans
from apcc_torch.envs.machine_code import ByMachineCode
from apcc_torch.envs.outcome import Outcome, View
from apcc_torch.envs.simulator import EnvState, Simulator
from apcc_torch.envs.streams import Stream
from apcc_torch.native.compiled import TorchStep, machine_code


class Stepping(Protocol):
    """Rows that begin, and that go on. A state that is handed in may be written into."""

    def begun(self, stream: Stream) -> tuple[EnvState, View]:
        """Rows at the start of an episode, and what they look like."""
        ...

    def __call__(self, state: EnvState, action: Tensor) -> tuple[EnvState, Outcome, Tensor]:
        """As `Simulator.forward`, and the observation once more, in memory of its own."""
        ...

    def snapshot(self, state: EnvState) -> EnvState:
        """The state for somebody else, who may keep it."""
        ...


class ByTorch:
    """The simulator as it is, or its step through `torch.compile`; so many rows where they look ahead."""

    def __init__(self, simulator: Simulator, inductor: bool, rows: int) -> None:
        self.simulator = simulator
        self._step = TorchStep(simulator, inductor)
        self._ahead = RowsAhead.of(simulator, rows, "inductor" if inductor else "off")

    def begun(self, stream: Stream) -> tuple[EnvState, View]:
        """See `Stepping`."""
        state = self.simulator.initial(stream)
        return state, self.simulator.view(state)

    def __call__(self, state: EnvState, action: Tensor) -> tuple[EnvState, Outcome, Tensor]:
        """See `Stepping`."""
        later, outcome = self._step(state, action)
        if self._ahead is not None:
            later = with_plans(later, self._ahead(later, outcome.truncated))
        return later, outcome, outcome.view.observation.clone()

    def snapshot(self, state: EnvState) -> EnvState:
        """See `Stepping`."""
        return state


def stepping(simulator: Simulator, rows: int, mode: str) -> Stepping:
    """The simulator run as `mode` says, see `native.compiled`; on a GPU "auto" is "inductor".

    Raises:
        ValueRangeError: There is no such mode.
        CompileError: "aot" is asked for and cannot be had.
    """
    if mode == "auto" and simulator.nominal.device.type != "cpu":
        mode = "inductor"
    made = machine_code(lambda: ByMachineCode(simulator, rows), mode, "the environment's step")
    return ByTorch(simulator, mode == "inductor", rows) if made is None else made

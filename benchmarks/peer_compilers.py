"""torch's own compilers on a step: `torch.compile`, and AOTInductor's library of the exported step."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from subjects import steps
from timing import timed_steps
from torch import Tensor, nn

from apcc_torch.native.compiled import TorchStep
from apcc_torch.native.structure import flattened, rebuilt


class Flat(nn.Module):
    """A step from tensors to tensors: AOTInductor keeps no classes of ours."""

    def __init__(self, step: nn.Module, example: tuple[Any, ...]) -> None:
        super().__init__()
        self.step, self.example = step, example

    def forward(self, *leaves: Tensor) -> tuple[Tensor, ...]:
        """The step's results, flat, of its arguments, flat."""
        return tuple(flattened(self.step(*rebuilt(self.example, iter(leaves)))))


def inductor(step: nn.Module, given: tuple[Any, ...]) -> Callable[..., object]:
    """The step through `torch.compile`, already compiled for these arguments."""
    compiled = TorchStep(step, inductor=True)
    compiled(*given)
    return compiled


def aot_inductor(step: nn.Module, given: tuple[Any, ...]) -> Callable[..., Any]:
    """The step as a library of AOTInductor's, loaded; it takes and gives flat tensors."""
    program = torch.export.export(Flat(step, given), tuple(flattened(given)))
    with tempfile.TemporaryDirectory() as folder:
        file = torch._inductor.aoti_compile_and_package(program, package_path=str(Path(folder) / "step.pt2"))
        return torch._inductor.aoti_load_package(file)


def compilers(table: Any, options: argparse.Namespace) -> None:
    """Rows of the speed table: the control step through both, beside the toolkit's machine code of the same run."""
    for batch in (1, 4096):
        name, threads = f"control_step_float64_batch_{batch}", 1 if batch == 1 else options.threads
        kinds = (
            ["inductor"] if batch > 1 or options.quick else ["inductor", "aot_inductor"]
        )  # that one builds for minutes
        wanted = [kind for kind in kinds if table.wants(f"{name}_{kind}")]
        if not wanted:
            continue
        c, inputs = steps(batch, torch.float64, 60 if batch == 1 else 25)
        late = inputs[-20:] if batch == 1 else inputs[-5:]
        calls = 2000 if batch == 1 else 40
        if "inductor" in wanted:
            step = inductor(c, late[0])
            table.add(f"{name}_inductor", batch, threads, lambda s=step, g=late, n=calls: timed_steps(s, g, n))
        if "aot_inductor" in wanted:
            library, flat = aot_inductor(c, late[0]), [tuple(flattened(given)) for given in late]
            table.add(f"{name}_aot_inductor", batch, threads,
                      lambda s=library, g=flat, n=calls: timed_steps(s, g, n))  # fmt: skip
        for kind in wanted:
            table.compare(f"{name}_aot", f"{name}_{kind}", kind)

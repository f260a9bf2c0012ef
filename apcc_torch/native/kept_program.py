"""Programs that are kept: a library for each structure, and how the numbers of a module that it reads are found."""

from __future__ import annotations

import ctypes
import gc
import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Self

import torch

from apcc_torch.files import cache_folder
from apcc_torch.native.build import built, kept_name
from apcc_torch.native.fingerprint import Fingerprint
from apcc_torch.native.library import alone, keep, kept, loaded
from apcc_torch.native.program_numbers import ProgramNumbers
from apcc_torch.native.source import Plan
from apcc_torch.plain_text import plain_logger

log = plain_logger(__name__)


class Program(NamedTuple):
    """Machine code with its numbers.

    run: The library's entry point. numbers: What it reads in place of constants; held here while it may run.
    """

    run: Any
    numbers: Any

    @classmethod
    def of(cls, library: Any, numbers: list[float], dtype: torch.dtype) -> Self:
        """A loaded library with numbers of the type that it computes in."""
        made = ctypes.c_double if dtype == torch.float64 else ctypes.c_float
        return cls(library, (made * max(1, len(numbers)))(*numbers))


def kept_program(told: Fingerprint, dtype: torch.dtype, planned: Callable[[], Plan], what: str) -> Program:
    """A module's program; planned where it is not known, and built where it is not kept, or damaged.

    What was planned for a module is taken for another that differs in the values of its tensors, as far as these do not
    decide the program's form, and in settings that were not read.

    Args:
        told: The module.
        dtype: What it computes in, float64 or float32.
        planned: Traces it.
        what: Whose it is, for the log.

    Raises:
        CompileError: It cannot be traced, built, kept or loaded.
    """
    names, damaged = [told.name, told.exact()] if told.lasting else [], ""
    for name in list(names):
        record = kept(kept_name(name, "json"))
        if record is None:
            continue
        known = json.loads(record.read_text(encoding="ascii"))
        numbers = ProgramNumbers(**known["numbers"]).values(told.held)
        if numbers is None or any(told.told[number] != digest for number, digest in known["read"]):
            names.remove(name)  # that of another module, which keeps it
            continue
        library = kept(known["library"])
        if library is not None:
            return Program.of(loaded(library), numbers, dtype)
        damaged = known["library"]
    with _uncollected():
        plan = planned()
    library, asked = _built(plan, damaged, what)
    program = Program.of(loaded(library), [plan.trace.scalars.number(index) for index in asked], dtype)
    if not told.lasting:
        return program
    general = told.name in names
    found = ProgramNumbers.of(plan.trace.scalars, asked) if general else ProgramNumbers.plain(list(program.numbers))
    with alone():
        read = [(number, told.told[number]) for number in plan.trace.read]
        content = {"library": library.name, "numbers": found._asdict(), "read": read}
        keep(json.dumps(content).encode("ascii"), kept_name(told.name if general else told.exact(), "json"))
    return program


@contextmanager
def _uncollected() -> Iterator[None]:
    """Inside, Python looks for no cycles: among a hundred thousand expressions there are none, and it takes long."""
    before = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if before:
            gc.enable()


def _built(plan: Plan, damaged: str, what: str) -> tuple[Path, list[int]]:
    """The library of a plan, and the expressions whose numbers it reads; built where it is not kept, or damaged."""
    with _uncollected():
        name = plan.name()
    file, table = kept_name(name, "so"), kept_name(name, "numbers")
    with alone():  # a sweep's workers ask for the same code at the same time
        library = None if file == damaged else kept(file)
        listed = None if library is None else kept(table)
        if library is not None and listed is not None:
            return library, json.loads(listed.read_text(encoding="ascii"))
        log.info("building machine code for %s, once; it is kept in %s", what, cache_folder())
        with _uncollected():
            source = plan.source(os.cpu_count() or 1)
        library = built(source, file)
        keep(json.dumps(source.numbers).encode("ascii"), table)
    return library, source.numbers

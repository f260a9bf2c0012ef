"""Programs that are kept: a library for each structure, and for each module the numbers that it puts into one."""

from __future__ import annotations

import ctypes
import json
from collections.abc import Callable
from typing import Any, NamedTuple, Self

import torch

from apcc_torch.files import cache_folder
from apcc_torch.native.build import built, kept_name
from apcc_torch.native.library import alone, keep, kept, loaded
from apcc_torch.native.source import Source
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


def kept_program(name: str, dtype: torch.dtype, write: Callable[[], Source], what: str) -> Program:
    """The program of this name; written and built where it is not kept, or damaged.

    A program whose text was built before, with other numbers, is not built again.

    Args:
        name: From `fingerprint`.
        dtype: What it computes in, float64 or float32.
        write: Makes its source.
        what: Whose it is, for the log.

    Raises:
        CompileError: It cannot be written, built, kept or loaded.
    """
    record, damaged = kept(kept_name(name, "json")), ""
    if record is not None:
        told = json.loads(record.read_text(encoding="ascii"))
        library = kept(told["library"])
        if library is not None:
            return Program.of(loaded(library), told["numbers"], dtype)
        damaged = told["library"]
    source = write()
    file = kept_name(source.name(), "so")
    with alone():  # a sweep's workers ask for the same code at the same time
        library = None if file == damaged else kept(file)
        if library is None:
            log.info("building machine code for %s, once; it is kept in %s", what, cache_folder())
            library = built(source, file)
    entry = loaded(library)
    keep(json.dumps({"library": file, "numbers": source.numbers}).encode("ascii"), kept_name(name, "json"))
    return Program.of(entry, source.numbers, dtype)

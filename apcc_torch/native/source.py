"""Writes a trace as a C++ program that works on several rows at once, one a lane."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from importlib.resources import files
from typing import NamedTuple

import torch

from apcc_torch.native.code import package_code
from apcc_torch.native.driver import driver
from apcc_torch.native.scalars import Expression
from apcc_torch.native.statements import body, is_form
from apcc_torch.native.trace import Trace

_THREADS = "".join(f"#include <{name}>\n" for name in ("atomic", "chrono", "thread", "vector"))


@dataclass
class Source:
    """A program in files that compile one by one.

    header: Common to all.
    parts: Bodies, each with the header before it.
    lanes: Rows that it works on at once.
    numbers: The expressions whose values it reads in place of constants, so modules that differ in these alone share a
        library.
    """

    header: str
    parts: list[str]
    lanes: int
    numbers: list[int]


def prologue(lanes: int, dtype: torch.dtype) -> str:
    """The arithmetic that statements are written in.

    Args:
        lanes: Rows at once; 1 for plain numbers.
        dtype: What is computed in, float64 or float32.
    """
    return f"{_settings(lanes, dtype)}\n{files(__package__).joinpath('lanes.hpp').read_text()}"


class Plan(NamedTuple):
    """A program before it is written: all that its text follows from.

    trace: From `traced`.
    lanes: Rows at once; 1 for plain numbers.
    dtype: What it computes in, float64 or float32.
    carried: Pairs (output, input): what a repetition hands to the next.
    """

    trace: Trace
    lanes: int
    dtype: torch.dtype
    carried: list[tuple[int, int]]

    def name(self) -> str:
        """What tells its text from others (32 hexadecimal digits); the numbers have no part in it."""
        trace, scalars = self.trace, self.trace.scalars
        digest = hashlib.sha256(package_code("native"))
        for told in (
            (
                self.lanes,
                self.dtype,
                self.carried,
                trace.inputs,
                trace.outputs,
                trace.results,
                scalars.entry_of,
                scalars.returned_of,
            ),
            scalars.loops,
            [(call.first, call.last, call.result.tolist()) for call in trace.calls],
            [(*expression[:3], _told(expression)) for expression in scalars.expressions],
        ):
            digest.update(repr(told).encode())
        return digest.hexdigest()[:32]

    def source(self, files_wanted: int) -> Source:
        """Its text, spread over so many files at most."""
        # Lanes have enough to do, and are worth the room: in loops over slices they are slower.
        made = body(self.trace, together=self.lanes == 1)
        # Before the settings, whose names a header may use as well.
        header = f"{_THREADS}{prologue(self.lanes, self.dtype)}\n{made.structs}"
        texts = [*made.functions, driver(self.trace, len(made.functions), made.calls, self.carried)]
        groups: list[list[int]] = [[] for _ in range(min(files_wanted, len(texts)))]
        for k in sorted(range(len(texts)), key=lambda k: -len(texts[k])):  # files of one size are done together
            min(groups, key=lambda group: sum(len(texts[i]) for i in group)).append(k)
        parts = ["\n".join(texts[k] for k in sorted(group)) for group in groups]
        return Source(header, parts, self.lanes, made.numbers)


def _told(expression: Expression) -> str:
    """What the text tells of a value: itself, that it is known, or nothing."""
    if expression.op == "input" or (expression.op == "constant" and is_form(expression)):
        return repr(expression.value)
    return "" if expression.value is None else "known"


def _settings(lanes: int, dtype: torch.dtype) -> str:
    double = dtype == torch.float64
    settings = {
        "LANES": lanes,
        "REAL": "double" if double else "float",
        "INTEGER": "long long" if double else "int",
        "ROUND": "(REAL)6755399441055744.0" if double else "(REAL)12582912.0f",
        "REACH": "1e5" if double else "5e3",
    }
    return "\n".join(f"#define {name} {value}" for name, value in settings.items())

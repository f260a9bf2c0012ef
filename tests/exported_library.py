"""Libraries that are exported, built and called from Python."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from apcc_torch.composition.export import Parts, parts
from apcc_torch.experiments.exported import library, run
from apcc_torch.exporting.library import Library
from apcc_torch.exporting.structs import Struct, leaves
from apcc_torch.native.structure import rebuilt
from composed import composed_export

FLAGS = ("-std=c++17", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math")
CTYPES = {"double": ctypes.c_double, "float": ctypes.c_float, "bool": ctypes.c_bool, "int32_t": ctypes.c_int32}


def needed(program: str) -> str:
    """The path of a program, without which a test is skipped."""
    found = shutil.which(program)
    if found is None:
        pytest.skip(f"there is no {program} here")
    return found


def said(command: Sequence[str | Path], folder: Path) -> str:
    """What a command prints; a test fails where it does."""
    done = subprocess.run([str(word) for word in command], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def exported(folder: Path, *overrides: str) -> Path:
    """A library's folder."""
    folder.mkdir(parents=True, exist_ok=True)
    run(composed_export(*overrides), folder)
    return folder


class Built:
    """A library that is built here, and the modules that it comes from.

    Args:
        folder: Where it is built.
        *overrides: Its settings.
    """

    def __init__(self, folder: Path, *overrides: str) -> None:
        settings = composed_export(*overrides)
        with torch.no_grad():
            self.parts: Parts = parts(settings)
            self.library: Library = library(settings, self.parts)
        self.real = "double" if settings.precision == "double" else "float"
        name = settings.name
        (folder / f"{name}.h").write_text(self.library.header())
        (folder / f"{name}.cpp").write_text(self.library.source())
        (folder / f"{name}_arithmetic.hpp").write_text(self.library.arithmetic())
        # It builds in a third of the time that -O2 takes.
        said([needed("g++"), *FLAGS, "-O0", "-fPIC", "-shared", f"{name}.cpp", "-o", "made.so"], folder)
        self.code = ctypes.CDLL(str(folder / "made.so"))
        self.compiled = {each.function.name: each for each in self.library.compiled}

    def module(self, name: str) -> torch.nn.Module:
        """What a function computes."""
        return self.compiled[name].function.module

    def _buffer(self, made: Struct) -> ctypes.Structure:
        fields = []
        for member in made.present():
            kind: Any = CTYPES[self.real if member.ctype.endswith("_real") else member.ctype]
            fields.append((member.name, kind * member.size))
        return type(made.name, (ctypes.Structure,), {"_fields_": fields})()

    def call(self, name: str, *arguments: Any) -> tuple[Any, ...]:
        """What a function gives for one row of its module's arguments, as the module would give it."""
        each = self.compiled[name]
        kept: dict[str, Any] = {}
        for p in self.library.parameters(each):
            kept[p.name] = ctypes.c_double() if p.struct is None else self._buffer(p.struct)
        for argument, item in zip(each.function.takes, arguments, strict=True):
            self._fill(kept, argument, item)
        entry = getattr(self.code, f"{self.library.prefix}_{name}")
        entry.restype = None
        entry(*(v if isinstance(v, ctypes.c_double) else ctypes.byref(v) for v in kept.values()))
        return tuple(
            self._read(kept[given], like) for given, like in zip(each.function.gives, each.results, strict=True)
        )

    def _fill(self, kept: dict[str, Any], argument: str, item: Any) -> None:
        if isinstance(item, Tensor):
            kept[argument].value = float(item)
            return
        for path, _, leaf in leaves(item):
            if leaf.numel():
                array = getattr(kept[argument], "_".join(path))
                np.ctypeslib.as_array(array)[:] = leaf.flatten().numpy()

    @staticmethod
    def _read(buffer: ctypes.Structure, like: Any) -> Any:
        found = []
        for path, _, leaf in leaves(like):
            values = np.ctypeslib.as_array(getattr(buffer, "_".join(path))).copy() if leaf.numel() else np.zeros(0)
            found.append(torch.from_numpy(values).to(leaf.dtype).reshape(leaf.shape))
        return rebuilt(like, iter(found))

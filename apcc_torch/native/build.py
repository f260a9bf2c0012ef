"""Compiles C++ into a shared library, and keeps it."""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

from apcc_torch.errors import CompileError
from apcc_torch.native.source import Source
from apcc_torch.processes import process_group

# Values that are not numbers keep their meaning, so no -ffast-math; errno and traps are nobody's business here.
FLAGS = ("-std=c++17", "-march=native", "-fPIC", "-fno-math-errno", "-fno-trapping-math", "-Wno-psabi")


def cache_folder() -> Path:
    """Where libraries are kept: APCC_CACHE, else apcc_torch in the user's cache folder."""
    named = os.environ.get("APCC_CACHE")
    if named:
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "apcc_torch"


def compiler() -> str:
    """The C++ compiler: CXX, else g++ or clang++ from the path.

    Raises:
        CompileError: There is none.
    """
    named = os.environ.get("CXX")
    for candidate in (named,) if named else ("g++", "clang++"):
        outcome = shutil.which(candidate)
        if outcome:
            return outcome
    raise CompileError(f"no C++ compiler: {named or 'neither g++ nor clang++'} is on the path; install g++ or set CXX")


def flags(lanes: int) -> tuple[str, ...]:
    """What the compiler is told; CXXFLAGS has the last word.

    Straight-line code of plain numbers runs as fast with little optimisation, and is built in half the time; lanes gain
    a quarter from more.
    """
    return (*FLAGS, "-Og" if lanes == 1 else "-O2", *os.environ.get("CXXFLAGS", "").split())


@cache
def target(compiler_path: str) -> str:
    """What the compiler says of itself and of this machine: a library is good only where this is the same."""
    command = [compiler_path, *FLAGS, "-dM", "-E", "-x", "c++", os.devnull]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def widest_vector(compiler_path: str) -> int:
    """Bytes of this machine's widest vectors."""
    macros = target(compiler_path)
    for name, size in (("__AVX512F__", 64), ("__AVX__", 32)):
        if f"#define {name} 1" in macros:
            return size
    return 16


def _library(name: str) -> Path:
    """Where the library of this name is kept, for this compiler and machine."""
    told = f"{target(compiler())}{flags(1)}{flags(2)}"
    machine = hashlib.sha256(told.encode()).hexdigest()[:16]
    return cache_folder() / f"{name}-{machine}.so"


def cached(name: str) -> Path | None:
    """The library of this name, if it was built before.

    Raises:
        CompileError: There is no compiler: nothing tells then for which machine a library was built.
    """
    library = _library(name)
    return library if library.exists() else None


def built(source: Source, name: str) -> Path:
    """Compiles a program to the shared library of this name.

    Raises:
        CompileError: There is no compiler, or it refuses.
    """
    library = _library(name)
    library.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:
        _compile(compiler(), source, Path(folder), library)
    return library


def _compile(cxx: str, source: Source, folder: Path, library: Path) -> None:
    objects = []
    (folder / "header.hpp").write_text(source.header)
    for k, body in enumerate(source.parts):
        (folder / f"{k}.cpp").write_text(f'#include "header.hpp"\n{body}')
        objects.append(folder / f"{k}.o")
    made = folder / "made.so"
    with ThreadPoolExecutor(os.cpu_count()) as pool, process_group() as group:
        jobs = [
            pool.submit(_run, [cxx, *flags(source.lanes), "-c", str(o.with_suffix(".cpp")), "-o", str(o)], group)
            for o in objects
        ]
        try:
            for job in jobs:
                job.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        _run([cxx, "-shared", "-pthread", *map(str, objects), "-o", str(made)], group)
    made.replace(library)  # whole or not at all, whoever else builds the same


def _run(command: list[str], group: int) -> None:
    done = subprocess.run(command, capture_output=True, text=True, process_group=group)
    if done.returncode:
        raise CompileError(f"{command[0]} failed: {done.stderr.strip()[-2000:]}")


def loaded(library: Path) -> Any:
    """The program's entry point."""
    entry = ctypes.CDLL(str(library)).run
    entry.restype = None
    entry.argtypes = [ctypes.c_long, ctypes.c_long, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
    return entry

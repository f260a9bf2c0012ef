"""Compiles C++ into a shared library."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import tempfile
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import cache
from pathlib import Path

from apcc_torch.bars import terminal_bar
from apcc_torch.errors import CompileError
from apcc_torch.native.library import BUILD, keep, swept_folder
from apcc_torch.native.source import Source
from apcc_torch.processes import process_group

# Nothing that is written is dead, and it is written to few places: what looks for such takes a quarter of the time.
_NEEDLESS = ("-fno-dse", "-fno-tree-dse", "-fno-tree-pta")
# Values that are not numbers keep their meaning, so no -ffast-math; errno and traps are nobody's business here.
FLAGS = ("-std=c++17", "-march=native", "-fPIC", "-fno-math-errno", "-fno-trapping-math", "-Wno-psabi")


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

    Plain numbers run as fast with little optimisation, and are built in half the time; lanes gain a quarter from more.
    """
    more = () if "#define __clang__ " in target(compiler()) else _NEEDLESS
    return (*FLAGS, "-Og" if lanes == 1 else "-O2", *more, *os.environ.get("CXXFLAGS", "").split())


@cache
def target(compiler_path: str) -> str:
    """What the compiler says of itself and of this machine: a library is good only where this is the same.

    Raises:
        CompileError: It does not say.
    """
    return _run([compiler_path, *FLAGS, "-dM", "-E", "-x", "c++", os.devnull])


def widest_vector(compiler_path: str) -> int:
    """Bytes of this machine's widest vectors."""
    macros = target(compiler_path)
    for name, size in (("__AVX512F__", 64), ("__AVX__", 32)):
        if f"#define {name} 1" in macros:
            return size
    return 16


def kept_name(name: str, ending: str) -> str:
    """The file name of what is kept under a name, for this compiler and machine.

    Raises:
        CompileError: There is no compiler: nothing tells then for which machine a library was built.
    """
    told = f"{target(compiler())}{flags(1)}{flags(2)}"
    return f"{name}-{hashlib.sha256(told.encode()).hexdigest()[:16]}.{ending}"


def built(source: Source, name: str) -> Path:
    """Compiles a program to the shared library of this file name.

    Raises:
        CompileError: There is no compiler, it refuses, or the library cannot be kept.
    """
    home = swept_folder()
    try:
        with tempfile.TemporaryDirectory(prefix=BUILD, dir=home) as folder:
            return keep(_compile(compiler(), source, Path(folder)).read_bytes(), name)
    except OSError as error:
        raise CompileError(f"machine code cannot be built in {home}: {error.strerror or error}") from error


def _compile(cxx: str, source: Source, folder: Path) -> Path:
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
            for job in terminal_bar(as_completed(jobs), desc="machine code", total=len(jobs), unit="file"):
                job.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        _run([cxx, "-shared", "-s", "-pthread", *map(str, objects), "-o", str(made)], group)
    return made


def _run(command: list[str], group: int | None = None) -> str:
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", process_group=group)
    except OSError as error:
        raise CompileError(f"{command[0]} cannot be run: {error.strerror or error}") from error
    if done.returncode:
        said = done.stderr.strip().splitlines()
        why = next((line for line in said if "error" in line), said[-1] if said else f"exit code {done.returncode}")
        raise CompileError(f"{command[0]} failed: {why}")
    return done.stdout

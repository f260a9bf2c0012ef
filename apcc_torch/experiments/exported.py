"""A controller as a C++ library: settings in, a folder with source, tests and an example out."""

from __future__ import annotations

import re
from pathlib import Path

import torch

import apcc_torch
from apcc_torch.composition.export import ExportSettings, Parts, parts
from apcc_torch.composition.schema import text
from apcc_torch.experiments.folder import versions
from apcc_torch.exporting.folder import Features, files_of
from apcc_torch.exporting.library import Library
from apcc_torch.exporting.settings import PRECISIONS
from apcc_torch.exporting.vectors import Sequence, sequence
from apcc_torch.files import write_atomically, write_json

LAST = "CMakeLists.txt"
"""A folder with it is complete."""


def library(settings: ExportSettings, made: Parts) -> Library:
    """The library of its parts."""
    arm = settings.arm
    law = "fixed rest lengths" if not settings.controller.adaptive else "adaptive rest lengths"
    # It stands in comments of C, which a name from a file must not end.
    named = re.sub(r"[^\w .-]", "_", arm.name or "an arm")
    origin = f"The controller of {named}, {law}: apcc_torch {apcc_torch.__version__} wrote it."
    constants = {
        "first_estimate": (made.pi_hat, "[m] First estimates of the rest lengths."),
        "sensors_at": (made.sensors, "[m] Where the sensors sit on the arm at rest, from the base."),
    }
    return Library(settings.name, PRECISIONS[settings.precision], made.functions, constants, origin)


def run(settings: ExportSettings, folder: Path) -> str:
    """Writes the library into a folder; returns what to do with it.

    Raises:
        ConfigError, ValueRangeError: A setting has no meaning.
        CompileError: The controller cannot be written in plain arithmetic.
    """
    torch.set_num_threads(1)
    with torch.no_grad():
        made = parts(settings)
        written = library(settings, made)
        steps: Sequence = sequence(made.controller, made.functions, settings.vectors)
    features = Features(plant_step=made.dt, rate=settings.controller.rate, forces=settings.actuation == "forces")
    files = files_of(written, steps, features)
    for name, content in files.items():
        if name != LAST:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            write_atomically(folder / name, content)
    write_atomically(folder / "config.yaml", text(settings))
    write_json(folder / "versions.json", versions())
    write_atomically(folder / LAST, files[LAST])
    build = folder / "build"
    return (
        f"{folder} holds the library {settings.name}; build and test it:\n"
        f"  cmake -S {folder} -B {build} && cmake --build {build} && ctest --test-dir {build}\n"
        f"{folder / 'README.md'} says how to call it"
    )

"""The files of a library's folder: what is written for it, and templates in which its names are filled in."""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib.resources import files
from typing import Any, NamedTuple

import torch

from apcc_torch.exporting.library import Library, literal
from apcc_torch.exporting.structs import Member, Struct, leaves
from apcc_torch.exporting.vectors import PERIOD, Sequence

TEMPLATES = {
    "CMakeLists.txt": "CMakeLists.txt",
    "README.md": "README.md",
    "wrapper.hpp": "include/@name@.hpp",
    "test_vectors.cpp": "test/test_vectors.cpp",
    "header_is_c.c": "test/header_is_c.c",
    "main.cpp": "examples/main.cpp",
    "ros2/README.md": "ros2/README.md",
    "ros2/CMakeLists.txt": "ros2/CMakeLists.txt",
    "ros2/package.xml": "ros2/package.xml",
    "ros2/node.cpp": "ros2/src/node.cpp",
}
"""Template -> where its text goes."""
TOLERANCE = {torch.float64: "1e-9", torch.float32: "2e-3"}
"""By how much a step elsewhere may be off, of numbers of order one: rounding, and the C library's functions."""


class Features(NamedTuple):
    """What a library has beyond its step.

    plant_step: s, a step of its plant; None without one. rate: Hz, of the control loop. forces: Whether a loop asks for
    the tendons' forces.
    """

    plant_step: float | None
    rate: float
    forces: bool


def files_of(library: Library, steps: Sequence, features: Features) -> dict[str, str]:
    """Every file's text, by its place in the folder."""
    name = library.prefix
    made = {
        f"include/{name}.h": library.header(),
        f"src/{name}.cpp": library.source(),
        f"src/{name}_arithmetic.hpp": library.arithmetic(),
        "test/vectors.hpp": vectors(library, steps),
    }
    words = _words(library, steps, features)
    plant, pressures = features.plant_step is not None, steps.answers[0].pressure is not None
    conditions = {
        "plant": plant,
        "plant_of_tendons": plant and not pressures,
        "plant_of_chambers": plant and pressures,
        "pressures": pressures,
        "forces": features.forces,
        "covariance": steps.uncertainty is not None,
        "tendons": steps.measurements[0].tendons is not None,
        "feedforward": steps.answers[0].force is not None,
        "single": library.real == torch.float32,
    }
    folder = files(__package__).joinpath("templates")
    for template, place in TEMPLATES.items():
        text = folder.joinpath(template).read_text(encoding="utf-8")
        made[place.replace("@name@", name)] = filled(text, words, conditions)
    return made


def filled(text: str, words: dict[str, str], conditions: dict[str, bool]) -> str:
    """A template with its words between @ filled in, and its lines between @if NAME@ and @end@ where NAME holds.

    Example:
        >>> filled("@if a@\\nA\\n@end@\\n@if not a@\\nB\\n@end@\\n@x@\\n", {"x": "C"}, {"a": False})
        'B\\nC\\n'
    """

    def chosen(match: re.Match[str]) -> str:
        return match[3] if conditions[match[2]] != bool(match[1]) else ""

    text = re.sub(r"^[^\n@]*@if (not )?(\w+)@\n(.*?)^[^\n@]*@end@\n", chosen, text, flags=re.M | re.S)
    return re.sub(r"@(\w+)@", lambda match: words[match[1]], text)


def vectors(library: Library, steps: Sequence) -> str:
    """The reference steps as tables of C++."""
    p, count = library.prefix, len(steps.answers)
    tables: dict[str, list[Any]] = {
        "measurement": steps.measurements,
        "target": steps.targets,
        "command": steps.answers,
    }
    if steps.uncertainty is not None:
        tables["uncertainty"] = [steps.uncertainty]
    parts = [
        f"// {library.origin}\n// Steps of the Python controller.",
        f'#pragma once\n#include <cmath>\n#include "{p}.h"\n',
        f"const int steps = {count};",
    ]
    for name, rows in tables.items():
        made = library.structs[name]
        text = ",\n".join(f"    {_initialiser(made, row, library.real)}" for row in rows)
        parts.append(f"const {p}_{name} {name}s[{len(rows)}] = {{\n{text}}};")
    return "\n".join(parts) + "\n"


def _initialiser(made: Struct, item: Any, real: torch.dtype) -> str:
    values = [leaf for _, _, leaf in leaves(item)]
    fields = [_nested(value.tolist(), m, real) for m, value in zip(made.members, values, strict=True) if m.size]
    return "{" + ", ".join(fields) + "}"


def _nested(value: Any, member: Member, real: torch.dtype) -> str:
    if isinstance(value, list):
        return "{" + ", ".join(_nested(entry, member, real) for entry in value) + "}"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int):
        return str(value)
    return literal(value, torch.float64 if member.ctype == "double" else real)


def _compared(made: Struct) -> Iterator[str]:
    """Lines that compare a struct's members."""
    for member in made.present():
        yield f'        compare("{member.name}", &have.{member.name}, &want.{member.name}, {member.size});'


def _words(library: Library, steps: Sequence, features: Features) -> dict[str, str]:
    measured, name = steps.measurements[0], library.prefix
    command = library.structs["command"]
    step = features.plant_step or PERIOD
    sure = library.structs.get("uncertainty")
    of_tendons, of_chambers = ("y", "lengths", "tendons"), ("pressure", "pressures", "chambers")
    wanted, told, actuators = of_tendons if steps.answers[0].pressure is None else of_chambers
    return {
        "name": name,
        "NAME": name.upper(),
        "origin": library.origin,
        "sensors": str(measured.T.shape[0]),
        "coordinates": str(steps.answers[0].q_d.numel()),
        "sections": str(steps.answers[0].pi_hat.numel()),
        "tendons_count": str(steps.answers[0].y.numel()),
        "tolerance": TOLERANCE[library.real],
        "precision": "single" if library.real == torch.float32 else "double",
        "wanted": wanted,
        "told": told,
        "actuators": actuators,
        "compared": "\n".join(_compared(command)),
        "compared_uncertainty": "" if sure is None else "\n".join(_compared(sure)),
        "plant_step": repr(step),
        "period": repr(1.0 / features.rate),
        "substeps": str(max(1, round(1.0 / (features.rate * step)))),
        "structs": _shown(library),
    }


def _shown(library: Library) -> str:
    """The structs of the step as the README shows them, without their words."""
    text = []
    for name in ("measurement", "target", "command"):
        made = library.structs[name]
        lines = [f"struct {library.prefix}_{name}"]
        for member in made.present():
            size = "".join(f"[{n}]" for n in member.shape)
            unit = f"[{member.words.unit}] " if member.words.unit else ""
            lines.append(f"    {member.name + size:<22} {unit}{member.words.meaning}")
        text.append("\n".join(lines))
    return "\n\n".join(text)

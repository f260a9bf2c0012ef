"""Settings of a library."""

from __future__ import annotations

import re
from dataclasses import dataclass

import torch

from apcc_torch.errors import ConfigError
from apcc_torch.settings import OURS, Settings, setting

PRECISIONS = {"double": torch.float64, "single": torch.float32}
KEYWORDS = frozenset({
    "and", "asm", "auto", "bool", "break", "case", "catch", "char", "class", "const", "continue", "default",
    "delete", "do", "double", "else", "enum", "export", "extern", "false", "float", "for", "friend", "goto", "if",
    "inline", "int", "long", "main", "mutable", "namespace", "new", "not", "operator", "or", "private", "protected",
    "public", "register", "return", "short", "signed", "sizeof", "static", "std", "struct", "switch", "template",
    "this", "throw", "true", "try", "typedef", "union", "unsigned", "using", "virtual", "void", "volatile", "while",
    "xor",
})  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class LibrarySettings(Settings):
    """Settings of `Library`."""

    name: str = setting("apcc", "", OURS, "of the library: files, functions and structs begin with it")
    precision: str = setting(
        "double",
        "",
        OURS,
        "what it computes in: double; single, for processors without double",
        choices=("double", "single"),
    )
    actuation: str = setting(
        "lengths",
        "",
        OURS,
        "what the motors are told: lengths; forces, by a loop on the lengths with the gains of plant.pid",
        choices=("lengths", "forces"),
    )
    covariance: bool = setting(True, "", OURS, "a function that tells how sure an estimate is")
    position_noise: float = setting(1e-3, "m", OURS, "of a sensor's coordinates, for the covariance", above=0)
    angular_noise: float = setting(0.02, "rad", OURS, "of a sensor's orientation, likewise", above=0)
    with_plant: bool = setting(False, "", OURS, "the true arm of a simulation too")
    vectors: int = setting(20, "", OURS, "steps of the library's own test", least=3, most=1000)

    def check(self) -> None:
        """Raises ConfigError where the name is none that C takes."""
        if not re.fullmatch(r"[a-z][a-z0-9_]{0,31}", self.name) or self.name in KEYWORDS:
            raise ConfigError(
                f"name must be a word of C: lower-case letters, digits and _, from a letter on, got {self.name!r}"
            )

"""Plain C structs of what modules take and give: nested tuples of tensors, flattened by name."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError
from apcc_torch.exporting.words import MEMBERS, STRUCTS, Words

TYPES = {torch.bool: "bool", torch.int64: "int32_t", torch.int32: "int32_t"}
"""Of what is no number with a fraction."""


class Member(NamedTuple):
    """A member of a struct.

    name: In C. shape: () for one number. dtype: Of the tensor that it stands for. ctype: In C. words: What it is.
    """

    name: str
    shape: tuple[int, ...]
    dtype: torch.dtype
    ctype: str
    words: Words

    @property
    def size(self) -> int:
        """How many entries."""
        return int(torch.Size(self.shape).numel())


class Struct(NamedTuple):
    """A struct of C.

    name: Behind the library's own. members: In the order of the tuple's tensors; one without entries has size 0.
    """

    name: str
    members: tuple[Member, ...]

    def present(self) -> tuple[Member, ...]:
        """The members that have entries."""
        return tuple(member for member in self.members if member.size)


def leaves(item: Any, path: tuple[str, ...] = (), key: str = "") -> Iterator[tuple[tuple[str, ...], str, Tensor]]:
    """The tensors of nested tuples, in order, each with its path and CLASS.FIELD."""
    if isinstance(item, Tensor):
        yield path, key, item
    elif isinstance(item, tuple):
        names = getattr(item, "_fields", None) or [str(k) for k in range(len(item))]
        for name, part in zip(names, item, strict=True):
            yield from leaves(part, (*path, name), f"{type(item).__name__}.{name}")
    elif item is not None:
        raise ConfigError(f"{'.'.join(path) or 'an argument'} must be of tensors to be exported, not {item!r}")


def ctype(dtype: torch.dtype, real: torch.dtype, prefix: str) -> str:
    """The type of C that stands for a tensor's; times keep double precision where the library has single."""
    if dtype == real:
        return f"{prefix}_real"
    return "double" if dtype == torch.float64 else TYPES[dtype]


def struct(name: str, item: Any, real: torch.dtype, prefix: str) -> Struct:
    """The struct of a tuple.

    Args:
        name: Behind the library's own.
        item: The tuple, of one row.
        real: What the library computes in.
        prefix: The library's name.
    """
    members = []
    for path, key, leaf in leaves(item):
        words = MEMBERS.get(key, Words("", ""))
        filled = words.meaning.replace("{prefix}", prefix)
        words = words._replace(meaning=filled)
        members.append(Member("_".join(path), tuple(leaf.shape), leaf.dtype, ctype(leaf.dtype, real, prefix), words))
    return Struct(name, tuple(members))


def declared(made: Struct, prefix: str) -> str:
    """The struct as a header has it."""
    lines = [f"/** {STRUCTS[made.name]} */", f"typedef struct {prefix}_{made.name} {{"]
    for member in made.present():
        dimensions = "".join(f"[{n}]" for n in member.shape)
        unit = f"[{member.words.unit}] " if member.words.unit else ""
        comment = f"{unit}{member.words.meaning}".strip()
        text = f"    {member.ctype} {member.name}{dimensions};"
        lines.append(f"{text:<44} /**< {comment} */" if comment else text)
    return "\n".join((*lines, f"}} {prefix}_{made.name};"))

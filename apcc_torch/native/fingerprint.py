"""What a compiled function depends on, as one name: its settings, its code and torch's version."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Mapping
from enum import Enum
from functools import partial
from types import CellType, MethodType
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from apcc_torch.errors import CompileError
from apcc_torch.native.code import package_code, source_of
from apcc_torch.part import row_tensors
from apcc_torch.settings import Settings

# Of these the text says what they are.
_PLAIN = (bool, int, float, complex, str, bytes, slice, range, Enum, torch.dtype, torch.device, torch.Size)
# What nn.Module keeps for itself, none of which changes what `forward` computes.
_BOOKKEEPING = frozenset(vars(nn.Module())) - {"_parameters", "_buffers", "_modules", "training"}


class Fingerprint(NamedTuple):
    """A module as it is.

    name: 32 hexadecimal digits. Modules have the same where they differ in `told` and in the values of `held` alone,
        and there not in which of these are zero.
    held: The tensors of floating-point numbers that it holds, each once.
    described: Settings of plain values that it holds, which count where they are read; see `told`.
    told: Of each of these a digest.
    lasting: Whether its source is known whole; what a session made without a file may be another the next time.
    """

    name: str
    held: list[Tensor]
    described: list[Settings]
    told: list[str]
    lasting: bool

    def exact(self) -> str:
        """A name that `told` and the values of `held` have a part in."""
        digest = hashlib.sha256("".join((self.name, *self.told)).encode())
        for tensor in self.held:
            digest.update(_bytes(tensor))
        return digest.hexdigest()[:32]


def fingerprint(module: nn.Module, *more: str) -> Fingerprint:
    """A module as it is: the same settings, forms and code give the same name.

    Of tensors that differ from row to row only the form of one row counts.

    Raises:
        CompileError: The module holds something whose value cannot be told.
    """
    walk = _Walk({id(tensor): trailing for tensor, trailing in row_tensors(module).values()})
    walk.digest.update(package_code())
    for text in (torch.__version__, str(torch.get_default_dtype()), *more):
        walk.digest.update(text.encode())
    walk.add(module, type(module).__name__)
    return Fingerprint(walk.digest.hexdigest()[:32], walk.held, walk.described, walk.told, walk.lasting)


class _Walk:
    """Goes through what a module holds, and notes what its code depends on."""

    def __init__(self, per_row: dict[int, int], whole: bool = False) -> None:
        self.held: list[Tensor] = []
        self.described: list[Settings] = []
        self.told: list[str] = []
        self.lasting = True
        self.plain = True  # no tensor was met
        self._whole = whole  # settings too
        self.digest = hashlib.sha256()
        self._per_row = per_row
        self._met: dict[int, tuple[int, Any]] = {}  # the items too: what is gone leaves its id to others

    def _note(self, text: str) -> None:
        self.digest.update(text.encode())

    def add(self, item: Any, where: str) -> None:
        """Notes an item and what it holds."""
        self._note(f"{where}:{type(item).__module__}.{type(item).__qualname__};")
        if item is None or isinstance(item, _PLAIN):
            self._note(repr(item))
        elif isinstance(item, (list, tuple)):
            for k, part in enumerate(item):
                self.add(part, f"{where}[{k}]")
        elif isinstance(item, (set, frozenset)):
            self._note(repr(sorted(map(repr, item))))
        elif isinstance(item, Mapping):
            for name, part in item.items():
                self.add(part, f"{where}.{name}")
        elif id(item) in self._met:
            self._note(f"number {self._met[id(item)][0]}")
        else:
            self._met[id(item)] = len(self._met), item
            self._once(item, where)

    def _once(self, item: Any, where: str) -> None:
        """Notes what is here for the first time."""
        if isinstance(item, Tensor):
            self._tensor(item)
        elif isinstance(item, Settings) and not self._whole and self._describes(item):
            self._note("described")
        elif isinstance(item, CellType):
            for content in _content(item):
                self.add(content, where)
        elif isinstance(item, MethodType):
            self.add((item.__func__, item.__self__), where)
        elif isinstance(item, partial):
            self.add((item.func, item.args, item.keywords), where)
        elif inspect.isfunction(item):
            self._source(item)
            self._note(f"{item.__module__}.{item.__qualname__}")
            self.add((item.__closure__, item.__defaults__, item.__kwdefaults__), where)
        elif isinstance(item, type) or (callable(item) and not hasattr(item, "__dict__")):
            self._note(f"{item.__module__}.{item.__qualname__}")
        elif hasattr(item, "__dict__"):
            self.members(item, where)
        else:
            raise CompileError(
                f"{where} is a {type(item).__name__}, whose value cannot be told for the compiler's cache"
            )

    def members(self, item: Any, where: str) -> None:
        """Notes what an object is made of and holds."""
        self._source(type(item))
        skipped = _BOOKKEEPING if isinstance(item, nn.Module) else ()
        for name, part in vars(item).items():
            if name not in skipped:
                self.add(part, f"{where}.{name}")

    def _describes(self, item: Settings) -> bool:
        """Takes settings apart that hold neither tensors nor what a session made; says whether they are such."""
        self._source(type(item))
        apart = _Walk({}, whole=True)
        apart.members(item, type(item).__name__)
        if apart.plain and apart.lasting:
            self.described.append(item)
            self.told.append(apart.digest.hexdigest())
        return apart.plain and apart.lasting

    def _source(self, made: Any) -> None:
        """Notes what a class or a function is made of, and the numbers that stand beside it there."""
        for source, beside in source_of(made):
            if source is None:
                self.lasting = False
            else:
                self.digest.update(source)
                self.add(beside, "beside")

    def _tensor(self, item: Tensor) -> None:
        self.plain = False
        if id(item) in self._per_row:
            self._note(f"rows of {item.dtype}{tuple(item.shape[item.dim() - self._per_row[id(item)] :])}")
            return
        self._note(f"{item.dtype}{tuple(item.shape)}")
        if item.is_floating_point():
            self.held.append(item)
            # Zeros shape the program: each entry's sign where it is one, else 1.
            values = item.detach()
            self.digest.update(_bytes(torch.where(values == 0, values.signbit().byte(), 2)))
        else:
            self.digest.update(_bytes(item))


def _content(cell: CellType) -> list[Any]:
    try:
        return [cell.cell_contents]
    except ValueError:  # it is empty yet
        return []


def _bytes(tensor: Tensor) -> bytes:
    # A copy: of a single entry any stride counts as contiguous, and bytes are seen only of one.
    plain = torch.empty(tensor.numel(), dtype=tensor.dtype).copy_(tensor.detach().flatten())
    return plain.view(torch.uint8).numpy().tobytes()

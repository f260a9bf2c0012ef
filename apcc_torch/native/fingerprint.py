"""What a compiled function depends on, as one number: its settings, its code and torch's version."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Mapping
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from apcc_torch.errors import CompileError
from apcc_torch.part import row_tensors

_PACKAGE = Path(__file__).resolve().parent.parent
# Where the code of steps is; of a class from elsewhere its own file counts.
_FOLDERS = ("control", "envs", "estimation", "lie", "model", "native", "simulation")
_CORE = ("*.py", *(f"{folder}/**/*.[ph]*" for folder in _FOLDERS))
# Their text says what they are.
_PLAIN = (bool, int, float, complex, str, bytes, slice, range, Enum, torch.dtype, torch.device, torch.Size)
# What nn.Module keeps for itself, none of which changes what `forward` computes.
_BOOKKEEPING = frozenset(vars(nn.Module())) - {"_parameters", "_buffers", "_modules", "training"}


@cache
def _package_code() -> bytes:
    digest = hashlib.sha256(torch.__version__.encode())
    for path in sorted({path for pattern in _CORE for path in _PACKAGE.glob(pattern)}):
        if path.suffix in (".py", ".hpp"):
            digest.update(path.read_bytes())
    return digest.digest()


def _code_of(made: Any) -> bytes:
    """The source of a class or a function from outside the core."""
    if made.__module__.split(".")[0] in ("torch", "builtins"):
        return b""
    try:
        return Path(inspect.getfile(made)).read_bytes()
    except (OSError, TypeError):  # made in an interactive session
        return repr(sorted(vars(made))).encode()


def fingerprint(module: nn.Module, *more: str) -> str:
    """A name (32 hexadecimal digits) for a module as it is: the same settings and code give the same name.

    Of tensors that differ from row to row only the form of one row counts.

    Raises:
        CompileError: The module holds something whose value cannot be told.
    """
    digest = hashlib.sha256(_package_code())
    for text in more:
        digest.update(text.encode())
    per_row = {id(tensor): trailing for tensor, trailing in row_tensors(module).values()}
    _add(digest, module, type(module).__name__, per_row)
    return digest.hexdigest()[:32]


def _add(digest: Any, item: Any, where: str, per_row: dict[int, int]) -> None:
    digest.update(f"{where}:{type(item).__qualname__};".encode())
    if id(item) in per_row:
        digest.update(f"rows of {item.dtype}{tuple(item.shape[item.dim() - per_row[id(item)] :])}".encode())
    elif isinstance(item, Tensor):
        digest.update(f"{item.dtype}{tuple(item.shape)}".encode())
        # A copy: of a single entry any stride counts as contiguous, and bytes are seen only of one.
        plain = torch.empty(item.numel(), dtype=item.dtype).copy_(item.detach().flatten())
        digest.update(plain.view(torch.uint8).numpy().tobytes())
    elif item is None or isinstance(item, _PLAIN):
        digest.update(repr(item).encode())
    elif isinstance(item, (list, tuple)):
        for k, part in enumerate(item):
            _add(digest, part, f"{where}[{k}]", per_row)
    elif isinstance(item, (set, frozenset)):
        digest.update(repr(sorted(map(repr, item))).encode())
    elif isinstance(item, Mapping):
        for name, part in item.items():
            _add(digest, part, f"{where}.{name}", per_row)
    elif inspect.isfunction(item):
        digest.update(_code_of(item) + f"{item.__module__}.{item.__qualname__}".encode())
    elif isinstance(item, type) or (callable(item) and not hasattr(item, "__dict__")):
        digest.update(f"{item.__module__}.{item.__qualname__}".encode())
    elif hasattr(item, "__dict__"):
        digest.update(_code_of(type(item)))
        skipped = _BOOKKEEPING if isinstance(item, nn.Module) else ()
        for name, part in vars(item).items():
            if name not in skipped:
                _add(digest, part, f"{where}.{name}", per_row)
    else:
        raise CompileError(f"{where} is a {type(item).__name__}, whose value cannot be told for the compiler's cache")

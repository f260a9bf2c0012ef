"""The source that a module's code is made of, in this package and elsewhere."""

from __future__ import annotations

import builtins
import hashlib
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from torch import Tensor

_PACKAGE = Path(__file__).resolve().parent.parent
# Where the code of steps is, beside the modules of the package itself.
_FOLDERS = ("control", "envs", "estimation", "lie", "model", "native", "simulation")
# Of what others install there are versions, and a step is of torch alone.
_INSTALLED = frozenset({"site-packages", "dist-packages"})
_GLOBALS = (bool, int, float, complex, str, Tensor)


@cache
def package_code(*folders: str) -> bytes:
    """A digest of the source in these folders of the package; without any, of all that steps are made of."""
    patterns = [f"{folder}/**/*.[ph]*" for folder in folders or _FOLDERS]
    patterns += [] if folders else ["*.py"]
    digest = hashlib.sha256()
    for path in sorted({path for pattern in patterns for path in _PACKAGE.glob(pattern)}):
        if path.suffix in (".py", ".hpp"):
            digest.update(path.read_bytes())
    return digest.digest()


def source_of(made: Any) -> Iterator[tuple[bytes | None, dict[str, Any]]]:
    """What a class or a function from elsewhere is made of: its file and those that this one names.

    What the package's digest covers, what is installed and the standard library are left out.

    Args:
        made: The class, with all that it derives from, or the function.

    Yields:
        Each file with the numbers, texts and tensors that are global in it, as they are now. None for what has no file:
        of what a session made so nobody can tell.
    """
    met: set[str] = set()
    for each in made.__mro__ if isinstance(made, type) else (made,):
        if each.__module__ == "builtins" and not hasattr(builtins, each.__name__):
            yield None, {}
        for module in _modules(each.__module__, met):
            file = getattr(module, "__file__", None)
            if module is None or file is None:
                yield None, {}
                continue
            named = {name: value for name, value in vars(module).items() if not name.startswith("__")}
            yield Path(file).read_bytes(), {name: value for name, value in named.items() if isinstance(value, _GLOBALS)}


def _modules(name: str, met: set[str]) -> Iterator[ModuleType | None]:
    """A module and those that it names, as far as they count; None for one that is not there."""
    root = name.partition(".")[0]
    if name in met or root == "torch" or root in sys.stdlib_module_names - {"__main__"}:
        return
    met.add(name)
    module = sys.modules.get(name)
    file = getattr(module, "__file__", None)
    if file is not None and _covered(Path(file)):
        return
    yield module
    if module is None or file is None:
        return
    for value in list(vars(module).values()):
        other = value.__name__ if isinstance(value, ModuleType) else getattr(value, "__module__", None)
        if isinstance(other, str):
            yield from _modules(other, met)


def _covered(file: Path) -> bool:
    """Whether a file is installed, or of those that `package_code` is of."""
    if not _INSTALLED.isdisjoint(file.parts):
        return True
    if not file.is_relative_to(_PACKAGE):
        return False
    inside = file.relative_to(_PACKAGE).parts
    return len(inside) == 1 or inside[0] in _FOLDERS

"""Methods of modules, and functions of a file, as modules: what is compiled is one."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from torch import nn

from apcc_torch.errors import CompileError


class Method(nn.Module):
    """A method of a module as a module's `forward`.

    Example:
        >>> tip = Method(PCCBackbone(2), "tip")
        >>> tip(torch.zeros(6), torch.tensor([0.2, 0.25]))
        tensor([0.0000, 0.0000, 0.4500])
    """

    def __init__(self, of: nn.Module, name: str) -> None:
        super().__init__()
        self.of, self.name = of, name

    def forward(self, *args: Any) -> Any:
        """The method's result."""
        return getattr(self.of, self.name)(*args)


class Function(nn.Module):
    """A function that a file defines by name as a module's `forward`.

    Args:
        function: It holds nothing: what it depends on is what the file says, and its arguments.

    Example:
        >>> share, section = Function(decouple)(torch.tensor([0.3]), torch.tensor([0.2, 0.25]))
        >>> share, section
        (tensor([0.4000]), tensor([1]))
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__()
        self.function = function

    def forward(self, *args: Any) -> Any:
        """The function's result."""
        return self.function(*args)


def module_of(function: nn.Module | Callable[..., Any]) -> tuple[nn.Module, str]:
    """The module whose `forward` a module, a method of one or a function is, and its name for people.

    Raises:
        CompileError: It may hold what nobody can tell, as a function that is defined within another does.
    """
    if isinstance(function, nn.Module):
        return function, type(function).__name__
    of = getattr(function, "__self__", None)
    if isinstance(of, nn.Module):
        name = function.__name__
        return Method(of, name), f"{type(of).__name__}.{name}"
    if inspect.isfunction(function) and "<" not in function.__qualname__ and _has_file(function):
        return Function(function), function.__qualname__
    raise CompileError(
        f"what is compiled is a module, a method of one, or a function that a file defines by name; got {function!r}, "
        "which may hold what the cache cannot tell: write an nn.Module that holds it"
    )


def _has_file(function: Callable[..., Any]) -> bool:
    try:
        return inspect.getsourcefile(function) is not None
    except TypeError:
        return False

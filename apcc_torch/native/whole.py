"""Functions of torch that a trace sees before torch takes them apart."""

from __future__ import annotations

from typing import Any, Protocol

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from apcc_torch.native.symbol import Symbol

_WHOLE: dict[Any, str] = {
    torch.isfinite: "aten.isfinite",
    Tensor.isfinite: "aten.isfinite",
    torch.linalg.solve_ex: "aten.linalg_solve_ex",
    torch.matmul: "aten.matmul",
    Tensor.matmul: "aten.matmul",
    Tensor.__matmul__: "aten.matmul",
}
UNKNOWN = "it asks for the value of a tensor"
# What functions of torch tell of a tensor's form; of its values they tell floats, which are not here.
_FORMS = (bool, int, torch.Size, torch.dtype, torch.device, torch.layout, torch.memory_format, type(NotImplemented))


class Recorder(Protocol):
    """What notes torch's operations, but for those of its own: `inside` it works itself."""

    inside: bool

    def called(self, name: str, func: Any, args: Any, kwargs: Any) -> Any: ...


class Whole(TorchFunctionMode):
    """Keeps functions whole that have a rule of their own, and that torch would take apart.

    It also refuses those that give something out that values may be read from: neither a tensor of the trace, nor one
    of those that they were given, nor a form. What is computed from such values would hang on them unseen.
    """

    def __init__(self, recorder: Recorder) -> None:
        super().__init__()
        self._recorder = recorder

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = _WHOLE.get(func)
        if name is not None:
            return self._recorder.called(name, func, args, kwargs or {})
        result = func(*args, **(kwargs or {}))
        if not self._recorder.inside and (func is Tensor.data_ptr or not _unread(result, args)):
            raise RuntimeError(UNKNOWN)
        return result


def _unread(result: Any, args: Any) -> bool:
    """Whether what a function gives out tells no values."""
    if type(result) is Symbol or result is None or isinstance(result, _FORMS):
        return True
    if isinstance(result, Tensor):
        return any(result is arg for arg in args)
    return isinstance(result, (tuple, list)) and all(_unread(each, args) for each in result)

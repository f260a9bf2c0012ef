"""A part: a module made from its settings, which shows, copies, saves and restores them with its tensors."""

from __future__ import annotations

import copy
import inspect
import sys
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from apcc_torch.errors import ConfigError
from apcc_torch.modes import full_precision
from apcc_torch.settings import Kind, Settings, about_of, default_of, told

_TRAILING = {"": 0, "number": 0, "sections": 1, "points": 1, "gain": 2, "task": 2}
"""How many dimensions of a setting that may differ from row to row are not rows'."""
_BOOKKEEPING = frozenset({*vars(nn.Module()), "trailing_dimensions"})
"""What a module keeps for itself."""

torch.serialization.add_safe_globals([nn.ModuleList])


class Configurable:
    """Base of every class with settings of its own, so that a setting may name it by its `kind`.

    A subclass names their class as `settings_type`; one that names none has those of its base.
    """

    settings_type: ClassVar[type[Settings]] = Settings

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        if "settings_type" not in cls.__dict__:
            # Settings say of which part they are, so a part that inherits them has its own.
            base = cls.settings_type
            name = f"{cls.__name__}Settings" if base is Settings else base.__name__
            place = {"__module__": cls.__module__, "__qualname__": f"{cls.__qualname__}.settings_type"}
            cls.settings_type = type(name, (base,), {**place, "__doc__": base.__doc__})
        own: Any = cls.settings_type
        own.part = cls
        if fields(own):
            taken = any(p.kind is p.VAR_KEYWORD for p in inspect.signature(cls.__init__).parameters.values())
            cls.__signature__ = _signature(cls, own if taken else Settings)  # type: ignore[attr-defined]


class Part(Configurable, nn.Module):
    """Base of every module of the toolkit.

    A subclass with settings names their class as `settings_type`, and its constructor takes them as `resolved` does:

        class Gain(Part):
            settings_type = GainSettings

            def __init__(self, *given: Any, **changes: Any) -> None:
                super().__init__()
                self.hold(resolved(GainSettings, given, changes))

    Each setting is then an attribute: a tensor a buffer, a Parameter a Parameter, anything else what it is. `derive`
    computes what follows from them.

    Whether it has settings or not: its plain attributes are in its `state_dict` beside its tensors, it is copied and
    saved whole (`torch.load(weights_only=True)` takes it), and its public methods run without `torch.autocast`.

    Example:
        >>> integral = TaskIntegral(gain=2.0)
        >>> integral
        TaskIntegral(gain=2.0, reach=0.001)
        >>> integral.settings.changed(reach=2e-3)
        TaskIntegralSettings(gain=2.0, reach=0.002)
    """

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        for name, method in list(vars(cls).items()):
            if inspect.isfunction(method) and not name.startswith("_"):
                setattr(cls, name, full_precision(method))
        # While it exports a module, torch makes a class of the same name, which must not be taken for the part's.
        if not cls.__module__.startswith("torch."):
            torch.serialization.add_safe_globals([cls, *_records(cls)])

    def hold(self, settings: Settings) -> None:
        """Makes every setting an attribute, then derives what follows from them."""
        for each in fields(settings):
            self._hold_one(each.name, getattr(settings, each.name), _TRAILING[about_of(each).rows])
        self.derive()

    def _hold_one(self, name: str, value: Any, trailing: int) -> None:
        if name in self._modules:
            return  # nested settings, which the part of that name holds
        if isinstance(value, Tensor) or name not in self.__dict__.get("trailing_dimensions", {}):
            hold_numbers(self, trailing, **{name: value})  # else the constructor made a tensor of it

    def derive(self) -> None:
        """What follows from the settings alone; called when they are held and when they are restored."""

    @property
    def settings(self) -> Settings:
        """The settings as they are now, tensors included."""
        values = {each.name: getattr(self, each.name) for each in fields(type(self).settings_type)}
        values = {name: value.settings if isinstance(value, Part) else value for name, value in values.items()}
        return type(self).settings_type(**values)

    def extra_repr(self) -> str:
        """Every setting, for `print`; of a part without settings, its plain attributes."""
        if fields(type(self).settings_type):
            return ", ".join(told(self.settings, everything=True))
        return ", ".join(f"{name}={value!r}" for name, value in self._plain().items() if not name.startswith("_"))

    def _plain(self) -> dict[str, Any]:
        """The attributes that are neither modules nor buffers nor parameters, as far as `torch.load` takes them."""
        return {name: value for name, value in vars(self).items() if name not in _BOOKKEEPING and _is_plain(value)}

    def get_extra_state(self) -> dict[str, Any]:
        """What a part is made of beside its tensors, for `state_dict`."""
        rows = dict(self.__dict__.get("trailing_dimensions", {}))
        return {"part": type(self).__qualname__, "rows": rows, "values": self._plain()}

    def set_extra_state(self, state: Mapping[str, Any]) -> None:
        """Takes it up again.

        Raises:
            ConfigError: It is that of another class, or of a part that has other attributes.
        """
        name, values, here = type(self).__qualname__, state["values"], self._plain()
        if state["part"] != name:
            raise ConfigError(f"the saved state is one of {state['part']}, this part is {name}")
        if values.keys() != here.keys():
            different = ", ".join(sorted(values.keys() ^ here.keys()))
            raise ConfigError(f"{name}: the saved state and this part hold {different} differently")
        for each, value in values.items():
            setattr(self, each, value)
        self.derive()

    def _load_from_state_dict(self, state_dict: Mapping[str, Any], prefix: str, *rest: Any) -> None:
        """As torch has it, once what may be a number, nothing or a tensor of any batch has the form that was saved."""
        saved = state_dict.get(f"{prefix}_extra_state", {"rows": {}, "values": {}})
        own = self.__dict__.get("trailing_dimensions", {})
        for name, trailing in {**own, **saved["rows"]}.items():
            here, there = getattr(self, name, None), state_dict.get(prefix + name)
            if isinstance(here, nn.Parameter):
                continue  # it stays one: where the two differ, torch or `set_extra_state` says so
            if name in saved["values"]:
                _release(self, name)
                self.__dict__[name] = None  # a number or nothing, set with the others
            elif there is None and name in saved["rows"]:
                hold_rows(self, **{name: (None, trailing)})
            elif there is not None and (not isinstance(here, Tensor) or here.shape != there.shape):
                hold_rows(self, **{name: (there.to(here) if isinstance(here, Tensor) else there, trailing)})
        super()._load_from_state_dict(state_dict, prefix, *rest)

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """A copy whose tensors are leaves: a tensor that was computed from others would refuse to be copied."""
        for value in self.buffers():
            if not value.is_leaf:
                memo[id(value)] = value.detach().clone().requires_grad_()
        copied = type(self).__new__(type(self))
        memo[id(self)] = copied
        copied.__dict__.update(copy.deepcopy(self.__dict__, memo))
        return copied


def _records(part: type[Part]) -> list[type]:
    """The named tuples, enumerations and dataclasses of a part's package that its module defines or imports."""
    home = vars(sys.modules.get(part.__module__, inspect))
    classes = [value for value in home.values() if isinstance(value, type)]
    package = part.__module__.partition(".")[0]
    return [
        each
        for each in classes
        if each.__module__.partition(".")[0] == package and (issubclass(each, (tuple, Enum)) or is_dataclass(each))
    ]


def _is_plain(value: Any) -> bool:
    """Whether `torch.load(weights_only=True)` takes a value back."""
    if type(value) in (tuple, list):
        return all(map(_is_plain, value))
    if type(value) is dict:
        return all(map(_is_plain, (*value, *value.values())))
    plain = (bool, int, float, str, Tensor, torch.dtype, type(None))
    return type(value) in plain or type(value) in torch.serialization.get_safe_globals()


def hold_rows(module: nn.Module, persistent: bool = True, /, **tensors: tuple[Tensor | None, int]) -> None:
    """Makes tensors a module's own that may differ from row to row: name = (tensor, its trailing dimensions).

    A Parameter stays one and is trained. Anything else is copied into a buffer, so that the caller's may change; its
    graph is kept. One that is not persistent follows from others, and no `state_dict` has it.
    """
    # Beside the buffers: which of them may have leading dimensions, with the number of the others.
    trailing = module.__dict__.setdefault("trailing_dimensions", {})
    for name, (value, dimensions) in tensors.items():
        _release(module, name)
        if isinstance(value, nn.Parameter):
            module.register_parameter(name, value)
        else:
            module.register_buffer(name, None if value is None else value.clone(), persistent)
        trailing[name] = dimensions


def hold_numbers(module: nn.Module, trailing: int = 0, /, **numbers: Any) -> None:
    """Makes values a module's own: a tensor of so many trailing dimensions by `hold_rows`, anything else as it is."""
    for name, value in numbers.items():
        if isinstance(value, Tensor):
            hold_rows(module, **{name: (value, trailing)})
        else:
            setattr(module, name, value)


def _release(module: nn.Module, name: str) -> None:
    """Forgets an attribute, whatever it was held as."""
    for kept in (module.__dict__, module._buffers, module._parameters, module.__dict__["trailing_dimensions"]):
        kept.pop(name, None)


def refuse_parameter(name: str, value: Any, instead: str) -> None:
    """Raises ConfigError where a value that constants are made of is a Parameter: it would seem to be trained."""
    if isinstance(value, nn.Parameter):
        raise ConfigError(f"{name} is not trained here: {instead}")


def untrained(value: Tensor) -> Tensor:
    """The value for constants that do not follow it: of a Parameter what it is now, of anything else itself."""
    return value.detach() if isinstance(value, nn.Parameter) else value


def row_tensors(module: nn.Module) -> dict[str, tuple[Tensor, int]]:
    """Of a module and all it holds, the tensors that differ by row: dotted name, tensor, trailing dimensions."""
    by_name = {}
    for prefix, part in module.named_modules():
        for name, trailing in part.__dict__.get("trailing_dimensions", {}).items():
            tensor = getattr(part, name)
            if tensor is not None and tensor.dim() > trailing:
                by_name[f"{prefix}.{name}" if prefix else name] = (tensor, trailing)
    return by_name


def part_of(settings: Settings) -> Any:
    """The class that settings are of."""
    return type(settings).part


def _signature(cls: type[Any], kind: type[Kind]) -> inspect.Signature:
    """What `help` shows: the constructor's own arguments, then every setting with its default."""
    own = [p for p in inspect.signature(cls.__init__).parameters.values() if p.name != "self"]
    plain = [p for p in own if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
    first = [p for p in plain if p.kind is not p.KEYWORD_ONLY]
    taken = {p.name for p in plain}
    settings = []
    for each in fields(kind):
        default = inspect.Parameter.empty if default_of(each) is MISSING else default_of(each)
        if each.name not in taken:
            keyword = inspect.Parameter.KEYWORD_ONLY
            settings.append(inspect.Parameter(each.name, keyword, default=default, annotation=each.type))
    return inspect.Signature([*first, *(p for p in plain if p.kind is p.KEYWORD_ONLY), *settings])

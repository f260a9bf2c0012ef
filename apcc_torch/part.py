"""A part: a module made from its settings, which shows, copies, saves and restores them with its tensors."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Mapping
from dataclasses import MISSING, fields
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from apcc_torch.errors import ConfigError
from apcc_torch.settings import Kind, Settings, about_of, check_setting, default_of, told

_TRAILING = {"": 0, "number": 0, "sections": 1, "points": 1, "gain": 2, "task": 2, "lists": 1}
"""How many dimensions of a setting that may differ from row to row are not rows'."""


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
        if fields(own) and any(p.kind is p.VAR_KEYWORD for p in inspect.signature(cls.__init__).parameters.values()):
            cls.__signature__ = _signature(cls, own)  # type: ignore[attr-defined]


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
    """

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        torch.serialization.add_safe_globals([cls])

    def hold(self, settings: Settings) -> None:
        """Makes every setting an attribute, then derives what follows from them."""
        for each in fields(settings):
            self._hold_one(each.name, getattr(settings, each.name), _TRAILING[about_of(each).rows])
        self.derive()

    def _hold_one(self, name: str, value: Any, trailing: int) -> None:
        if name in self._modules:
            return  # nested settings, which the part of that name holds
        if isinstance(value, Tensor):
            hold_rows(self, **{name: (value, trailing)})
        elif name not in self.__dict__.get("trailing_dimensions", {}):  # else the constructor made a tensor of it
            setattr(self, name, value)

    def derive(self) -> None:
        """What follows from the settings alone; called when they are held and when they are restored."""

    @property
    def settings(self) -> Settings:
        """The settings as they are now, tensors included."""
        values = {each.name: getattr(self, each.name) for each in fields(type(self).settings_type)}
        values = {name: value.settings if isinstance(value, Part) else value for name, value in values.items()}
        return type(self).settings_type(**values)

    def extra_repr(self) -> str:
        """Every setting, for `print`."""
        return ", ".join(told(self.settings, everything=True))

    def get_extra_state(self) -> dict[str, Any]:
        """The settings that are no tensors, for `state_dict`."""
        values = ((each.name, getattr(self, each.name)) for each in fields(type(self).settings_type))
        return {name: value for name, value in values if not isinstance(value, Tensor | nn.Module)}

    def set_extra_state(self, state: Mapping[str, Any]) -> None:
        """Takes them up again.

        Raises:
            ConfigError: A setting is a tensor in one of the two and none in the other, or unknown.
        """
        here = self.get_extra_state()
        if state.keys() != here.keys():
            different = ", ".join(sorted(state.keys() ^ here.keys()))
            raise ConfigError(f"{type(self).__name__}: the saved state and this part hold {different} differently")
        for name, value in state.items():
            setattr(self, name, value)
        self.derive()

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """A copy whose tensors are leaves: a tensor that was computed from others would refuse to be copied."""
        for value in self.buffers():
            if not value.is_leaf:
                memo[id(value)] = value.detach().clone().requires_grad_()
        made = type(self).__new__(type(self))
        memo[id(self)] = made
        made.__dict__.update(copy.deepcopy(self.__dict__, memo))
        return made


def hold_rows(module: nn.Module, **tensors: tuple[Tensor | None, int]) -> None:
    """Makes tensors a module's own that may differ from row to row: name = (tensor, its trailing dimensions).

    A Parameter stays one and is trained. Anything else is copied into a buffer, so that the caller's may change; its
    graph is kept.
    """
    # Beside the buffers: which of them may have leading dimensions, with the number of the others.
    trailing = module.__dict__.setdefault("trailing_dimensions", {})
    for name, (value, dimensions) in tensors.items():
        module.__dict__.pop(name, None)
        if isinstance(value, nn.Parameter):
            module.register_parameter(name, value)
        elif name in module._buffers:
            module._buffers[name] = None if value is None else value.clone()
        else:
            module.register_buffer(name, None if value is None else value.clone())
        trailing[name] = dimensions


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


def check_settings(**settings: Any) -> None:
    """To be replaced by the ranges of settings."""
    for name, value in settings.items():
        if value is not None:
            check_setting(name, value)


def check_settings_or_zero(**settings: Any) -> None:
    """To be replaced by the ranges of settings."""
    for name, value in settings.items():
        check_setting(name, value, zero=True)


def hold(module: nn.Module, **settings: Any) -> None:
    """To be replaced by `Part.hold`."""
    for name, value in settings.items():
        if isinstance(value, Tensor):
            hold_rows(module, **{name: (value, 0)})
        else:
            setattr(module, name, value)

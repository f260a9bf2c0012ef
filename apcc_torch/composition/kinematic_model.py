"""The kinematic model that a configuration names: any class of models, from this package or another."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from torch import Tensor

from apcc_torch.errors import ConfigError
from apcc_torch.model.kinematic_model import KinematicModel


def kinematic_model(kind: str, n_sections: int, base_rotation: Tensor, settings: Mapping[str, Any]) -> KinematicModel:
    """The model of `n_sections` sections.

    Args:
        kind: Its class, as package.module.Class.
        n_sections: Number of sections n_b.
        base_rotation: (3, 3).
        settings: Further arguments of the class.

    Raises:
        ConfigError: There is no such class, it is no kinematic model, or does not take these settings.
    """
    module, _, name = kind.rpartition(".")
    try:
        found = getattr(import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"model.kind must be a class, as package.module.Class, got {kind!r}: {error}") from error
    if not (isinstance(found, type) and issubclass(found, KinematicModel)):
        raise ConfigError(f"model.kind must be a KinematicModel, got {kind!r}")
    try:
        return found(n_sections, base_rotation=base_rotation, **settings)
    except TypeError as error:
        raise ConfigError(f"model.settings do not fit {kind}: {error}") from error

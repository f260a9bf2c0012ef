"""A composed configuration as the dataclass of its schema."""

from __future__ import annotations

from typing import TypeVar

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from apcc_torch.errors import ConfigError

Root = TypeVar("Root")


def typed(cfg: DictConfig, root: type[Root]) -> Root:
    """The settings as a dataclass.

    Args:
        cfg: Composed under the schema of `root`.
        root: The dataclass.

    Raises:
        ConfigError: A value is missing or of the wrong type.
    """
    try:
        config = OmegaConf.to_object(cfg)
    except OmegaConfBaseException as error:
        raise ConfigError(str(error).splitlines()[0]) from error
    assert isinstance(config, root)  # what the schema makes of any composed configuration
    return config

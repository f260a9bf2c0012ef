"""The composed configuration that a command line changes, and the settings that it means."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from apcc_torch.errors import ConfigError
from apcc_torch.reading import defaults, plain, read
from apcc_torch.settings import Settings, about_of, default_of, keys

Root = TypeVar("Root", bound=Settings)


def schema(root: type[Settings]) -> DictConfig:
    """Every key of a root with its default, for hydra to merge files and a command line into.

    Where a part is named by its class, or may be left out, its keys are that part's: the node takes any, and `typed`
    refuses what the part does not have.
    """
    node = OmegaConf.create(defaults(root))
    assert isinstance(node, DictConfig)  # of a mapping
    _open(node, root)
    return node


def _open(node: DictConfig, root: type[Settings]) -> None:
    for each in keys(root):
        default = default_of(each)
        if about_of(each).base is not None or (default is None and "Settings" in str(each.type)):
            content = {} if default is None else {"kind": node[each.name]["kind"]}
            node[each.name] = DictConfig(content, flags={"struct": False})
        elif isinstance(default, Settings):
            _open(node[each.name], type(default))
        elif isinstance(default, Mapping):
            node[each.name] = DictConfig(plain(default), flags={"struct": False})


def typed(cfg: DictConfig, root: type[Root]) -> Root:
    """The settings that a composed configuration means.

    Args:
        cfg: What hydra composed.
        root: Their class.

    Raises:
        ConfigError, ValueRangeError: A key is unknown or missing, a value of the wrong type or out of range.
    """
    known = {each.name for each in keys(root)}
    try:
        values = OmegaConf.to_container(OmegaConf.masked_copy(cfg, [str(k) for k in cfg if k in known]), resolve=True)
    except OmegaConfBaseException as error:
        raise ConfigError(str(error).splitlines()[0]) from error
    assert isinstance(values, dict)  # of a DictConfig
    return read({str(key): value for key, value in values.items()}, root)


def text(settings: Settings) -> str:
    """Settings as YAML that reads back."""
    return OmegaConf.to_yaml(OmegaConf.create(plain(settings)))

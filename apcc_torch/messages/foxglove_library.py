"""Foxglove's library: its schemas, its files and its server, where it is installed."""

from __future__ import annotations

from typing import Any

from apcc_torch.errors import ConfigError

EXTRA = "messages for Foxglove need foxglove-sdk: pip install 'apcc-torch[foxglove]'"


def foxglove() -> Any:
    """The module.

    Raises:
        ConfigError: It is not installed.
    """
    try:
        import foxglove.channels
        import foxglove.messages
    except ModuleNotFoundError as error:
        raise ConfigError(EXTRA) from error
    return foxglove

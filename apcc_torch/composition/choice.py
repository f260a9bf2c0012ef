"""A setting that names one of a few."""

from __future__ import annotations

from collections.abc import Sequence

from apcc_torch.errors import ConfigError


def choice(key: str, value: str, options: Sequence[str]) -> str:
    """`value` if it is one of `options`.

    Raises:
        ConfigError: "feedback.mode must be one of position, pose, got 'both'".
    """
    if value not in options:
        raise ConfigError(f"{key} must be one of {', '.join(options)}, got {value!r}")
    return value

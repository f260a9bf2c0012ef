"""What a picture of an arm holds, and what draws it: `report.arm_scene`, with matplotlib, or `viewing.env_window`.

Environments and reports do not import each other: the registration names the drawing as it names the environments, by
a string, and it is loaded when the first picture is asked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import torch
from gymnasium.envs.registration import load_env_creator
from numpy.typing import NDArray
from torch import Tensor

from apcc_torch.errors import ConfigError
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.arm import Arm
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.tendons import TendonRouting

POINTS = 61


class Picture(NamedTuple):
    """One arm, world frame, m.

    backbone: (P, 3). tendons: (n_a, P, 3), NaN beyond where each ends. sensors: (k, 3).
    goal: (3,) a point, or (G, 3) a backbone. text: A line over the picture.
    ends: (n,) where the sections end, over the arm's length.
    """

    backbone: Tensor
    tendons: Tensor
    sensors: Tensor
    goal: Tensor
    text: str
    ends: Tensor


class Renderer(Protocol):
    """Draws pictures; made with the length of the arm, m, and whether it stands, as `length` and `upward`."""

    def frame(self, picture: Picture) -> NDArray[Any]:
        """(H, W, 3) uint8."""
        ...


class Window(Protocol):
    """Shows pictures to a person; made likewise."""

    def show(self, picture: Picture, period: float) -> None:
        """Shows a picture, as soon as `period` s have passed since the last one."""
        ...

    def close(self) -> None:
        """Shows nothing any more."""
        ...


def load_renderer(names: Mapping[str, str], mode: str, arm: Arm) -> Any:
    """The `Renderer` or `Window` that "module:class" names for a render mode, with room for the arm.

    Raises:
        ConfigError: None is named, or what draws is not installed.
    """
    if mode not in names:
        raise ConfigError(f'render_mode={mode!r} needs one of renderers, as {{"{mode}": "package.module:Class"}}')
    length = float(arm.rest_lengths().sum())
    try:
        made: Any = load_env_creator(names[mode])
        return made(length=length, upward=bool(arm.base_rotation()[2, 2] > 0))
    except ModuleNotFoundError as error:
        raise ConfigError(f"rendering needs {error.name}: pip install 'apcc-torch[viz]'") from error


def picture(
    q: Tensor, lengths: Tensor, base: Tensor, routing: TendonRouting, sensors: Tensor, goal: Tensor, text: str
) -> Picture:
    """The picture of one arm.

    Args:
        q: (3 n) its configuration.
        lengths: (n,) rest lengths, m.
        base: (3, 3) arm base to world.
        routing: Its tendons.
        sensors: (k, 3) m.
        goal: (3,) or (G, 3) m.
        text: A line over the picture.
    """
    backbone = PCCBackbone(lengths.shape[-1], base)
    X = torch.linspace(0.0, 1.0, POINTS, dtype=q.dtype, device=q.device) * lengths.sum()
    T = backbone.pose(q, lengths, *decouple(X, lengths))
    return Picture(T[:, :3, 3], routing.paths(T, X), sensors, goal, text, lengths.cumsum(-1) / lengths.sum())

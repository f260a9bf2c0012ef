"""Settings of many runs as one: what differs between runs that can share a tensor batch becomes a number a run."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from apcc_torch.composition.build import DTYPES
from apcc_torch.composition.choice import choice
from apcc_torch.composition.schema import SimulateConfig

ROWS: dict[str, frozenset[str]] = {
    "robot": frozenset({"rest_lengths", "initial_estimate", "sensors"}),
    "plant": frozenset(
        {"lengths", "mass", "axial_stiffness", "bending_stiffness", "stiffness_reference", "damping_ratio"}
        | {"K_P", "K_I", "K_D", "force_limit", "tendon_damping"}
    ),
    "sensors": frozenset({"position_noise", "angular_noise", "dropout"}),
    "feedback": frozenset(
        {"angular_weight", "linear_threshold", "angular_threshold", "bend_step", "length_step", "damping"}
        | {"settled_step"}
    ),
    "pose_filter": frozenset({"angular_time", "linear_time", "follow"}),
    "velocity_filter": frozenset({"window"}),
    "controller": frozenset(
        {"K", "gamma", "damping", "null_gain", "epsilon", "null_weights", "null_bends", "null_step", "null_speed"}
        | {"integral_gain", "integral_reach", "bend_rate", "length_rate", "bend_bound", "elongation_bound"}
    ),
    "residual": frozenset(
        {"angular_weight", "time_constant", "elongation_weight", "nominal_weight", "total_weight", "damping"}
        | {"excitation", "memory", "rate", "gains", "shares", "sharpness", "resolution", "stretch", "total_range"}
    ),
    "adaptation": frozenset({"gain_scale", "lower", "upper", "rate", "normalisation", "dead_zone", "reach"}),
    "experiment": frozenset({"r_0", "A", "omega", "setpoints", "payloads"}),
}
"""Keys whose numbers may differ from run to run within one tensor batch; runs that differ in others share none."""

APART = frozenset(
    {"sensors.position_noise", "sensors.angular_noise", "sensors.dropout"}
    | {"residual.angular_weight", "residual.excitation", "residual.memory", "residual.stretch"}
)
"""Keys where zero is no number like others: without noise none is drawn, which changes what is drawn after it, and a
law without memory keeps no evidence."""


class Point(NamedTuple):
    """One run of a batch.

    number: Its number, in the order of a multirun over the same keys.
    settings: {swept key: value}, as text.
    config: All its settings.
    """

    number: int
    settings: dict[str, str]
    config: SimulateConfig


def structure(config: SimulateConfig) -> Hashable:
    """What runs must have in common to share a tensor batch: all but the numbers of `ROWS`, and how many those are."""
    return tuple((name, _form(f"{section}.{name}", value)) for section, name, value in _leaves(config))


def stacked(configs: Sequence[SimulateConfig]) -> SimulateConfig:
    """The settings of runs of one `structure`, for `Builder(..., points=len(configs))`.

    Where all agree, a value stays as it is. Where they differ, it becomes a tensor: (P, 1) of P numbers, (P, 1, n) of P
    lists of n, (P, S, 3) of P lists of set-points.
    """
    first = configs[0]
    dtype, device = DTYPES[choice("dtype", first.dtype, tuple(DTYPES))], torch.device(first.device)
    changes: dict[str, Any] = {}
    for section, names in ROWS.items():
        parts = [getattr(config, section) for config in configs]
        if all(part is parts[0] for part in parts):
            continue
        differing = {
            name: _stack([getattr(part, name) for part in parts], torch.int64 if name == "window" else dtype, device)
            for name in names
            if any(getattr(part, name) != getattr(parts[0], name) for part in parts)
        }
        changes[section] = replace(parts[0], **differing)
    return replace(first, **changes)


def _stack(values: Sequence[Any], dtype: torch.dtype, device: torch.device) -> Tensor:
    tensor = torch.tensor(values, dtype=dtype, device=device)
    return tensor if tensor.dim() == 3 else tensor.unsqueeze(1)


def _leaves(config: SimulateConfig) -> list[tuple[str, str, Any]]:
    """(section, name, value) of every setting; "" is the section of those at the root."""
    leaves: list[tuple[str, str, Any]] = []
    for field in fields(config):
        value = getattr(config, field.name)
        if is_dataclass(value):
            leaves += [(field.name, inner.name, getattr(value, inner.name)) for inner in fields(value)]
        else:
            leaves.append(("", field.name, value))
    return leaves


def _form(key: str, value: Any) -> Hashable:
    section, _, name = key.partition(".")
    if name in ROWS.get(section, ()):
        if key in APART:
            return value > 0
        sizes = _sizes(value)
        if sizes is not None:
            return sizes
    return repr(value)


def _sizes(value: Any) -> tuple[int, ...] | None:
    """() of a number, (n,) of a list of numbers, (S, n) of a list of such lists; None of anything else."""
    if isinstance(value, bool):
        return None
    if isinstance(value, int | float):
        return ()
    if isinstance(value, list):
        inner = {_sizes(entry) for entry in value}
        if len(inner) == 1 and None not in inner:
            (sizes,) = inner
            return (len(value), *sizes)  # type: ignore[misc]
    return None

"""The numbers that a fit may change: blocks of parameters, each with a nominal value and how far it may lie from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.shapes import check_finite, check_positive, check_tensor

Values = Mapping[str, Tensor]
"""A value for every block, by name."""


@dataclass(frozen=True)
class Block:
    """Parameters of one kind.

    Attributes:
        nominal: What they are believed to be before the fit, shape (p,).
        spread: Standard deviation of that belief, shape (p,): in the parameter's unit, or, where `logarithmic`, of its
            natural logarithm. Zero where a parameter is held at its nominal value.
        unit: The unit, for tables.
        labels: A word for each parameter, p of them, such as "tendon 3".
        logarithmic: Whether the parameters are positive and known by their ratio to the nominal values.
    """

    nominal: Tensor
    spread: Tensor
    unit: str
    labels: tuple[str, ...]
    logarithmic: bool = False

    def at(self, z: Tensor) -> Tensor:
        """The values at standard scores z (p,): zero is nominal, one is a spread away."""
        return self.nominal * torch.exp(self.spread * z) if self.logarithmic else self.nominal + self.spread * z


class Parameters:
    """Blocks side by side. What is fitted is z, the standard scores of all parameters that have a spread.

    In z the belief before the fit is the standard normal distribution, whatever the units.

    Args:
        blocks: By name.

    Raises:
        ConfigError: A block's nominal values, spreads and labels differ in number.
        ValueRangeError: A spread is negative, or a fitted logarithmic nominal value is not positive.
    """

    def __init__(self, blocks: Mapping[str, Block]) -> None:
        for name, block in blocks.items():
            check_finite(name, check_tensor(name, block.nominal, (None,)))
            check_finite(f"spread of {name}", block.spread)
            p = len(block.nominal)
            if block.spread.shape != (p,) or len(block.labels) != p:
                raise ConfigError(
                    f"{name} has {p} values, but {len(block.spread)} spreads and {len(block.labels)} labels"
                )
            if bool((block.spread < 0).any()):
                raise ValueRangeError(f"spread of {name} must not be negative")
            if block.logarithmic:
                # What is held may be zero, such as a friction that is left out.
                check_positive(name, block.nominal[block.spread > 0])
        self.blocks = dict(blocks)
        self._free = {name: (block.spread > 0).nonzero()[:, 0] for name, block in self.blocks.items()}

    @property
    def names(self) -> list[str]:
        """The name of every fitted parameter, in the order of z: "offset: tendon 3"."""
        return [f"{name}: {self.blocks[name].labels[int(i)]}" for name, free in self._free.items() for i in free]

    def __len__(self) -> int:
        """Number of fitted parameters."""
        return sum(len(free) for free in self._free.values())

    def scores(self, z: Tensor) -> dict[str, Tensor]:
        """Standard scores of every block (p,), zero where a parameter is held, from those of the fitted ones (P,)."""
        parts = z.split([len(free) for free in self._free.values()])
        full = {}
        for (name, free), part in zip(self._free.items(), parts, strict=True):
            zeros = torch.zeros(len(self.blocks[name].nominal), dtype=z.dtype, device=z.device)
            full[name] = zeros.index_put((free,), part)
        return full

    def values(self, z: Tensor) -> dict[str, Tensor]:
        """Every block's values at z (P,); differentiable."""
        return {name: self.blocks[name].at(part) for name, part in self.scores(z).items()}

    def nominal(self) -> Tensor:
        """z (P,) of the nominal values: zeros."""
        first = next(iter(self.blocks.values())).nominal
        return torch.zeros(len(self), dtype=first.dtype, device=first.device)

    def holding(self, fitted: Sequence[str]) -> Parameters:
        """The same blocks, of which only those named are fitted.

        Raises:
            ConfigError: There is no such block.
        """
        unknown = set(fitted) - set(self.blocks)
        if unknown:
            raise ConfigError(f"there is no block {sorted(unknown)[0]!r}; there are {', '.join(sorted(self.blocks))}")
        return Parameters(
            {
                name: Block(b.nominal, b.spread if name in fitted else 0.0 * b.spread, b.unit, b.labels, b.logarithmic)
                for name, b in self.blocks.items()
            }
        )

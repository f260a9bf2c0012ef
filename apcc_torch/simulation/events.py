"""What happens to a true arm during a run: its tip takes up a load or lets go of it, its material creeps or grows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError
from apcc_torch.part import Part, hold_rows
from apcc_torch.settings import OURS, Setting, Settings, resolved, setting
from apcc_torch.spread import Numbers, is_profile, spread


@dataclass(frozen=True, kw_only=True)
class ArmEventsSettings(Settings):
    """Settings of `ArmEvents`. The clock starts when the arm has settled."""

    taken: Setting = setting(
        0.0,
        "kg",
        OURS,
        "that the tip takes up; negative: that it lets go of, at most what it carries",
        rows="number",
        least=-1000,
        most=1000,
    )
    taken_at: Setting = setting(5.0, "s", OURS, "when it does", rows="number", least=0)
    growth: Numbers = setting(
        0.0,
        "",
        OURS,
        "of each section's rest length, by which it creeps or grows in all",
        rows="sections",
        above=-1,
        most=1,
    )
    growth_from: Setting = setting(0.0, "s", OURS, "when that begins", rows="number", least=0)
    growth_over: Setting = setting(10.0, "s", OURS, "how long it takes, evenly", rows="number", above=0)


class ArmEvents(Part):
    """Payload and natural lengths of arms over time.

    A load is taken up in motion: it has the tip's velocity then, and keeps it when it is let go. A section that has
    grown rests at its new length and is as stiff as before; tendons and sensors stay where they sit on the material.

    Args:
        n_sections: Of the true arm; its growth may be told for each, or for each run of as many of them.
        *settings, **changes: See `ArmEventsSettings`; numbers may be tensors (...), one a row.

    Raises:
        ConfigError: The sections cannot be divided among the entries of `growth`.

    Example:
        >>> events = ArmEvents(4, taken=-0.5, taken_at=1.0, growth=[0.0, 0.1], growth_over=2.0)
        >>> payload, time = torch.tensor([0.2, 0.7]), torch.tensor([0.5, 1.0])
        >>> events.payload(payload, time)
        tensor([0.2000, 0.2000])
        >>> events.growth_at(time)
        tensor([[0.0000, 0.0000, 0.0250, 0.0250],
                [0.0000, 0.0000, 0.0500, 0.0500]], dtype=torch.float64)
    """

    settings_type = ArmEventsSettings
    taken: Setting
    taken_at: Setting
    growth: Setting
    growth_from: Setting
    growth_over: Setting

    def __init__(self, n_sections: int, *settings: Any, **changes: Any) -> None:
        super().__init__()
        s = resolved(ArmEventsSettings, settings, changes)
        growth = s.growth
        if is_profile(growth):
            growth = spread("growth", growth, n_sections)
        elif not isinstance(growth, Tensor | int | float):
            growth = spread("growth", growth, len(growth))
        if isinstance(growth, Tensor):
            if not growth.dim() or n_sections % growth.shape[-1]:
                raise ConfigError(
                    f"growth must have one entry for each of {n_sections} sections, or for as many of them each, "
                    f"got {tuple(growth.shape)}"
                )
            hold_rows(self, growth=(growth, 1))
        self.n_sections = n_sections
        self.hold(s)

    @property
    def grows(self) -> bool:
        """Whether any section does, in any row."""
        return isinstance(self.growth, Tensor) or self.growth != 0

    def payload(self, payload: Tensor, time: Tensor) -> Tensor:
        """The payload (...), kg, of arms that start with `payload` (...), at a time (...), s."""
        if not isinstance(self.taken, Tensor) and self.taken == 0:
            return payload
        return torch.where(time >= self.taken_at, torch.clamp(payload + self.taken, min=0.0), payload)

    def growth_at(self, time: Tensor) -> Tensor:
        """(..., n_sections) how much longer the sections rest than at first, as shares, at a time (...), s."""
        share = torch.clamp((time - self.growth_from) / self.growth_over, 0.0, 1.0).unsqueeze(-1)
        growth = self.growth
        if not isinstance(growth, Tensor):
            return (growth * share).expand(*share.shape[:-1], self.n_sections)
        each = self.n_sections // growth.shape[-1]
        return share * growth.unsqueeze(-1).expand(*growth.shape, each).flatten(-2)

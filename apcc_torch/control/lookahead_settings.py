"""What a controller that looks ahead can be set to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from apcc_torch.errors import ConfigError
from apcc_torch.settings import OURS, PAPER, Settings, setting
from apcc_torch.spread import spread


@dataclass(frozen=True, kw_only=True)
class PredictedLoopSettings(Settings):
    """Settings of `PredictedLoop`: the model that is rolled out, and what a way costs.

    Each cost is the square of something over the size of it that costs 1, in the mean over the horizon.
    """

    horizon: float = setting(0.3, "s", OURS, "that is looked ahead", above=0)
    steps: int = setting(15, "", OURS, "of the model in the horizon", least=2, most=1000)
    K_P: float = setting(750.0, "N/m", PAPER, "of the tendons' loop believed", above=0)
    K_D: float = setting(5.0, "N s/m", PAPER, "of it, likewise", least=0)
    tendon_damping: float = setting(200.0, "N s/m", OURS, "viscous friction of each tendon believed", least=0)
    approach: float = setting(2.5, "1/s", OURS, "with which the tip's error is to fall", above=0)
    lead: float = setting(0.15, "s", OURS, "in which the tip's velocity is to become that", above=0)
    tip_error: float = setting(0.01, "m", OURS, "of the tip from there that costs 1", above=0)
    final_speed: float = setting(0.1, "m/s", OURS, "of the tip's velocity from it, at the end, that costs 1", above=0)
    final_weight: float = setting(5.0, "", OURS, "of the end, over the mean of the way", least=0)
    elongation: float | None = setting(0.05, "m", OURS, "Psi that costs 1; null: it costs nothing", above=0)
    tip_departure: float | None = setting(
        1.0, "m/s", OURS, "of the tip's velocity from Eq. (16) that costs 1; null: nothing", above=0
    )
    free_departure: float | None = setting(
        1.0, "rad/s, m/s", OURS, "of the configuration's where the tip leaves it free, likewise", above=0
    )
    force: float | None = setting(30.0, "N", OURS, "rms of the tendons that costs 1; null: nothing", above=0)
    force_limit: float | None = setting(None, "N", OURS, "of each tendon; null: none", above=0)
    length_limit: float | None = setting(None, "m", OURS, "of each tendon's length change; null: none", above=0)
    excess: float = setting(0.1, "", OURS, "part of a limit by which passing it costs 1", above=0)
    spheres: tuple[Any, ...] = setting((), "m", OURS, "obstacles: lists of x, y, z of the centre, and the radius")
    radius: float = setting(0.03, "m", OURS, "of the arm, beside obstacles", above=0)
    clearance: float = setting(0.02, "m", OURS, "distance to be kept from obstacles", above=0)
    intrusion: float = setting(1e-3, "m", OURS, "into that distance that costs 1, at every point of the arm", above=0)
    points: int = setting(13, "", OURS, "of the backbone that are looked at beside obstacles", least=2, most=1000)

    def check(self) -> None:
        """Raises where a sphere is none."""
        for i, sphere in enumerate(self.spheres):
            if not isinstance(sphere, list | tuple):
                raise ConfigError(f"spheres[{i}] must be a list of 4 numbers, got {sphere!r}")
            spread(f"spheres[{i}]", sphere, 4)
            if float(sphere[3]) <= 0.0:
                raise ConfigError(f"spheres[{i}] must have a positive radius, got {sphere!r}")


@dataclass(frozen=True, kw_only=True)
class LookaheadSettings(PredictedLoopSettings):
    """Settings of `Lookahead`: how ways are sampled, and what the model is told."""

    samples: int = setting(256, "", OURS, "ways that are rolled out", least=3, most=10**6)
    knots: int = setting(3, "", OURS, "of each way's departure from Eq. (16) over the horizon", least=2, most=100)
    tip_spread: float = setting(
        1.0, "", OURS, "deviation of the tip's velocity at a knot, over that of Eq. (16)", least=0
    )
    tip_floor: float = setting(0.002, "m/s", OURS, "its least deviation", least=0)
    bend_spread: float = setting(0.3, "rad/s", OURS, "deviation of bends where the tip leaves them free", least=0)
    length_spread: float = setting(0.02, "m/s", OURS, "of elongations, likewise", least=0)
    temperature: float = setting(
        0.1, "", OURS, "of the weights, over the mean cost above the least; small: the best alone", above=0
    )
    observer_gain: float = setting(10.0, "1/s", OURS, "low-pass on the forces that the arm does not explain", above=0)
    payload_time: float = setting(2.0, "s", OURS, "memory of the payload", above=0)
    force_time: float = setting(0.5, "s", OURS, "in which what the payload leaves is taken over", above=0)
    rate_time: float = setting(0.02, "s", OURS, "low-pass on the rate of the configuration", least=0)
    payload_limit: float = setting(1.0, "kg", OURS, "largest payload that is believed", least=0)
    batch: int = setting(16, "", OURS, "sets of samples, taken in turn", least=1, most=10**6)
    seed: int = setting(0, "", OURS, "of the samples", least=0, most=2**63 - 1)

"""A guess about a recording, held against its arm: what cannot be so is named, with what to declare instead."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from apcc_torch.errors import DataError
from apcc_torch.lie.rotations import quaternion_rotation
from apcc_torch.model.arm import Arm
from apcc_torch.model.table import table
from apcc_torch.recordings.declaration import AXES, METRES, ORDERS, RecordingSettings
from apcc_torch.recordings.raw_poses import UP, Posed, RawPoses, metres

NEAR, FAR = 0.5, 1.8
"""Distance of two bodies where the arm is straightest, over its length between them, outside of which it is wrong."""
UNITS, CLOSE = ("m", "cm", "mm", "in"), math.log(1.5)
"""Units that are proposed, and how near to the arm's length, as a ratio, one has to come."""
STRAIGHT = 0.9
"""Of the frames, the share that is more bent than those in which an arm counts as straight."""
ASKEW, RIGHT = math.radians(60.0), math.radians(40.0)
"""Angle to the way that the arm points from which on it points another way, and up to which it points this way."""
TURNS = math.radians(5.0)
"""Turn of a body from which on its orientations tell an order of a quaternion from another."""
BETTER = 2.0
"""By how much another order has to agree better with the positions."""
FEWEST = 5
"""Frames that a statement is made of at least."""


def check_guess(raw: RawPoses, posed: Posed, settings: RecordingSettings, arm: Arm, source: str) -> None:
    """Raises where positions, orientations and the arm cannot go together as declared.

    Held against each other are the spacing of the bodies and the arm's lengths (a wrong unit), the way from the first
    body to the last and the way the arm points (a wrong axis, bodies from the tip to the base), and how bodies turn and
    how the arm between them bends (a quaternion's order). A left hand's frame is the mirror image of an arm that could
    be as well, so nothing tells it. Nothing is said where there is too little to say
    it from. Only ratios count, so the arm may be of any size, and only frames in which a body was seen.

    Raises:
        DataError: They cannot; the sentence says what to declare.
    """
    places = arm.sensor_places()
    if len(places) != raw.position.shape[1]:
        return  # another check's matter
    position = torch.where(raw.tracked.unsqueeze(-1), posed.position, torch.nan)
    _check_unit(position, places, raw, settings, arm, source)
    _check_way(position, settings, arm, source)
    _check_turns(raw, posed, settings, source)


def _spacing(position: Tensor, places: Tensor, arm: Arm) -> tuple[Tensor, Tensor]:
    """Distances (T, n) of bodies from the ones before, of a single one from the base, and what the arm says (n,)."""
    beside = torch.linalg.vector_norm(table("mounts", arm.mounts, len(places), 3), dim=-1)
    if len(places) == 1:
        base = torch.tensor(arm.placement.position, dtype=position.dtype)
        return torch.linalg.vector_norm(position - base, dim=-1), places + beside
    return torch.linalg.vector_norm(position.diff(dim=1), dim=-1), places.diff() + beside[1:] + beside[:-1]


def _check_unit(
    position: Tensor, places: Tensor, raw: RawPoses, settings: RecordingSettings, arm: Arm, source: str
) -> None:
    distance, length = _spacing(position, places, arm)
    enough = distance.isfinite().sum(0) >= FEWEST
    if not bool(enough.any()):
        return
    ratio = float((distance.nanquantile(STRAIGHT, dim=0) / length)[enough].median())
    if NEAR <= ratio <= FAR or not ratio > 0:
        return
    now = metres(settings, raw.unit)
    fit = {name: abs(math.log(ratio * METRES[name] / now)) for name in UNITS}
    name = min(UNITS, key=lambda each: fit[each])
    reach = f"lie {ratio:.3g} times as far apart as the arm's lengths let them"
    if len(places) == 1:
        if ratio < NEAR and fit[name] > CLOSE:
            return  # an arm that is curled up
        reach = f"lies {ratio:.3g} times as far from arm.placement.position as it is along the arm"
    what = "the bodies " + reach if len(places) > 1 else "the body " + reach
    if fit[name] < CLOSE and METRES[name] != now:
        raise DataError(f"{source}: {what}: write recording.unit: {name}")
    where = "arm.placement.position, " if len(places) == 1 else ""
    raise DataError(f"{source}: {what}: check recording.unit, {where}recording.bodies, arm.lengths and arm.sensors")


def _check_way(position: Tensor, settings: RecordingSettings, arm: Arm, source: str) -> None:
    if position.shape[1] == 1:
        way = position[:, 0] - torch.tensor(arm.placement.position, dtype=position.dtype)
    else:
        way = position[:, -1] - position[:, 0]
    size = torch.linalg.vector_norm(way, dim=-1)
    known = (size > 0).nonzero()[:, 0]
    if len(known) < FEWEST:
        return
    way, size = way[known] / size[known].unsqueeze(-1), size[known]
    wanted = arm.placed_rotation()[:, 2].to(way)
    # An arm may be bent to one side throughout, or in its straightest frames, but hardly in both.
    means = [way.mean(0), way[size >= size.quantile(STRAIGHT)].mean(0)]
    if any(float(mean.norm()) < 0.5 or _angle(mean, wanted) <= ASKEW for mean in means):
        return
    mean = means[0]
    points = f"the bodies lie along {_named(mean)} where the arm points along {_named(wanted)}"
    now = settings.up or "z"
    there = torch.tensor(UP[now], dtype=mean.dtype).mT @ mean  # in the file's frame
    turned = {axis: _angle(torch.tensor(UP[axis], dtype=mean.dtype) @ there, wanted) for axis in AXES if axis != now}
    axis = min(turned, key=lambda each: turned[each])
    if now == "z" and axis == "-z" and turned[axis] <= RIGHT:
        other = "standing" if arm.base == "hanging" else "hanging"
        raise DataError(
            f"{source}: {points}: write arm.base: {other}, or recording.up: -z, or name the bodies from base to tip"
        )
    if turned[axis] <= RIGHT:
        raise DataError(f"{source}: {points}: write recording.up: {axis}, or arm.placement.rotation as it is there")
    if _angle(mean, -wanted) <= RIGHT:
        raise DataError(f"{source}: {points}: check recording.up, and name the bodies from the base to the tip")
    raise DataError(f"{source}: {points}: check recording.up and arm.placement.rotation")


def _check_turns(raw: RawPoses, posed: Posed, settings: RecordingSettings, source: str) -> None:
    now = _disagreement(raw, posed)
    if now is None or now <= TURNS:
        return
    for order in ORDERS:
        other = _disagreement(raw, raw.posed(settings.changed(quaternion_order=order)))
        if other is not None and other * BETTER < now:
            raise DataError(
                f"{source}: the bodies turn otherwise than the arm bends, by {math.degrees(now):.0f} degrees: "
                f"write recording.quaternion_order: {order}"
            )


def _disagreement(raw: RawPoses, posed: Posed) -> float | None:
    """Between how the chord from a body to the next turns and how the bodies do, rad, root mean square.

    On an arc the chord turns by the mean of what its ends turn. None where there is too little to tell.
    """
    seen = raw.tracked & posed.quaternion.isfinite().all(-1) & posed.position.isfinite().all(-1)
    R = quaternion_rotation(torch.nn.functional.normalize(posed.quaternion, dim=-1))
    squares, count, turned = 0.0, 0, 0.0
    for k in range(R.shape[1] - 1):
        both = (seen[:, k] & seen[:, k + 1]).nonzero()[:, 0]
        if len(both) < FEWEST:
            continue
        chord = posed.position[both, k + 1] - posed.position[both, k]
        size = torch.linalg.vector_norm(chord, dim=-1)
        first = int(size.argmax())
        chord = chord / size.unsqueeze(-1)
        tangents = [R[both, b] @ R[both[first], b].mT @ chord[first] for b in (k, k + 1)]
        told = torch.nn.functional.normalize(tangents[0] + tangents[1], dim=-1)
        squares += float(_between(told, chord).square().sum())
        turned = max(turned, float(_between(chord, chord[first : first + 1]).quantile(STRAIGHT)))
        count += len(both)
    # What hardly turns says nothing of how it turns.
    return math.sqrt(squares / count) if count and turned > 2.0 * TURNS else None


def _between(a: Tensor, b: Tensor) -> Tensor:
    """Angle between unit vectors (..., 3), rad."""
    return torch.linalg.vector_norm(a - b, dim=-1).div(2.0).clamp(max=1.0).asin().mul(2.0)


def _angle(a: Tensor, b: Tensor) -> float:
    return float(_between(a / a.norm(), b / b.norm()))


def _named(way: Tensor) -> str:
    """The axis that a direction is nearest to."""
    k = int(way.abs().argmax())
    return f"{'-' if float(way[k]) < 0 else ''}{'xyz'[k]}"

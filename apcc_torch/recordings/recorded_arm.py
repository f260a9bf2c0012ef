"""What a recorded arm needs to be replayed: its calibration, estimator and gate, and the gate's word on every frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.estimation.rest_calibration import RestCalibration
from apcc_torch.estimation.sensor_gate import GateState, GateVerdict, SensorGate
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.recordings.recording import Recording
from apcc_torch.recordings.rest_pose import calibrate

TRUNK_DIRECTION = (0.0, -1.0, 0.0)
"""Along the resting arm of the trunk-stack recordings, base to tip, in the recording frame."""
TRUNK_BASE = (0.0986, -0.0055, 0.1061)
"""Base of that arm in the recording frame, m. Its height carries the disks' spacing on. Its place beside the disks is
where the sections' delta L cease to follow their bends: with the base above the disks' mean all three do, by the same
5.3 and 17.1 mm/rad, as those of an arm seen from a line that runs 18 mm beside its axis."""


class RecordedArm(NamedTuple):
    """What a recording needs to be replayed."""

    calibration: RestCalibration
    feedback: StateFeedback
    gate: SensorGate


def recorded_arm(
    recording: Recording,
    direction: Sequence[float] | None = TRUNK_DIRECTION,
    mode: str = "pose",
    angular_weight: float = 0.1,
    rest: int | None = None,
    base_position: Sequence[float] | None = None,
) -> RecordedArm:
    """Calibration, estimator and gate of a recorded arm; the defaults suit the trunk-stack recordings.

    One section ends at each body, so rest lengths are the spacing of the bodies at rest. The estimator settles at
    1e-5 (rad, m), far below what a camera resolves, and may take 12 steps: real bodies are never fitted to the
    thresholds, so every frame runs until it settles. The gate's limits are its own defaults.

    Args:
        recording: The recording.
        direction: As `calibrate`; None: the line through the bodies at rest.
        mode: As `StateFeedback`.
        angular_weight: Metres that one radian counts as. The paper's is 1; with 0.1, about a section's length, an
            error of a position and of a rotation that it implies weigh the same.
        rest: As `calibrate`.
        base_position: As `calibrate`; TRUNK_BASE for the trunk-stack recordings. None: above the bodies' mean.

    Raises:
        ApccError: As `calibrate` and `StateFeedback`.

    Example:
        >>> place = torch.tensor([[0.0, 0.0, -0.2], [0.0, 0.0, -0.45]]).double().expand(50, 2, 3)
        >>> turn = torch.tensor([1.0, 0.0, 0.0, 0.0]).double().expand(50, 2, 4)
        >>> still = Recording(("middle", "tip"), torch.arange(50).double() / 100, place, turn, torch.ones(50, 2).bool())
        >>> arm = recorded_arm(still, direction=None, rest=50, base_position=[0.0, 0.0, 0.0])
        >>> arm.calibration.rest_lengths
        tensor([0.2000, 0.2500], dtype=torch.float64)
    """
    calibration = calibrate(recording, rest=rest, direction=direction, base_position=base_position)
    abscissae = calibration.abscissae
    feedback = StateFeedback(
        PCCBackbone(len(abscissae)), abscissae, mode, angular_weight, max_iterations=12, settled_step=1e-5
    )
    return RecordedArm(calibration, feedback, SensorGate(abscissae))


def gate_frames(gate: SensorGate, T: Tensor, tracked: Tensor, times: Tensor) -> tuple[Tensor, GateVerdict]:
    """`gate_recording`, with all frames judged at once.

    A frame's verdict depends on the earlier ones only through which of them were accepted. Guessed and judged anew
    from the first frame on that was guessed wrong, the guess becomes the frame-by-frame result in a few rounds.

    Args:
        gate: The gate.
        T: Poses in the base frame, shape (N, k, 4, 4).
        tracked: Which sensors the source saw, bool, shape (N, k).
        times: Time stamps in s, shape (N,).

    Returns:
        The poses with the last accepted ones held where one was not accepted, shape (N, k, 4, 4), and the verdicts,
        each of shape (N, k).
    """
    seen = tracked & T.isfinite().flatten(-2).all(-1)
    position_ok, orientation_ok = seen, seen
    parts: list[tuple[Tensor, ...]] = []
    begin = 0
    while begin < len(T):
        state = _state_before(T, times, position_ok, orientation_ok, begin)
        after, verdict = gate(state, T[begin:], tracked[begin:], times[begin:])
        wrong = (verdict.position_ok != position_ok[begin:]) | (verdict.orientation_ok != orientation_ok[begin:])
        index = wrong.any(-1).nonzero()
        right = int(index[0]) + 1 if len(index) else len(T) - begin
        parts.append((after.poses()[:right], *(code[:right] for code in verdict)))
        position_ok = torch.cat((position_ok[:begin], verdict.position_ok))
        orientation_ok = torch.cat((orientation_ok[:begin], verdict.orientation_ok))
        begin += right
    held, *codes = (torch.cat(part) for part in zip(*parts, strict=True))
    return held, GateVerdict(*codes)


def _state_before(T: Tensor, times: Tensor, position_ok: Tensor, orientation_ok: Tensor, begin: int) -> GateState:
    """The gate's state before each frame from `begin` on, were these the accepted ones."""
    sensor = torch.arange(T.shape[1], device=T.device)
    number = torch.arange(1, len(T) + 1, device=T.device).unsqueeze(-1)

    def last(ok: Tensor) -> tuple[Tensor, Tensor]:
        # 1 + the number of the last accepted frame before each; 0 where there is none.
        count = torch.where(ok, number, 0).cummax(0).values
        before = torch.nn.functional.pad(count[:-1], (0, 0, 1, 0))[begin:]
        stamp = torch.where(before > 0, times[(before - 1).clamp(min=0)], -torch.inf)
        return before, stamp

    placed, placed_time = last(position_ok)
    turned, turned_time = last(orientation_ok)
    p = T[(placed - 1).clamp(min=0), sensor][..., :3, 3]
    R = T[(turned - 1).clamp(min=0), sensor][..., :3, :3]
    eye = torch.eye(3, dtype=T.dtype, device=T.device)
    return GateState(
        torch.where(placed.unsqueeze(-1) > 0, p, 0.0),
        torch.where(turned[..., None, None] > 0, R, eye),
        placed_time,
        turned_time,
    )

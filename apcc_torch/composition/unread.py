"""Keys that nothing in a run reads: whoever gives one means something by it, and is told instead of being ignored."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TypeVar

from apcc_torch.composition.run_settings import RunSettings, SimulateSettings
from apcc_torch.control.length_law import LengthLaw
from apcc_torch.errors import Checks, ConfigError
from apcc_torch.part import part_of
from apcc_torch.settings import Settings

Run = TypeVar("Run", bound=Settings)
Unread = Iterator[tuple[str, str]]
"""Keys, or groups of them, and why nothing reads them; several are parted by blanks."""

ONE_TARGET = "experiment.setpoints experiment.subset"
SINE = "experiment.r_0 experiment.A experiment.omega"
STARTS = "experiment.start_errors experiment.start_error"
BODY = (
    "arm.racks arm.tendon_offset arm.tendons_per_rack arm.rack_twist arm.layout arm.tendons arm.mass arm.masses "
    "arm.payload arm.axial_stiffness arm.bending_stiffness arm.stiffness_reference arm.stiffness_rule "
    "arm.axial_rigidity arm.bending_rigidity arm.damping_ratio arm.true_sensors"
)
"""What forces act on and tendons pull: none of it is in kinematics."""
TENDONS = (
    "arm.racks arm.tendon_offset arm.tendons_per_rack arm.rack_twist arm.layout arm.tendons plant.pid "
    "plant.tendon_damping plant.transmission plant.backlash sensors.tendon_noise sensors.tendon_stretch"
)
"""What tendons and their motors alone have."""


def reasons_of(unread: Unread) -> dict[str, str]:
    """Key or group -> why nothing reads it."""
    return {key: why for keys, why in unread for key in keys.split()}


def check_given(unread: Callable[[Run], Unread], runs: Sequence[Run], words: Iterable[str]) -> None:
    """Raises ConfigError where a word of a command line sets a key that none of its runs reads.

    Args:
        unread: What a run does not read.
        runs: The settings of each run: of one, or of a sweep's, in some of which a key may idle.
        words: The command line, KEY=VALUE; others are passed over.
    """
    reasons = [reasons_of(unread(run)) for run in runs]
    checks = Checks()
    for word in words:
        key = re.match(r"\+{0,2}([\w.]+)(@[\w.]+)?=", word)
        idle = [] if key is None else [why_unread(key[1], told) for told in reasons]
        with checks.one():
            if idle and all(idle):
                raise ConfigError(f"{key[1]} is read by nothing: {idle[0]}")  # type: ignore[index]
    checks.end()


def why_unread(key: str, told: Mapping[str, str]) -> str | None:
    """Why nothing reads a key, told of it or of a group that it is in; None where something does."""
    parts = key.split(".")
    return next((told[head] for n in range(1, len(parts) + 1) if (head := ".".join(parts[:n])) in told), None)


def of_a_run(c: RunSettings, velocity: bool = False) -> Unread:
    """What neither a simulation nor a run in real time reads; `velocity`: whether more than the laws need it."""
    e, arm = c.experiment, c.arm
    law = None if c.adaptation is None else part_of(c.adaptation)
    why = None
    if not c.controller.adaptive:
        why = "controller.adaptive is false"
        yield "adaptation bounds", why
    elif law is None:
        why = "there is no law of the rest lengths, adaptation is none"
        yield "bounds", why
    elif not law.needs_velocity:
        why = f"{law.__name__} needs no velocity"
    if why is not None:
        yield "controller.velocity", why
    elif c.controller.velocity == "commanded":
        why = "controller.velocity is commanded, and it filters the measured one"
    if why is not None and not velocity:
        yield "velocity_filter", why
    if c.feedback.mode == "position":
        yield "feedback.angular_weight feedback.angular_threshold", "feedback.mode is position"
    for given, unread in {
        "masses": "arm.mass",
        "axial_rigidity": "arm.axial_stiffness",
        "bending_rigidity": "arm.bending_stiffness",
    }.items():
        if getattr(arm, given) is not None:
            yield unread, f"arm.{given} says it"
    if arm.axial_rigidity is not None and arm.bending_rigidity is not None:
        yield "arm.stiffness_reference arm.stiffness_rule", "arm.axial_rigidity and arm.bending_rigidity say it"
    if arm.tendons.offsets is not None:
        yield "arm.tendon_offset", "arm.tendons.offsets says it"
    yield from of_its_sensors(c, law is not None and law.shape_feedback is not LengthLaw.shape_feedback)
    if arm.chambers is None:
        yield "pressure", "the arm has no chambers"
    else:
        yield TENDONS, "the arm has chambers in place of tendons"
    for on in ("arm", "plant.arm"):
        yield f"{on}.actuation {on}.mounts {on}.rest_bend {on}.placement.position", "identification alone needs it"
    events = c.plant.events
    if events.taken == 0:
        yield "plant.events.taken_at", "plant.events.taken is zero"
    if events.growth == 0:
        yield "plant.events.growth_from plant.events.growth_over", "plant.events.growth is zero"
    if e.setpoints:
        yield SINE, "experiment.setpoints are the targets"
    elif e.kind != "kinematic":
        yield "experiment.subset", "there are no experiment.setpoints"


def of_its_sensors(c: RunSettings, shape: bool) -> Unread:
    """What kinds of sensors that are not there would read; `shape`: whether the law estimates the arm's shape."""
    yield "plant.arm.sensed plant.arm.curvature_sensors", "arm.sensed and arm.curvature_sensors say it of the true arm"
    kinds, own = c.arm.sensor_kinds(), shape and c.controller.adaptive
    if kinds is None or not kinds.inertial:
        yield "sensors.inertial", "arm.sensed names no orientation and no tilt"
        if own:
            yield "adaptation.tilt_noise adaptation.heading_noise adaptation.heading_drift", "arm.sensed names none"
    if c.arm.curvature_sensors is None:
        yield "sensors.curvature", "arm.curvature_sensors is null"
        if own:
            yield "adaptation.curvature_noise", "arm.curvature_sensors is null"
    elif not own:
        yield "arm.curvature_sensors sensors.curvature", "algorithm 2 takes positions and poses alone"


def of_a_simulation(c: SimulateSettings) -> Unread:
    """What a simulation does not read."""
    kind, e = c.experiment.kind, c.experiment
    yield from of_a_run(c, velocity=kind == "dynamic" and c.dynamics_law is not None)
    if kind == "kinematic":
        alone = "experiment kinematic has no forces: its true arm follows the command"
        yield f"plant dynamics_law lookahead experiment.payloads {BODY}", alone
        yield ONE_TARGET, "experiment kinematic follows its sine"
        if c.state == "exact":
            yield (
                "sensors feedback velocity_filter pose_filter integral controller.velocity",
                "state is exact: q is known",
            )
        if not e.start_errors:
            yield "experiment.start_error", "experiment.start_errors is zero"
    else:
        yield STARTS, "experiment kinematic alone has more rows for them"
        if c.state == "exact":
            yield "state", "experiment kinematic alone can know q"
    if kind == "replay":
        moved = "experiment replay moves no arm"
        yield (
            f"plant sensors dynamics_law lookahead experiment.duration experiment.payloads {ONE_TARGET} {SINE} {BODY}",
            moved,
        )
        yield "arm.lengths arm.sensors controller.rate", "experiment replay takes it from the recording"
        yield "arm.sensed arm.curvature_sensors", "a recording holds poses"
        if not c.controller.adaptive:
            yield (
                "controller.K controller.null_gain controller.velocity pose_filter integral",
                "controller.adaptive is false",
            )
    else:
        yield "replay recording data data_root", f"experiment {e.name} replays no recording"
    if c.prune.after is None:
        yield "prune.above", "prune.after is null"
    if c.batch is None:
        yield "batch_kept batch_memory_mib batch_workers", "there is no batch, see --batch"

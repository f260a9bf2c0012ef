"""What a fit may change of an arm: its description as blocks of numbers, and the identified arm from their values."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from apcc_torch.identification.parameters import Block, Parameters, Values
from apcc_torch.lie import so3
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.arm import Arm, vector
from apcc_torch.model.arm_placement import Placement
from apcc_torch.model.table import Table, table
from apcc_torch.settings import OURS, Settings, setting
from apcc_torch.spread import Numbers, spread

KEYS = {
    "rest_length": "lengths",
    "angle": "tendons.angles",
    "offset": "tendons.offsets",
    "input_scale": "actuation.pulls",
    "pre_stretch": "actuation.pre_stretch",
    "tendon_stiffness": "actuation.stiffness",
    "bending_rigidity": "bending_rigidity",
    "axial_rigidity": "axial_rigidity",
    "rest_bend": "rest_bend",
    "friction": "actuation.friction",
    "damping_ratio": "damping_ratio",
    "gravity": "placement.gravity",
    "base_position": "placement.position",
    "base_rotation": "placement.rotation",
    "mount": "mounts",
}
"""Where an arm's file holds what a block does."""


@dataclass(frozen=True, kw_only=True)
class Spreads(Settings):
    """How far an arm may be from its file, as a standard deviation: one number for all entries of a block, or one each.

    Zero holds what the file says. Without a unit it is of the natural logarithm, and so of a ratio.
    """

    rest_length: Numbers = setting(0.05, "", OURS, "of the sections' rest lengths", least=0)
    angle: Numbers = setting(0.1, "rad", OURS, "of the tendons' angles around the backbone", least=0)
    offset: Numbers = setting(0.1, "", OURS, "of the tendons' distances from the backbone", least=0)
    input_scale: Numbers = setting(0.02, "", OURS, "of what each input pulls in", least=0)
    pre_stretch: Numbers = setting(1e-3, "m", OURS, "of the tendons' stretch where inputs are zero", least=0)
    tendon_stiffness: Numbers = setting(0.7, "", OURS, "of the tendons' stiffness", least=0)
    bending_rigidity: Numbers = setting(0.7, "", OURS, "of the sections' EI", least=0)
    axial_rigidity: Numbers = setting(1.0, "", OURS, "of the sections' EA", least=0)
    rest_bend: Numbers = setting(0.1, "rad", OURS, "of the sections' bends (x, y) without load", least=0)
    friction: Numbers = setting(1.0, "", OURS, "of the capstan coefficient; held where fit.slide_travel is 0", least=0)
    damping_ratio: Numbers = setting(0.7, "", OURS, "of damping over stiffness; held where fit.history is 1", least=0)
    gravity: Numbers = setting(0.0, "m/s^2", OURS, "of gravity in the recording's frame", least=0)
    base_position: Numbers = setting(5e-3, "m", OURS, "of the base in the recording's frame", least=0)
    base_rotation: Numbers = setting(0.1, "rad", OURS, "of the base's rotation vector there", least=0)
    mount: Numbers = setting(3e-3, "m", OURS, "of each body's place (x, y, z) beside its sensor", least=0)


def arm_parameters(arm: Arm, spreads: Spreads) -> Parameters:
    """The blocks of an arm, in the order of `Spreads`.

    Args:
        arm: What is believed before the fit.
        spreads: How far it may be from that.

    Raises:
        ConfigError: A spread has the wrong number of entries.
        ValueRangeError: What is known by its ratio is zero and has a spread.
    """
    routing = arm.routing()
    n_b, n_a = arm.n_sections, arm.n_tendons
    n_inputs, k = max(arm.actuation.driving(n_a)) + 1, len(arm.sensor_places())
    sections = [f"section {s + 1}" for s in range(n_b)]
    tendons = [f"tendon {t + 1}" for t in range(n_a)]
    inputs = [f"input {i + 1}" for i in range(n_inputs)]
    axes = ["x", "y", "z"]
    bends = [f"{section} {axis}" for section in sections for axis in axes[:2]]
    mounts = [f"body {b + 1} {axis}" for b in range(k) for axis in axes]
    EA, EI = _rigidities(arm)
    ratio, difference = True, False
    blocks: dict[str, tuple[str, bool, Sequence[str], Tensor]] = {
        "rest_length": ("m", ratio, sections, arm.rest_lengths()),
        "angle": ("rad", difference, tendons, routing.angles),
        "offset": ("m", ratio, tendons, routing.offsets),
        "input_scale": ("", ratio, inputs, torch.ones(n_inputs, dtype=torch.float64)),
        "pre_stretch": ("m", difference, tendons, spread("pre_stretch", arm.actuation.pre_stretch, n_a)),
        "tendon_stiffness": ("N/m", ratio, tendons, spread("stiffness", arm.actuation.stiffness, n_a)),
        "bending_rigidity": ("N m^2", ratio, sections, EI),
        "axial_rigidity": ("N", ratio, sections, EA),
        "rest_bend": ("rad", difference, bends, table("rest_bend", arm.rest_bend, n_b, 2).flatten()),
        "friction": ("", ratio, ["coefficient"], vector((arm.actuation.friction,))),
        "damping_ratio": ("s", ratio, ["arm"], spread("damping_ratio", arm.damping_ratio, 1)),
        "gravity": ("m/s^2", difference, axes, vector(arm.placement.gravity)),
        "base_position": ("m", difference, axes, vector(arm.placement.position)),
        "base_rotation": ("rad", difference, axes, _rotation_vector(arm)),
        "mount": ("m", difference, mounts, table("mounts", arm.mounts, k, 3).flatten()),
    }
    return Parameters(
        {
            name: Block(nominal, _spread(name, spreads, len(labels)), unit, tuple(labels), logarithmic)
            for name, (unit, logarithmic, labels, nominal) in blocks.items()
        }
    )


def identified_arm(arm: Arm, values: Values) -> Arm:
    """The arm that the fit began with, with the values of its blocks; sensors and racks stay in their sections."""
    n_a, k = arm.n_tendons, len(arm.sensor_places())
    driving = list(arm.actuation.driving(n_a))
    pulls = spread("pulls", arm.actuation.pulls, n_a) * values["input_scale"][driving]
    old, new = arm.rest_lengths(), values["rest_length"]
    changes: dict[str, Any] = {}
    for name in ("sensors", "true_sensors", "racks"):
        place = getattr(arm, name)
        if place is not None:
            X_tilde, j = decouple(vector(place), old)
            changes[name] = (new.cumsum(-1)[j] - (1.0 - X_tilde) * new[j]).tolist()
    return arm.changed(
        lengths=new.tolist(),
        masses=arm.section_masses().tolist(),
        axial_rigidity=values["axial_rigidity"].tolist(),
        bending_rigidity=values["bending_rigidity"].tolist(),
        damping_ratio=float(values["damping_ratio"]),
        rest_bend=_rows(values["rest_bend"], arm.n_sections),
        mounts=_rows(values["mount"], k),
        placement=Placement(
            position=tuple(values["base_position"].tolist()),
            rotation=tuple(values["base_rotation"].tolist()),
            gravity=tuple(values["gravity"].tolist()),
        ),
        tendons=arm.tendons.changed(angles=values["angle"].tolist(), offsets=values["offset"].tolist()),
        actuation=arm.actuation.changed(
            pulls=pulls.tolist(),
            stiffness=values["tendon_stiffness"].tolist(),
            pre_stretch=values["pre_stretch"].tolist(),
            friction=float(values["friction"]),
        ),
        **changes,
    )


def account(parameters: Parameters) -> str:
    """Which keys of an identified arm's file were fitted and which are those of the arm that the fit began with."""
    fitted = [KEYS[name] for name, block in parameters.blocks.items() if bool((block.spread > 0).any())]
    held = [key for key in (*KEYS.values(), "masses") if key not in fitted]
    sentences = f"Identified: {', '.join(fitted)}.", f"Taken over: {', '.join(held)} and all else."
    return "\n".join(textwrap.fill(sentence, 110) for sentence in sentences)


def _spread(name: str, spreads: Spreads, entries: int) -> Tensor:
    return spread(f"spread.{name}", getattr(spreads, name), entries)


def _rigidities(arm: Arm) -> tuple[Tensor, Tensor]:
    """EA, N, and EI, N m^2, of the sections (n_b,): as they are told, else from the sections' stiffness."""
    stiffness = dict(zip(("axial_rigidity", "bending_rigidity"), arm.section_stiffness(), strict=True))
    EA, EI = (
        value * arm.rest_lengths() if getattr(arm, name) is None else spread(name, getattr(arm, name), arm.n_sections)
        for name, value in stiffness.items()
    )
    return EA, EI


def _rotation_vector(arm: Arm) -> Tensor:
    """The base's (3,) in the recording's frame, rad."""
    if arm.placement.rotation is not None:
        return vector(arm.placement.rotation)
    return so3.log(arm.placed_rotation())


def _rows(values: Tensor, rows: int) -> Table | None:
    """A block's values as rows; None where all are zero."""
    entries: list[list[float]] = values.reshape(rows, -1).tolist()
    return entries if bool(values.any()) else None

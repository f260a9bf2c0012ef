"""What `python -m apcc_torch.new_arm` asks of an arm, and the file that it writes of the answers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import pi
from typing import Any, NamedTuple

from apcc_torch.composition.quantity import LENGTH, MASS, PRESSURE, WIDTH, quantity
from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.model.arm import Arm
from apcc_torch.model.arm_scale import length
from apcc_torch.model.material import Rigidity, from_sag, of_section
from apcc_torch.settings import check_choice

SIDE_BY_SIDE = Arm(lengths=(1.0,)).rack_twist
"""How far racks are turned against each other, rad, where there is room for all of them."""

GUESSED_SAG = 1.0 / 3.0
"""How far an arm of which nothing else is known sags held out level, over its length."""

Answers = Mapping[str, str]
"""What was given, by the names of `QUESTIONS`; what was not is left out."""


class Question(NamedTuple):
    """One thing to know of an arm.

    text: What is asked. unit: "" for none. needed: Whether an arm, or the answer to `after`, cannot do without.
    after: The question without an answer to which this one means nothing.
    """

    text: str
    unit: str = ""
    needed: bool = False
    after: str = ""


QUESTIONS = {
    "lengths": Question("rest lengths of the sections, from the base to the tip, as 0.2,0.25", "m", needed=True),
    "offset": Question("distance of the tendons from the backbone", "m", needed=True),
    "mass": Question("mass of the whole arm, or of each section", "kg", needed=True),
    "tendons": Question("tendons that end at each section's tip, evenly spaced; 3 where not told"),
    "layout": Question("coupled: a tendon bends all sections up to its own; independent: its own alone, from a sheath"),
    "sensors": Question(
        "abscissae of the sensors from the base, or how many; one at each section's end where not told"
    ),
    "payload": Question("largest load that the tip is to bear; half the mass where not told", "kg"),
    "young": Question("Young's modulus of the backbone, as 1.2MPa; nothing where a sag is measured or unknown", "Pa"),
    "radius": Question("radius of the backbone, a round rod", "m", needed=True, after="young"),
    "bore": Question("radius of the hole along it; 0 where not told", "m", after="young"),
    "sag": Question("how far the tip hangs below the base where the base is held level; nothing if unknown", "m"),
    "load": Question("load at the tip meanwhile; 0 where not told", "kg", after="sag"),
    "base": Question("hanging or standing; hanging where not told"),
}


@dataclass(frozen=True)
class Described:
    """An arm as it was told.

    Attributes:
        arm: The arm.
        stiffness: Where its rigidities come from.
    """

    arm: Arm
    stiffness: str


def check_answer(name: str, text: str) -> None:
    """Raises ApccError where an answer alone cannot be meant."""
    READ[name](f"--{name}", text)


def described(answers: Answers, name: str) -> Described:
    """The arm that the answers tell.

    Args:
        answers: See `QUESTIONS`.
        name: What it is called.

    Raises:
        ConfigError: One is missing, or means nothing beside the others.
        ValueRangeError: A number is out of range, or reads as one of another unit.
    """
    for key, question in QUESTIONS.items():
        means = not question.after or question.after in answers
        if key in answers and not means:
            raise ConfigError(f"--{key} is read by nothing without --{question.after}")
        if question.needed and means and key not in answers:
            raise ConfigError(f"--{key} must be given: {question.text}")
    if "young" in answers and "sag" in answers:
        raise ConfigError("give --young or --sag, not both: either says how stiff the arm is")
    told = {key: READ[key](f"--{key}", text) for key, text in answers.items()}
    lengths, masses = told["lengths"], told["mass"]
    if len(masses) not in (1, len(lengths)):
        raise ConfigError(f"--mass must be one number, or {len(lengths)}, one a section, got {len(masses)}")
    if told["offset"] > 0.5 * min(lengths):
        raise ValueRangeError(
            f"--offset must be less than half the shortest section, {0.5 * min(lengths):g} m, got {told['offset']:g} m"
        )
    values: dict[str, Any] = {
        "name": name,
        "lengths": lengths,
        "tendon_offset": told["offset"],
        **({"mass": masses[0]} if len(masses) == 1 else {"masses": masses}),
        **{key: told[answer] for answer, key in KEYS.items() if answer in told},
    }
    if len(lengths) * SIDE_BY_SIDE > 2.0 * pi / told.get("tendons", 3) + 1e-9:
        # Evenly, so that none runs through another's hole.
        values["rack_twist"] = 2.0 * pi / (told.get("tendons", 3) * len(lengths))
    if "sensors" in told:
        values["sensors"] = _places(told["sensors"], sum(lengths))
    arm = Arm(**values)
    rigidity, source = _rigidity(arm, told)
    return Described(arm.changed(bending_rigidity=rigidity.bending, axial_rigidity=rigidity.axial), source)


def _rigidity(arm: Arm, told: Mapping[str, Any]) -> tuple[Rigidity, str]:
    """The rigidities, and where they come from."""
    if "young" in told:
        bore = told.get("bore", 0.0)
        of = f"of a rod of {told['young']:g} Pa and {told['radius']:g} m radius"
        return of_section(told["young"], told["radius"], bore), of + (f", bore {bore:g} m" if bore else "")
    if "sag" in told:
        load = told.get("load", 0.0)
        beside = f" with {load:g} kg at its tip" if load else ""
        return from_sag(arm, told["sag"], load), f"of a sag of {told['sag']:g} m{beside}, held out level"
    return from_sag(arm, GUESSED_SAG * length(arm)), "a guess, a sag of a third held out level: --sag or --young tell"


def file_text(given: Described) -> str:
    """The arm's file, a comment beside every key."""
    arm = given.arm
    sheath = "from the rack before its own" if arm.layout == "independent" else "from the base on"
    twisted = "rack_twist" in arm.entries()
    lines: list[tuple[str, Any, str]] = [
        ("name", arm.name, "what tables, figures and folders call it"),
        ("lengths", arm.rest_lengths().tolist(), "m, the sections at rest, from the base to the tip"),
        ("sensors", arm.sensor_places().tolist(), "m, where the sensors sit, along the arm from its base"),
        ("tendon_offset", arm.tendon_offset, "m, from the backbone to each tendon"),
        ("tendons_per_rack", arm.tendons_per_rack, "that end at each section's tip, evenly spaced around the backbone"),
        *([("rack_twist", arm.rack_twist, "rad, of each section's tendons against those before")] if twisted else []),
        ("layout", arm.layout, f"a tendon acts {sheath}"),
        ("base", arm.base, "how the arm is mounted; z points up"),
    ]
    if arm.masses is None:
        lines.append(("mass", arm.mass, "kg, of the whole arm, spread by length"))
    else:
        lines.append(("masses", list(arm.masses), "kg, of each section"))
    lines += [
        ("payload", _payload(arm), "kg, the most that the tip is to bear; presets load the arm up to it"),
        ("bending_rigidity", arm.bending_rigidity, f"N m^2, EI, {given.stiffness}"),
        ("axial_rigidity", arm.axial_rigidity, "N, EA, likewise"),
    ]
    entries = [(f"{key}: {_shown(value)}", comment) for key, value, comment in lines]
    width = max(len(entry) for entry, _ in entries) + 3
    head = (
        "# An arm, written by python -m apcc_torch.new_arm: change what you know better. What is not here has its\n"
        "# default; python -m apcc_torch.simulate experiment=kinematic --help lists every key, arm's among them.\n"
    )
    return head + "".join(f"{entry:<{width}}# {comment}\n" for entry, comment in entries)


def _payload(arm: Arm) -> Any:
    return 0.5 * float(arm.section_masses().sum()) if arm.payload is None else arm.payload


def _shown(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_shown, value))}]"
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def _places(told: Sequence[float] | int, total: float) -> list[float]:
    """Abscissae; of so many sensors the ends of as many equal shares of the arm."""
    if isinstance(told, int):
        return [float(f"{total * (k + 1) / told:.6g}") for k in range(told)]
    return list(told)


def _lengths(name: str, text: str) -> list[float]:
    return [quantity(name, each, LENGTH) for each in _split(name, text)]


def _masses(name: str, text: str) -> list[float]:
    return [quantity(name, each, MASS) for each in _split(name, text)]


def _split(name: str, text: str) -> list[str]:
    parts = [part for part in text.strip().strip("[]").replace(",", " ").split() if part]
    if not parts:
        raise ConfigError(f"{name} must be numbers with commas between them, got {text!r}")
    return parts


def _sensors(name: str, text: str) -> list[float] | int:
    return int(text) if text.strip().isdigit() and 0 < int(text) <= 100 else _lengths(name, text)


def _count(name: str, text: str) -> int:
    if not text.strip().isdigit() or not 1 <= int(text) <= 100:
        raise ConfigError(f"{name} must be a whole number from 1 to 100, got {text!r}")
    return int(text)


def _choice(*choices: str) -> Callable[[str, str], str]:
    return lambda name, text: check_choice(name, text.strip(), choices)


READ: dict[str, Callable[[str, str], Any]] = {
    "lengths": _lengths,
    "offset": lambda name, text: quantity(name, text, WIDTH),
    "mass": _masses,
    "tendons": _count,
    "layout": _choice("coupled", "independent"),
    "sensors": _sensors,
    "payload": lambda name, text: quantity(name, text, MASS, zero=True),
    "young": lambda name, text: quantity(name, text, PRESSURE),
    "radius": lambda name, text: quantity(name, text, WIDTH),
    "bore": lambda name, text: quantity(name, text, WIDTH, zero=True),
    "sag": lambda name, text: quantity(name, text, LENGTH),
    "load": lambda name, text: quantity(name, text, MASS, zero=True),
    "base": _choice("hanging", "standing"),
}
"""How each answer is read."""

KEYS = {"tendons": "tendons_per_rack", "layout": "layout", "payload": "payload", "base": "base"}
"""An answer that is a key of the file as it is."""

"""python -m apcc_torch.new_arm: an arm's file from what a ruler and a scale tell, with a picture to check it."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from apcc_torch.composition.arguments import Arguments
from apcc_torch.composition.new_arm import QUESTIONS, check_answer, described, file_text
from apcc_torch.errors import ApccError, ConfigError, one_sentence
from apcc_torch.files import write_atomically
from apcc_torch.model.arm import Arm
from apcc_torch.model.arm_scale import length
from apcc_torch.model.material import sag
from apcc_torch.plain_text import for_terminal
from apcc_torch.report.arm_drawing import arm_figure
from apcc_torch.report.style import save_figures

SUFFIX, OVERWRITE = ".yaml", "overwrite=true"
MANUAL = """\
FILE.yaml is the arm as every command takes it, arm=FILE.yaml; FILE.png shows it, to check it by eye. What a command
line leaves out is asked, where there is a terminal; lengths, offset and mass are needed. Numbers are in SI units, or
have their unit behind them: 200mm, 30g, 1.2MPa.

The stiffness comes from one of
  --young --radius   the backbone's material and section
  --sag              how far the tip hangs below the base where that is held level, perhaps with --load at the tip
or is guessed: that the tip hangs lower by a third of the length. What simulated motors and presets assume of an arm
(gains of the tendon loop, targets, payloads, bounds) goes in proportion with this one.

examples:
  python -m apcc_torch.new_arm mine --lengths 0.2,0.25 --offset 0.015 --mass 0.4
  python -m apcc_torch.new_arm snake --lengths 0.1,0.12,0.12,0.13,0.13 --offset 20mm --mass 0.8 --sensors 4
  python -m apcc_torch.new_arm finger --lengths 60mm,60mm --offset 6mm --mass 30g --young 0.3MPa --radius 7mm
  python -m apcc_torch.new_arm mine --lengths 0.2,0.25 --offset 0.015 --mass 0.4 --sag 0.12 --load 50g overwrite=true
"""


def arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    """The command line; `overwrite=true` is taken as the other commands take it."""
    about = "Writes the file of an arm of yours, draws it, and says what to run next."
    parser = Arguments.described("new_arm", about, MANUAL)
    parser.add_argument("file", metavar="FILE", help="where to, FILE.yaml; its last part is the arm's name")
    for name, question in QUESTIONS.items():
        unit = f" [{question.unit}]" if question.unit else ""
        parser.add_argument(f"--{name}", metavar="VALUE", help=f"{question.text}{unit}")
    words = sys.argv[1:] if argv is None else list(argv)
    given = parser.parse_args([word for word in words if word != OVERWRITE])
    given.overwrite = OVERWRITE in words
    return given


def asked(answers: dict[str, str]) -> dict[str, str]:
    """The answers with those that a person gives on the terminal; an empty one leaves the question open."""
    sys.stdout.write("Enter leaves open what is not needed; 200mm or 30g do as well as 0.2 or 0.03.\n")
    for name, question in QUESTIONS.items():
        if name in answers or (question.after and question.after not in answers):
            continue
        if name == "sag" and "young" in answers:
            continue
        unit = f" [{question.unit}]" if question.unit else ""
        while True:
            said = input(f"{question.text}{unit}: ").strip()
            if not said and not question.needed:
                break
            try:
                check_answer(name, said)
            except ApccError as error:
                sys.stdout.write(for_terminal(f"  {error}\n"))
                continue
            answers[name] = said
            break
    return answers


def paths(given: argparse.Namespace) -> tuple[Path, Path]:
    """The file and its picture, which may be written.

    Raises:
        ConfigError: One of them is there, and is not to be written over.
    """
    file = Path(given.file)
    file = file if file.suffix in (SUFFIX, ".yml") else file.with_name(file.name + SUFFIX)
    picture = file.with_suffix(".png")
    there = [path for path in (file, picture) if os.path.lexists(path)]
    if there and not given.overwrite:
        raise ConfigError(f"{there[0]} is there already: name another file, or overwrite=true writes over it")
    return file, picture


def next_commands(file: Path, arm: Arm) -> list[str]:
    """What to run with the arm's file."""
    word = shlex.quote(f"arm={file}")
    return [
        f"python -m apcc_torch.simulate experiment=kinematic {word}",
        f"python -m apcc_torch.simulate experiment=dynamic_run_2_tuned compile=auto {word}",
        f"python -m apcc_torch.robot experiment=setpoint hardware=lockstep view=false {word}",
    ]


def check_by_eye(arm: Arm) -> str:
    """How far it sags, which a person can check on the arm."""
    payload = arm.payload if arm.payload is not None else 0.5 * float(arm.section_masses().sum())
    bare, loaded = sag(arm), sag(arm, float(payload))
    told = [
        f"{1e3 * found.depth:.0f} mm {what}"
        for found, what in ((bare, "by itself"), (loaded, "with its payload"))
        if found is not None and found.depth < length(arm)
    ]
    if not told:
        return "Held out level it would hang straight down: check that, and the picture."
    return f"Held out level its tip would hang {' and '.join(told)} below its base: check that, and the picture."


def write(given: argparse.Namespace) -> str:
    """Writes the file and the picture; returns what to say.

    Raises:
        ApccError: An answer has no meaning, or a file is there already.
    """
    file, picture = paths(given)
    answers = {name: value for name in QUESTIONS if (value := getattr(given, name)) is not None}
    for name, value in answers.items():
        check_answer(name, value)
    if sys.stdin.isatty() and any(q.needed and not q.after and n not in answers for n, q in QUESTIONS.items()):
        answers = asked(answers)
    told = described(answers, file.stem)
    text = file_text(told)
    write_atomically(file, text)
    save_figures({picture.name: lambda: arm_figure(told.arm)}, picture.parent)
    commands = "\n".join(f"  {command}" for command in next_commands(file, told.arm))
    return f"{file}:\n{text}\n{picture} shows it. {check_by_eye(told.arm)}\n\nNext:\n{commands}\n"


def main(argv: Sequence[str] | None = None) -> None:
    """Console entry point."""
    given = arguments(argv)
    with one_sentence(lambda said: sys.stderr.write(f"apcc_torch.new_arm: {said}\n")):
        said = write(given)
    sys.stdout.write(for_terminal(said))


if __name__ == "__main__":
    main()

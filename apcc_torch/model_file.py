"""python -m apcc_torch.model_file: an arm as a model of MuJoCo or as a URDF, for worlds that others have built."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from apcc_torch.composition.arguments import Arguments
from apcc_torch.errors import ConfigError, one_sentence
from apcc_torch.files import write_atomically
from apcc_torch.model.arm import Arm
from apcc_torch.model.link_chain import ChainSettings, LinkChain
from apcc_torch.model.mjcf import mjcf_text
from apcc_torch.model.urdf_file import urdf_text
from apcc_torch.plain_text import for_terminal

FORMATS: dict[str, Callable[[LinkChain], str]] = {".xml": mjcf_text, ".urdf": urdf_text}
"""What a file's name ends with -> what writes it."""
OVERWRITE = "overwrite=true"
ELEMENTS = ChainSettings().elements
MANUAL = """\
ARM is an arm's name or file. FILE.xml becomes MJCF, the format of MuJoCo, with stiffness, damping, tendons and their
motors, and sensors. FILE.urdf becomes a URDF: links, masses, joints with limits and damping; the format has no springs
and no tendons.

Sections are divided into elements, each with a joint that bends and two that stretch. More of them follow the arm more
closely and cost more; docs/model_files.md says how closely.

examples:
  python -m apcc_torch.model_file arm_1 arm_1.xml
  python -m apcc_torch.model_file mine.yaml mine.urdf --elements 4 overwrite=true
"""


def arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    """The command line; `overwrite=true` is taken as the other commands take it."""
    parser = Arguments.described("model_file", "Writes an arm as a file for rigid-body simulators.", MANUAL)
    parser.add_argument("arm", metavar="ARM", help="an arm's name or file")
    parser.add_argument("file", metavar="FILE", type=Path, help=f"where to; it ends with {' or '.join(FORMATS)}")
    parser.add_argument(
        "--elements", type=int, default=ELEMENTS, help=f"into how many a section is divided; {ELEMENTS} if not given"
    )
    words = sys.argv[1:] if argv is None else list(argv)
    given = parser.parse_args([word for word in words if word != OVERWRITE])
    given.overwrite = OVERWRITE in words
    return given


def write(given: argparse.Namespace) -> str:
    """Writes the file; returns what to say of it.

    Raises:
        ConfigError: The file's name tells no format, or it is there and is not to be written over.
    """
    path: Path = given.file
    if path.suffix not in FORMATS:
        raise ConfigError(f"{path} must end with {' or '.join(FORMATS)}, which says its format")
    if os.path.lexists(path) and not given.overwrite:
        raise ConfigError(f"{path} is there already: name another file, or overwrite=true writes over it")
    chain = LinkChain(Arm.load(given.arm), ChainSettings(elements=given.elements))
    write_atomically(path, FORMATS[path.suffix](chain))
    mass = sum(link.mass for link in chain.links)
    return f"{path}: {len(chain.links)} links of {mass:.4g} kg, {chain.routing.n_tendons} tendons"


def main(argv: Sequence[str] | None = None) -> None:
    """Console entry point."""
    given = arguments(argv)
    with one_sentence(lambda said: sys.stderr.write(f"apcc_torch.model_file: {said}\n")):
        sys.stdout.write(for_terminal(f"{write(given)}\n"))


if __name__ == "__main__":
    main()

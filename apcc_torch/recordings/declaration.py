"""What is said of a recording that its file does not say: names, units, frame, clock, and the file's own form."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from apcc_torch.errors import ConfigError
from apcc_torch.model.table import Table
from apcc_torch.settings import OURS, Settings, setting

METRES = {"m": 1.0, "dm": 0.1, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254, "inch": 0.0254, "ft": 0.3048}
"""Name of a unit of length -> m."""
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0}
"""Name of a unit of time -> s."""
FRAMES = "frames"
"""What a column holds that counts frames at `rate`."""
LAYOUTS = ("auto", "table", "trunk", "motive", "qualisys", "bag")
AXES = ("x", "y", "z", "-x", "-y", "-z")
ORDERS = ("xyzw", "wxyz")
EULER = tuple(
    f"{a}{b}{c}" for a in "xyz" for b in "xyz" for c in "xyz" if a != b != c
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class RecordingSettings(Settings):
    """How a recording is read. What is null is told by the file: by its columns' names, its header, its first lines."""

    inputs: tuple[str, ...] = setting(
        (),
        "",
        OURS,
        "columns or topics of what drives the arm, in any unit; * stands for anything; empty: by their names",
    )
    bodies: tuple[tuple[str, ...] | str, ...] = setting(
        (), "", OURS, "names or topics, from the base to the tip, or columns x, y, z of each; empty: all that are there"
    )
    position: str = setting(
        "", "", OURS, "columns of a body's position, as rb_{body}_{axis}; empty: told by the columns' names"
    )
    quaternion: str = setting("", "", OURS, "columns of its quaternion, as rb_{body}_q{axis}; empty: as position")
    quaternion_order: str | None = setting(
        None, "", OURS, "of its four columns as they stand in the file; null: by their names", choices=ORDERS
    )
    euler: str = setting(
        "", "", OURS, "columns of its three angles, as rb_{body}_r{axis}, where there is no quaternion"
    )
    euler_order: str = setting("xyz", "", OURS, "of the turns about its own axes, one after the other", choices=EULER)
    angle: str = setting("deg", "", OURS, "unit of the angles", choices=("deg", "rad"))
    unit: float | str | None = setting(
        None,
        "",
        OURS,
        f"of positions: {', '.join(METRES)}, or a number of metres; null: as the file says, else m",
        above=0,
    )
    offsets: Table | None = setting(
        None, "m", OURS, "(x, y, z) in each body's own axes from its origin to the point that is meant; null: none"
    )
    up: str | None = setting(
        None, "", OURS, "the file's axis that points up, turned to z; null: the frame stays as it is", choices=AXES
    )
    hand: str = setting("right", "", OURS, "of the file's axes", choices=("right", "left"))
    time: str | None = setting(None, "", OURS, "column of the time; null: by its name, else frames come at `rate`")
    time_unit: str | None = setting(
        None, "", OURS, "of the time; null: by the column's name, else s", choices=(*SECONDS, FRAMES)
    )
    rate: float = setting(100.0, "Hz", OURS, "frames a second, where the recording does not say", above=0, most=1e9)
    group: str | None = setting(None, "", OURS, "column of words that tells movements apart; null: there is none")
    group_ending: str = setting("", "", OURS, "what may end such a word without changing its meaning")
    layout: str = setting("auto", "", OURS, "of the file; auto: told by its name and first lines", choices=LAYOUTS)
    delimiter: str | None = setting(
        None, "", OURS, "between cells: a character, tab or blank; null: the one in the header"
    )
    decimal: str | None = setting(None, "", OURS, "mark in numbers; null: as the cells show", choices=(".", ","))
    comment: str = setting("#", "", OURS, "what begins a line that is none of the table's; empty: nothing does")

    def check(self) -> None:
        """Raises ConfigError where a body has not three columns, or a word has no meaning."""
        for columns in self.bodies:
            if not isinstance(columns, str) and (not isinstance(columns, list | tuple) or len(columns) != 3):
                raise ConfigError(f"bodies must be names, or three columns a body, got {columns!r}")
        if len({isinstance(columns, str) for columns in self.bodies}) > 1:
            raise ConfigError("bodies must all be names, or all be three columns each")
        if isinstance(self.unit, str) and self.unit not in METRES:
            raise ConfigError(f"unit must be one of {', '.join(METRES)}, or a number of metres, got {self.unit!r}")
        if self.delimiter is not None and len(self.delimiter) != 1 and self.delimiter not in ("tab", "blank"):
            raise ConfigError(f"delimiter must be a character, tab or blank, got {self.delimiter!r}")
        for name in ("position", "quaternion", "euler"):
            if getattr(self, name):
                columns_of(name, getattr(self, name), "body", "xyz")
        if self.quaternion and self.euler:
            raise ConfigError("euler must be empty where quaternion names the columns of orientations")

    @property
    def named(self) -> tuple[str, ...]:
        """The bodies' names, where they are named."""
        return tuple(columns for columns in self.bodies if isinstance(columns, str))

    @property
    def listed(self) -> tuple[Sequence[str], ...]:
        """The bodies' columns, where those are listed."""
        return tuple(columns for columns in self.bodies if not isinstance(columns, str))


def columns_of(key: str, pattern: str, body: str, axes: Sequence[str]) -> tuple[str, ...]:
    """The columns that a pattern means: {axis} stands for the axis, or the last x of a pattern without it does.

    Raises:
        ConfigError: It says neither where the axis stands.
    """
    if "{axis}" not in pattern:
        bare, found = re.subn(r"[xX](?=[^a-zA-Z]*$)", "{axis}", pattern.replace("{body}", "\0"), count=1)
        if not found:
            raise ConfigError(f"{key} must say where the axis stands, as rb_{{body}}_{{axis}}, got {pattern!r}")
        pattern = bare.replace("\0", "{body}")
    return tuple(pattern.replace("{body}", body).replace("{axis}", axis) for axis in axes)

"""Models of the arm with two, three and four sections: their rest lengths, m, as numbers and as overrides."""

from __future__ import annotations

from collections.abc import Sequence

SECTIONS = {2: (0.36, 0.24), 3: (0.105, 0.255, 0.24), 4: (0.105, 0.1275, 0.1275, 0.24)}


def listed(lengths: Sequence[float]) -> str:
    """Lengths as an override has a list: "[0.3600,0.2400]"."""
    return "[" + ",".join(f"{length:.4f}" for length in lengths) + "]"


def with_sections(lengths: Sequence[float]) -> tuple[str, ...]:
    """Overrides for a model of sections of these lengths: racks, sensors and the true arm stay those of arm 1."""
    ends = "[0.105,0.36,0.6]"
    own = (f"arm.racks={ends}", f"arm.sensors={ends}", f"plant.arm.lengths={listed(SECTIONS[3])}")
    return f"arm.lengths={listed(lengths)}", *own

"""Models of the arm with two, three and four sections: their rest lengths, m, as numbers and as overrides."""

from __future__ import annotations

from collections.abc import Sequence

SECTIONS = {2: (0.36, 0.24), 3: (0.105, 0.255, 0.24), 4: (0.105, 0.1275, 0.1275, 0.24)}


def listed(lengths: Sequence[float], factor: float = 1.0) -> str:
    """Lengths times a factor, as an override has a list: "[0.3600,0.2400]"."""
    return "[" + ",".join(f"{factor * length:.4f}" for length in lengths) + "]"

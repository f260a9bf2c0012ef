"""A setting that names one of a few: what it may be, and what is said of anything else."""

from __future__ import annotations

import pytest

from apcc_torch.composition.choice import choice
from apcc_torch.errors import ConfigError


def test_choice_lists_the_options() -> None:
    assert choice("state", "exact", ("exact", "feedback")) == "exact"
    with pytest.raises(ConfigError, match="state must be one of exact, feedback, got 'both'"):
        choice("state", "both", ("exact", "feedback"))

"""Splits never overlap and lose nothing."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from apcc_torch.errors import ConfigError, DataError
from apcc_torch.identification.split import split, thinned


@given(st.lists(st.integers(0, 9), min_size=20, max_size=200), st.integers(2, 5), st.data())
def test_parts_are_disjoint_and_whole(numbers: list[int], folds: int, data: st.DataObject) -> None:
    groups = torch.tensor([*range(10), *numbers])
    for by in ("groups", "blocks"):
        fold = data.draw(st.integers(0, folds - 1))
        parts = split(groups, by, folds, fold)
        together = torch.cat(parts)
        assert together.sort().values.tolist() == list(range(len(groups)))
        assert not set(parts.training.tolist()) & set(parts.validation.tolist())
        if by == "groups":
            assert not set(groups[parts.training].tolist()) & set(groups[parts.validation].tolist())
        else:
            assert bool((parts.validation.diff() == 1).all())


@given(st.integers(1, 300), st.integers(1, 300))
def test_thinning_keeps_order_and_number(size: int, count: int) -> None:
    kept = thinned(torch.arange(size), count)
    assert len(kept) == min(size, count)
    assert bool((kept.diff() > 0).all())


def test_bad_splits_are_refused() -> None:
    groups = torch.zeros(10, dtype=torch.int64)
    with pytest.raises(ConfigError, match="by must be one of groups, blocks"):
        split(groups, "chance", 5, 0)
    with pytest.raises(ConfigError, match="fold must be from 0 to folds - 1"):
        split(groups, "blocks", 5, 5)
    with pytest.raises(DataError, match="too few movements"):
        split(groups, "groups", 5, 0)

"""Blocks of parameters and their standard scores."""

from __future__ import annotations

import pytest
import torch

from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.identification.parameters import Block, Parameters
from identified_arms import parameters


def test_scores_move_fitted_parameters_by_their_spread_and_no_others() -> None:
    blocks = parameters(offset=0.1, base_position=2e-3)
    assert len(blocks) == 9
    assert blocks.names[0] == "offset: tendon 1" and blocks.names[-1] == "base_position: z"
    values = blocks.values(torch.ones(9, dtype=torch.float64))
    torch.testing.assert_close(values["offset"], 0.005 * torch.full((6,), 0.1).double().exp())
    torch.testing.assert_close(values["base_position"], torch.full((3,), 2e-3).double())
    assert torch.equal(values["rest_length"], blocks.blocks["rest_length"].nominal)
    held = blocks.holding(["offset"])
    assert len(held) == 6
    with pytest.raises(ConfigError, match="no block 'colour'"):
        blocks.holding(["colour"])


@pytest.mark.parametrize(
    ("block", "error", "words"),
    [
        (
            Block(torch.ones(2).double(), torch.ones(1).double(), "m", ("a", "b")),
            ConfigError,
            "2 values, but 1 spreads",
        ),
        (Block(torch.ones(1).double(), -torch.ones(1).double(), "m", ("a",)), ValueRangeError, "must not be negative"),
        (
            Block(-torch.ones(1).double(), torch.ones(1).double(), "m", ("a",), True),
            ValueRangeError,
            "must be positive",
        ),
    ],
)
def test_blocks_that_cannot_be_are_refused(block: Block, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        Parameters({"length": block})

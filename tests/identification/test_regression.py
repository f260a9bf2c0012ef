"""The baselines that know nothing of arms."""

from __future__ import annotations

import torch

from apcc_torch.identification.regression import linear_prediction, mean_prediction


def test_linear_regression_finds_a_linear_law_and_the_mean_its_mean() -> None:
    generator = torch.Generator().manual_seed(0)
    inputs, law = (torch.randn(*shape, generator=generator, dtype=torch.float64) for shape in ((30, 4), (4, 6)))
    positions = (inputs @ law + 2.0).unflatten(-1, (2, 3))
    predicted = linear_prediction(inputs[:20], positions[:20], inputs)
    torch.testing.assert_close(predicted, positions)
    torch.testing.assert_close(mean_prediction(positions, 5)[4], positions.mean(0))


def test_inputs_that_say_the_same_thing_twice_do_no_harm() -> None:
    inputs = torch.arange(10, dtype=torch.float64).unsqueeze(-1).expand(10, 3)
    positions = inputs.unsqueeze(1)
    torch.testing.assert_close(linear_prediction(inputs, positions, inputs), positions)

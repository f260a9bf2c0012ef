"""Coordinates of configurations: where elongations, angles and driven entries are."""

from __future__ import annotations

import torch

from apcc_torch.model.coordinates import BEND_X, BEND_Y, CONSTANT_CURVATURE, ELONGATION, Coordinate, Coordinates

TORSION = Coordinate("torsion", "rad", driven=False)
REPEATED = Coordinates((BEND_X, TORSION, ELONGATION))
WHOLE = Coordinates((BEND_X, BEND_Y, ELONGATION, TORSION, ELONGATION))
Q = torch.arange(1.0, 7.0).double()


def test_elongations_and_bends() -> None:
    assert Q[CONSTANT_CURVATURE.elongations].tolist() == [3, 6] == Q[REPEATED.elongations].tolist()
    assert Q[:5][WHOLE.elongations].tolist() == [3, 5]
    assert CONSTANT_CURVATURE.bends(Q).tolist() == [[1, 2], [4, 5]]
    assert REPEATED.bends(Q).tolist() == [[1, 0], [4, 0]]
    assert WHOLE.bends(Q[:5]).tolist() == [[1, 2], [0, 0]]
    assert REPEATED.on_elongations(Q[:2]).tolist() == [0, 0, 1, 0, 0, 2]
    assert WHOLE.on_elongations(Q[:2]).tolist() == [0, 0, 1, 0, 2]
    assert WHOLE.on_elongations(Q[:4].view(2, 2)).tolist() == [[0, 0, 1, 0, 2], [0, 0, 3, 0, 4]]
    assert CONSTANT_CURVATURE.on_bends(Q[:2]).tolist() == [1, 1, 0, 2, 2, 0]
    assert REPEATED.on_bends(Q[:2]).tolist() == [1, 0, 0, 2, 0, 0]
    assert WHOLE.on_bends(Q[:4].view(2, 2)).tolist() == [[1, 1, 0, 0, 0], [3, 3, 0, 0, 0]]


def test_only_driven_columns_stay() -> None:
    J = Q.expand(3, 6)
    assert CONSTANT_CURVATURE.driven(J) is J
    assert REPEATED.driven(J)[0].tolist() == [1, 0, 3, 4, 0, 6]
    assert WHOLE.driven(J[:, :5])[0].tolist() == [1, 2, 3, 0, 5]


def test_values_per_unit() -> None:
    assert REPEATED.per_unit(1.0, 2.0, 6, Q).tolist() == [1, 1, 2, 1, 1, 2]
    assert WHOLE.per_unit(1.0, 2.0, 5, Q).tolist() == [1, 1, 2, 1, 2]
    rows = REPEATED.per_unit(torch.tensor([1.0, 3.0]), 2.0, 6, Q)
    assert rows.tolist() == [[1, 1, 2, 1, 1, 2], [3, 3, 2, 3, 3, 2]] and rows.dtype == torch.float64


def test_places_in_the_pattern_and_names() -> None:
    pattern = torch.arange(3)
    assert pattern[CONSTANT_CURVATURE.angular].tolist() == [0, 1] and pattern[CONSTANT_CURVATURE.linear].tolist() == [2]
    assert torch.arange(5)[WHOLE.angular].tolist() == [0, 1, 3] and torch.arange(5)[WHOLE.linear].tolist() == [2, 4]
    assert WHOLE.names(5) == ["bend x 1", "bend y 1", "elongation 1", "torsion 2", "elongation 2"]

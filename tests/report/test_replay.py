"""The replay figure holds the curves, hides residuals of held-back measurements, and places gates in time."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from apcc_torch.errors import ShapeError
from apcc_torch.estimation.sensor_gate import Reason
from apcc_torch.report.replay import REASON_COLORS, ReplayCurves, replay_figure, spans
from apcc_torch.report.style import save_figure


@pytest.fixture
def curves() -> ReplayCurves:
    g = torch.Generator().manual_seed(0)
    time = torch.linspace(0.0, 5.0, 51, dtype=torch.float64)
    reason = torch.zeros(51, 2, dtype=torch.int64)
    reason[10:20, 1] = Reason.JUMP
    reason[30, 0] = Reason.UNTRACKED
    q = torch.randn(51, 6, generator=g, dtype=torch.float64)
    error = torch.rand(51, 2, generator=g, dtype=torch.float64)
    return ReplayCurves(time, q, error, 0.1 * error, torch.zeros_like(reason), reason)


def test_configuration_is_drawn_as_given(curves: ReplayCurves) -> None:
    bends, lengths = replay_figure(curves).axes[:2]
    q = curves.q_bar.numpy()
    for i in range(2):
        assert bends.lines[2 * i].get_ydata() == pytest.approx(q[:, 3 * i])
        assert bends.lines[2 * i + 1].get_ydata() == pytest.approx(q[:, 3 * i + 1])
        assert lengths.lines[i].get_ydata() == pytest.approx(1e2 * q[:, 3 * i + 2])


def test_residuals_are_hidden_where_held_back(curves: ReplayCurves) -> None:
    linear, angular = replay_figure(curves).axes[2:4]
    assert linear.lines[0].get_ydata() == pytest.approx(1e3 * curves.linear[:, 0].numpy())
    (shown,) = [np.asarray(line.get_ydata()) for line in angular.lines if line.get_label() == "sensor 2"]
    held = curves.orientation_reason[:, 1].numpy() != 0
    assert (np.isnan(shown) == held).all()
    assert shown[~held] == pytest.approx(1e2 * curves.angular[:, 1].numpy()[~held])
    ticks = [line for line in angular.lines if line.get_marker() == "|"]
    assert sorted(len(line.get_xdata()) for line in ticks) == [1, 10]
    assert {line.get_color() for line in ticks} == {REASON_COLORS[Reason.JUMP], REASON_COLORS[Reason.UNTRACKED]}


def test_timeline_names_only_what_happened(curves: ReplayCurves) -> None:
    gates = replay_figure(curves, names=["disk 1", "disk 2"]).axes[4]
    texts = [text.get_text() for text in gates.figure.legends[0].get_texts()]
    assert texts == ["untracked", "jump"]
    labels = [label.get_text() for label in gates.get_yticklabels()]
    assert labels == ["disk 1, position", "disk 1, rotation", "disk 2, position", "disk 2, rotation"]
    (jump,) = [c for c in gates.collections if len(c.get_paths()) == 1 and c.get_paths()[0].vertices[0, 0] < 2.0]
    assert jump.get_paths()[0].get_extents().bounds == pytest.approx((1.0, 2.64, 1.0, 0.72))


def test_every_reason_has_a_colour_of_its_own() -> None:
    assert set(REASON_COLORS) == set(Reason) - {Reason.OK}
    assert len(set(REASON_COLORS.values())) == len(REASON_COLORS)


@given(held=st.lists(st.booleans(), min_size=2, max_size=30))
def test_spans_cover_exactly_what_is_held(held: list[bool]) -> None:
    time = np.arange(len(held), dtype=float)
    found = spans(time, np.array(held))
    covered = {t for start, length in found for t in range(int(start), int(start + length))}
    assert covered == {k for k, h in enumerate(held) if h}
    assert all(a[0] + a[1] < b[0] for a, b in pairwise(found))


def test_drawn_and_checked(curves: ReplayCurves, tmp_path: Path) -> None:
    assert save_figure(replay_figure(curves, title="a recording"), tmp_path / "a.png", dpi=30).is_file()
    with pytest.raises(ShapeError, match="position_reason must have shape"):
        replay_figure(curves._replace(position_reason=torch.zeros(3, 2, dtype=torch.int64)))
    with pytest.raises(ShapeError, match="names must have 2 entries"):
        replay_figure(curves, names=["one"])

"""The trade-off figure holds what it was given."""

from __future__ import annotations

import numpy as np

from apcc_torch.report.trade_off import TradeOff, trade_off_figure


def test_every_run_has_its_front_its_limit_and_its_controllers() -> None:
    fronts = {"standard": [(2.0, 20.0), (2.5, 3.0), (3.9, 2.1)], "adaptive": [(1.9, 2.2), (2.0, 2.1)]}
    run = TradeOff(fronts, 1.8, {"standard": (4.2, 2.9), "adaptive": (2.9, 2.4)})
    figure = trade_off_figure({"run 1": run, "run 2": run._replace(fronts={"standard": [(3.0, 2.1), (3.9, 2.0)]})})
    first, second = figure.axes
    lines = {line.get_label(): line.get_xydata() for line in first.get_lines()}
    np.testing.assert_allclose(lines["any rest lengths, standard motion"], [(20.0, 2.0), (3.0, 2.5), (2.1, 3.9)])
    np.testing.assert_allclose(lines["any rest lengths, adaptive motion"], [(2.2, 1.9), (2.1, 2.0)])
    np.testing.assert_allclose(lines["adaptive"], [(2.4, 2.9)])
    assert first.get_xscale() == "log" and second.get_xscale() == "linear"
    assert first.get_ylim()[0] == 0.0
    assert [ax.get_title(loc="left") for ax in figure.axes] == ["run 1", "run 2"]

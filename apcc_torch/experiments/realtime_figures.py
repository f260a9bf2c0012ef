"""The figures of a run on an arm, of the decisions that its summary keeps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from apcc_torch.composition.build_realtime import RealtimeBuilder
from apcc_torch.control.controller import APCCController
from apcc_torch.control.inverse_kinematics import elongation_cost
from apcc_torch.hardware.summary import Summary
from apcc_torch.report.backbone_drawing import Snapshots, marker_positions
from apcc_torch.report.dynamic import RunCurves
from apcc_torch.report.run_figures import draw_run, in_sections, run_figures
from apcc_torch.simulation.divergence import sentence
from apcc_torch.simulation.metrics import backbone_error, mapping_error

POINTS = 80


def draw(build: RealtimeBuilder, controller: APCCController, summary: Summary, causes: Tensor, folder: Path) -> None:
    """Writes the figures of a run into a folder; with shape error, shapes and film where the arm is a simulated one.

    Args:
        build: Of the run's settings.
        controller: That it ran.
        summary: With at least one decision.
        causes: (T, 1) by which it has diverged until each decision.
        folder: Where to.
    """
    names = ("time", "x_d", "e", "q_bar", "q_d", "pi_hat", "angular_error", "linear_error")
    stacked = (np.array([getattr(each, name) for each in summary.decisions]) for name in names)
    time, x_d, e, q_bar, q_d, pi_hat, angular, linear = (torch.from_numpy(each).double() for each in stacked)
    model = controller.backbone.double()
    truths = [q for q in summary.truths if q is not None]
    shape, shots, true_sections = torch.full_like(time, torch.nan), None, None
    if len(truths) == len(summary.decisions):
        plant = build.model.plant(build.payload())
        true, lengths = plant.backbone, plant.dynamics.lengths.double()
        q = torch.from_numpy(np.array(truths)).double()
        shape = backbone_error(true, q, lengths, model, q_bar, pi_hat)
        true_sections = in_sections(lengths, model.n_sections)
        places = controller.feedback.abscissae.double()
        shots = Snapshots(
            time,
            true.points(q, lengths, POINTS),
            model.points(q_bar, pi_hat, POINTS),
            marker_positions(true, q, lengths, places),
            marker_positions(model, q_bar, pi_hat, places),
            x_d,
        )
    curves = RunCurves(
        time,
        shape.unsqueeze(1),
        elongation_cost(q_bar, coordinates=model.coordinates).unsqueeze(1),
        angular.unsqueeze(1),
        linear.unsqueeze(1),
        e.norm(dim=-1, keepdim=True),
        pi_hat.unsqueeze(1),
        mapping_error(model, q_d, pi_hat, x_d - e).unsqueeze(1),
        causes,
    )
    settings = build.settings
    name = "adaptive" if settings.controller.adaptive else "standard"
    drawings = run_figures(name, curves, shots, true_sections, f"{settings.experiment.name}, {settings.arm.name}")
    draw_run(folder, drawings, curves, shots, sentence(time, causes))

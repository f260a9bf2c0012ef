"""Identification of an arm from a recording: settings to a folder with parameters, their intervals and a comparison."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.composition.identify import IdentifySettings, parameters, recorded
from apcc_torch.errors import DataError
from apcc_torch.experiments.folder import RunFolder
from apcc_torch.experiments.identification_report import report_text, why_not
from apcc_torch.files import write_atomically, write_json
from apcc_torch.identification.arm_blocks import account, identified_arm
from apcc_torch.identification.fit import Fit, FitSettings, fit
from apcc_torch.identification.intervals import (
    Interval,
    coverage,
    disagreement,
    half_widths,
    intervals,
    unknown_directions,
)
from apcc_torch.identification.online import adapt
from apcc_torch.identification.parameters import Parameters
from apcc_torch.identification.regression import linear_prediction, mean_prediction
from apcc_torch.identification.series import Series
from apcc_torch.identification.split import Split, thinned
from apcc_torch.identification.tendon_arm import Drive, TendonArm
from apcc_torch.report.identification import Outcome, identification_figures
from apcc_torch.report.style import save_figures

Say = Callable[[str], None]


@dataclass(frozen=True)
class Identified:
    """A fitted model.

    parameters, fit: What was fitted, and the result. prediction: (N, k, 3) m at every sample.
    """

    parameters: Parameters
    fit: Fit
    prediction: Tensor


def error(measured: Tensor, predicted: Tensor) -> float:
    """Root of the mean squared distance, mm."""
    return 1e3 * float((measured - predicted).square().sum(-1).mean().sqrt())


class Task(NamedTuple):
    """What every fit of a run shares: the recording, what drove the arm, which samples to fit to, and how."""

    series: Series
    drive: Drive
    used: Tensor
    settings: FitSettings
    say: Say


def identified(task: Task, arm: TendonArm, parameters: Parameters) -> Identified:
    """Fits to the samples in use and predicts all.

    Raises:
        DataError: The model has no equilibrium at the first parameters, or none at a sample after the fit.
    """
    given = task.drive.rows(task.used), task.series.positions[task.used]
    groups = task.series.groups[task.used]
    result = fit(arm, parameters, *given, task.settings, progress=task.say, groups=groups)
    prediction = arm.predict(task.drive, parameters.values(result.z))
    if not bool(prediction.isfinite().all()):
        row = int((~prediction.isfinite()).nonzero()[0, 0])
        raise DataError(f"{task.series.source}: the fitted arm has no equilibrium at sample {row}")
    return Identified(parameters, result, prediction)


def halves(task: Task, arm: TendonArm, model: Identified) -> float:
    """`disagreement` of fits to the earlier and to the later half of the samples in use."""
    fits = [
        fit(
            arm,
            model.parameters,
            task.drive.rows(part),
            task.series.positions[part],
            FitSettings(rounds=1),
            model.fit.z,
            groups=task.series.groups[part],
        )
        for part in task.used.chunk(2)
    ]
    return disagreement(*fits)


def compare(series: Series, parts: Split, used: Tensor) -> dict[str, Tensor]:
    """Predictions (N, k, 3) without a model of the arm."""
    given, wanted = parts.training, series.inputs
    return {
        "mean": mean_prediction(series.positions[given], len(series)),
        "linear": linear_prediction(wanted[given], series.positions[given], wanted),
        "linear_few": linear_prediction(wanted[used], series.positions[used], wanted),
    }


def of_geometry(settings: IdentifySettings, task: Task, geometric: Parameters) -> dict[str, Tensor]:
    """Predictions (N, k, 3) of the arm whose bends follow from its tendons' lengths: as built, fitted, online."""
    series, drive = task.series, task.drive
    geometry = TendonArm(settings.arm, kinematic=True)
    found = {"pcc_nominal": geometry.predict(drive, geometric.values(geometric.nominal()))}
    task.say("PCC geometry")
    found["pcc_identified"] = identified(task, geometry, geometric).prediction
    task.say("PCC geometry, online")
    seen = thinned(series.seen.nonzero()[:, 0], settings.online.samples)
    online, _ = adapt(geometry, geometric, drive.rows(seen), series.positions[seen], settings.online)
    found["pcc_online"] = torch.full_like(series.positions, torch.nan).index_copy(0, seen, online)
    return found


def run(settings: IdentifySettings, folder: Path, say: Say) -> tuple[dict[str, float], str]:
    """Fits, compares and writes the run's folder; returns the metrics and the report.

    Raises:
        ConfigError: A setting has no meaning.
        DataError: The recording cannot be read or used.
    """
    started = time.perf_counter()
    if settings.threads is not None:
        torch.set_num_threads(settings.threads)
    (series, parts), blocks = recorded(settings), parameters(settings)
    used = thinned(parts.training, settings.fit.samples)
    drive = series.drive(settings.fit.history, settings.fit.slide_travel)
    arm = TendonArm(settings.arm)
    task = Task(series, drive, used, settings.fit, say)
    predictions = compare(series, parts, used)
    if settings.arm.actuation.sets == "length":
        predictions |= of_geometry(settings, task, blocks.holding(settings.fit.geometric))
    say("the arm")
    model = identified(task, arm, blocks)
    predictions["arm_nominal"] = arm.predict(drive, blocks.values(blocks.nominal()))
    predictions["arm_identified"] = model.prediction
    spread = halves(task, arm, model)

    values = blocks.values(model.fit.z)
    length = 1e3 * float(settings.arm.rest_lengths().sum())
    answer = intervals(blocks, model.fit)
    unknown = unknown_directions(blocks, model.fit)
    information = torch.linalg.eigvalsh(model.fit.information)
    metrics = _metrics(series, parts, predictions, length)
    within = half_widths(arm, blocks, drive.rows(parts.validation), model.fit)
    held = series.positions[parts.validation]
    shares = coverage(model.prediction[parts.validation], within, held)
    for k, (share, width) in enumerate(zip(shares, within.mean((0, 2)), strict=True)):
        metrics[f"arm_identified_body_{k + 1}_coverage_percent"] = 100.0 * float(share)
        metrics[f"arm_identified_body_{k + 1}_half_width_mm"] = 1e3 * float(width)
    metrics |= {
        "training_samples_linear": len(parts.training),
        "training_samples_fit": len(used),
        "validation_samples": len(parts.validation),
        "arm_length_mm": length,
        "linear_over_arm_ratio": metrics["linear_tip_rmse_mm"] / metrics["arm_identified_tip_rmse_mm"],
        "noise_mm": 1e3 * model.fit.noise,
        "samples_per_independent_one": model.fit.correlation,
        "interval_disagreement": spread,
        "movements": model.fit.movements,
        "information_largest": float(information[-1]),
        "information_least": max(float(information[0]), 0.0),
        "unknown_directions": len(unknown),
        "frames_without_a_body_percent": 100.0 * float((~series.seen).double().mean()),
        "wall_s": time.perf_counter() - started,
    }
    name = settings.arm.name
    reasons = why_not(metrics)
    metrics["fit_usable"] = float(not reasons)
    text = report_text(name, metrics, list(predictions), answer, unknown, reasons)
    write_atomically(folder / "table.txt", text + "\n")
    origin = f"{name}, from {series.source} by python -m apcc_torch.identify; parameters.json has the intervals."
    result, warning = identified_arm(settings.arm, values), "".join(f"\nDo not use this arm: {why}." for why in reasons)
    result.save(folder / "arm.yaml", f"{origin}\n{account(blocks)}{warning}")
    told = {"arm": result.entries(), "usable": not reasons, "parameters": [_plain(entry, spread) for entry in answer]}
    write_json(folder / "parameters.json", told)
    held_back = torch.zeros(len(series), dtype=torch.bool).index_fill(0, parts.validation, True)
    half_width = torch.full_like(series.positions, torch.nan).index_copy(0, parts.validation, within)
    arrays = {"time": series.times, "inputs": series.inputs, "measured": series.positions, "held_back": held_back}
    arrays["half_width"] = half_width
    RunFolder(folder).write(metrics, arrays | predictions, 0)
    if settings.figures:
        outcome = Outcome(series.positions, predictions, parts.validation, arm.rest(drive, values), answer)
        save_figures(identification_figures(outcome, length, name), folder / "figures")
    return metrics, text


def _plain(entry: Interval, disagreed: float) -> dict[str, object]:
    return entry._asdict() | {"halves_differ_by_deviations": disagreed}


def _metrics(series: Series, parts: Split, predictions: dict[str, Tensor], length: float) -> dict[str, float]:
    """Errors of every model: of the tip on what was held back and on what was not, and of the other bodies."""
    answer: dict[str, float] = {}
    for name, prediction in predictions.items():
        known = prediction.isfinite().flatten(1).all(-1)
        held, given = (index[known[index]] for index in (parts.validation, parts.training))
        tip = error(series.positions[held, -1], prediction[held, -1])
        answer |= {
            f"{name}_tip_rmse_mm": tip,
            f"{name}_tip_rmse_percent": 100.0 * tip / length,
            f"{name}_training_tip_rmse_mm": error(series.positions[given, -1], prediction[given, -1]),
        }
        for k in range(series.positions.shape[1] - 1):
            answer[f"{name}_body_{k + 1}_rmse_mm"] = error(series.positions[held, k], prediction[held, k])
    return answer

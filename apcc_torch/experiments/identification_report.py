"""The report of an identification in words and tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from apcc_torch.identification.intervals import Direction, Interval

MODELS = {
    "mean": "constant mean",
    "linear": "linear regression, all training samples",
    "linear_few": "linear regression, the fit's samples",
    "pcc_nominal": "PCC, geometry as built",
    "pcc_identified": "PCC, geometry identified",
    "pcc_online": "PCC, geometry adapted online",
    "arm_nominal": "arm as built (tendons, stiffness, weight)",
    "arm_identified": "arm identified (tendons, stiffness, weight)",
}
"""What each model is."""


SHARE = 50.0
"""Percent of the frames that may lack a body; with more of them missing it is not known what was left out."""


def why_not(metrics: Mapping[str, float]) -> list[str]:
    """Why a fit must not be used, by the metrics of its run: one sentence each, none where it may."""
    reasons = []
    tip = metrics["arm_identified_tip_rmse_mm"]
    for name, what in (("arm_nominal", "the arm as built"), ("mean", "the mean position")):
        other = metrics[f"{name}_tip_rmse_mm"]
        if not math.isnan(other) and not tip < other:
            reasons.append(
                f"on what was held back its tip is off by {tip:.3g} mm, no less than the {other:.3g} mm of {what}"
            )
    lacking = metrics["frames_without_a_body_percent"]
    if lacking > SHARE:
        reasons.append(f"{lacking:.0f} % of the frames lack a body")
    return reasons


def _covered(metrics: Mapping[str, float]) -> list[str]:
    """A line a body: how much of what was held back its prediction intervals hold, and their mean half-width."""
    lines, body = [], 1
    while (share := metrics.get(f"arm_identified_body_{body}_coverage_percent")) is not None:
        width = metrics[f"arm_identified_body_{body}_half_width_mm"]
        lines.append(f"{f'coordinates of body {body}, arm identified':<46} {share:>20.1f} % {width:>14.2f} mm")
        body += 1
    return lines


def report_text(
    name: str,
    metrics: Mapping[str, float],
    models: Sequence[str],
    result: Sequence[Interval],
    unknown: Sequence[Direction],
    reasons: Sequence[str] = (),
) -> str:
    """The models beside each other, the parameters, and what the recording cannot tell.

    Args:
        name: Of the arm.
        metrics: Of the run.
        models: Those that are compared, keys of `MODELS`.
        result: The parameters.
        unknown: Combinations that the recording cannot tell.
        reasons: Why the fit must not be used.
    """
    lines = [*(f"Do not use this fit: {why}." for why in reasons), *([""] if reasons else [])]
    lines += [
        f"{name}: {metrics['validation_samples']:.0f} samples held back, {metrics['training_samples_linear']:.0f} for "
        f"training, of which the arm was fitted to {metrics['training_samples_fit']:.0f}",
        "",
        f"{'tip error, root mean square':<46} {'held back':>20} {'training':>10}",
    ]
    for model in models:
        tip, share = metrics[f"{model}_tip_rmse_mm"], metrics[f"{model}_tip_rmse_percent"]
        train = metrics[f"{model}_training_tip_rmse_mm"]
        lines.append(f"{MODELS[model]:<46} {tip:>8.2f} mm {share:>6.2f} % {train:>7.2f} mm")
    lines += [
        "",
        f"frames without some body, which are left out: {metrics['frames_without_a_body_percent']:.1f} %",
        f"linear regression's error over the arm's: {metrics['linear_over_arm_ratio']:.2f}",
        f"{metrics['samples_per_independent_one']:.1f} neighbouring samples count as one; two halves of the samples "
        f"give parameters {metrics['interval_disagreement']:.2g} standard deviations apart",
        "",
        f"{'95 % intervals, by leaving out ' + format(metrics['movements'], '.0f') + ' movements':<46} "
        f"{'hold of the held back':>22} {'half as wide as':>17}",
        *_covered(metrics),
        "",
        f"{'parameter':<34} {'nominal':>11} {'fitted':>11} {'95 % from':>11} {'to':>11} {'unit':<7} learned",
    ]
    lines += [
        f"{p.name:<34} {p.nominal:>11.5g} {p.value:>11.5g} {p.low:>11.5g} {p.high:>11.5g} {p.unit:<7} "
        f"{100 * p.learned:>5.0f} %"
        for p in result
    ]
    lines += ["", f"{len(unknown)} combinations are known no better than before the fit; the least known:"]
    for direction in unknown[:6]:
        parts = "  ".join(f"{weight:+.2f} {part}" for part, weight in direction.parts)
        lines.append(f"  information {direction.information:.2g}: {parts}")
    return "\n".join(lines)

"""The rows of the leaderboard: a method more is its class, and a line here."""

from __future__ import annotations

from collections.abc import Callable

from apcc_torch.evaluation import (
    arm_methods,
    identified_posterior,
    learning,
    residual_methods,
    sections_methods,
    shape_as_built,
    shape_identified,
)
from apcc_torch.evaluation.method import Known, Method

METHODS: dict[str, Callable[[Known], Method]] = {
    "mean": learning.Mean,
    "stays where it was": learning.Persistence,
    "moves on as before": learning.SteadyMotion,
    "linear": learning.Linear,
    "lagged kernel ridge": learning.KernelMethod,
    "lagged kernel ridge, split at slack": learning.KernelAtSlack,
    "random forest": learning.Forest,
    "MLP": learning.Network,
    "PCC as built": arm_methods.AsBuilt,
    "PCC identified": arm_methods.IdentifiedGeometry,
    "PCC, geometry followed": arm_methods.FollowedGeometry,
    "PCC online": arm_methods.OnlineGeometry,
    "arm identified": arm_methods.IdentifiedArm,
    "arm identified, offset carried over": arm_methods.IdentifiedAhead,
    "arm identified, payload followed": arm_methods.IdentifiedWithMass,
    "arm identified, load followed": arm_methods.IdentifiedUnderLoad,
    "arm identified, rest learned": residual_methods.LearnedRest,
    "PCC through the sensors": sections_methods.ThroughSensors,
    "affine through the sensors": sections_methods.AffineThroughSensors,
    "spline through the sensors": sections_methods.Spline,
    "PCC, best lengths in hindsight": sections_methods.BestLengths,
    "shape under load, as built": shape_as_built.ShapeAsBuilt,
    "shape under load, arm identified": shape_identified.ShapeIdentified,
    "most probable PCC": sections_methods.Posterior,
    "most probable affine": sections_methods.AffinePosterior,
    "most probable, arm identified": identified_posterior.IdentifiedPosterior,
    "most probable, rest learned": identified_posterior.LearnedPosterior,
}
"""Name -> what makes the method of what is known."""

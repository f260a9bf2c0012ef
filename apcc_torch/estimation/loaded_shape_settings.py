"""Settings of `LoadedShape`."""

from __future__ import annotations

from dataclasses import dataclass

from apcc_torch.settings import OURS, Setting, Settings, setting


@dataclass(frozen=True, kw_only=True)
class LoadedShapeSettings(Settings):
    """Settings of `LoadedShape`: standard deviations, of what a lab can measure or look up."""

    position_noise: Setting = setting(
        1e-3, "m", OURS, "of a sensor's coordinates, and of what mechanics leaves unexplained", rows="number", above=0
    )
    angular_noise: Setting = setting(0.02, "rad", OURS, "of a sensor's orientation, likewise", rows="number", above=0)
    tendon_noise: Setting = setting(
        2e-3, "m", OURS, "of a tendon's length change, with slack and compliance", rows="number", above=0
    )
    tilt_noise: Setting = setting(
        0.02, "rad", OURS, "of an inertial unit's tilt, with how it is mounted", rows="number", above=0
    )
    heading_noise: Setting = setting(
        0.3, "rad", OURS, "of an inertial unit's heading when the arm begins", rows="number", least=0
    )
    heading_drift: Setting = setting(
        0.01, "rad/sqrt(s)", OURS, "how fast that heading goes astray, a random walk", rows="number", least=0
    )
    curvature_noise: Setting = setting(
        0.2, "1/m", OURS, "of a measured curvature, and of what mechanics leaves unexplained", rows="number", above=0
    )
    bend: Setting = setting(
        3.0,
        "rad",
        OURS,
        "of the bend of the section that tendons bend most, before it is measured",
        rows="number",
        above=0,
    )
    elongation: Setting = setting(
        0.25, "", OURS, "of a section's elongation over its rest length, likewise", rows="number", above=0
    )
    load: Setting = setting(
        0.5, "", OURS, "of the load at the tip over the arm's mass, before it is felt", rows="number", above=0
    )
    load_rate: Setting = setting(
        0.3, "1/sqrt(s)", OURS, "how fast that load may change, over the arm's mass", rows="number", above=0
    )
    sag_time: Setting = setting(
        0.05, "s", OURS, "in which the sag follows the shape that it hangs from", rows="number", above=0
    )
    refine: int = setting(2, "", OURS, "pieces of each section", least=2, most=20)

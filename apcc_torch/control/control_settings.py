"""What a controller is made of, as settings: the groups `feedback`, `controller`, `adaptation`, … of a command line."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Self

from apcc_torch.control.inverse_kinematics import InverseKinematicsSettings
from apcc_torch.control.length_bounds import LengthBoundsSettings
from apcc_torch.control.length_law import LengthLaw
from apcc_torch.control.lookahead import Lookahead
from apcc_torch.control.pressure import PressureControlSettings
from apcc_torch.control.shape_law import ShapeLawSettings
from apcc_torch.control.task_integral import TaskIntegralSettings
from apcc_torch.errors import ConfigError
from apcc_torch.estimation.pose_filter import PoseFilterSettings
from apcc_torch.estimation.savitzky_golay import SavitzkyGolaySettings
from apcc_torch.estimation.state_feedback_settings import StateFeedbackSettings
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.reading import nested_in
from apcc_torch.settings import OURS, PAPER, Setting, Settings, did_you_mean, names, resolved, setting


@dataclass(frozen=True, kw_only=True)
class ControllerSettings(Settings):
    """Settings of `APCCController`."""

    adaptive: bool = setting(True, "", PAPER, "false: pi_hat stays fixed, the standard controller")
    velocity: str = setting(
        "measured",
        "",
        PAPER,
        "qdot of the regressor: measured, the filtered derivative of q_bar; commanded, without lag or noise",
        choices=("measured", "commanded"),
    )
    bend_bound: Setting | None = setting(
        None, "rad", OURS, "bound on the bends of q_d; null: none", rows="number", above=0
    )
    elongation_bound: Setting | None = setting(
        None, "m", OURS, "bound on the elongations of q_d; null: none", rows="number", above=0
    )
    reference_damping: float = setting(
        0.0, "s", OURS, "T in y = B_hat^T (q_d - T qdot_bar), damps the arm's swinging; 0: Eq. (49)", least=0, key=False
    )
    integration_limit: float = setting(
        0.1, "s", OURS, "longest step that is integrated; after a longer pause the rest is left out", above=0, key=False
    )


@dataclass(frozen=True, kw_only=True)
class ControllerKeys(ControllerSettings, InverseKinematicsSettings):
    """The keys of `controller`: its own settings and those of its inverse kinematics."""

    rate: float = setting(100.0, "Hz", OURS, "of the loop that runs it in a simulation", above=0, most=1e5)


@dataclass(frozen=True, kw_only=True)
class ControlSettings(Settings):
    """What a controller is made of. The defaults are those of section V-A, for any arm."""

    model: Settings = setting(factory=PCCBackbone.settings_type, meaning="the kinematic model", base=KinematicModel)
    feedback: StateFeedbackSettings = setting(factory=StateFeedbackSettings, meaning="algorithm 2")
    pose_filter: PoseFilterSettings | None = setting(
        None, "", OURS, "of the sensors' poses; null: as they are measured"
    )
    velocity_filter: SavitzkyGolaySettings = setting(factory=SavitzkyGolaySettings, meaning="derivative of q_bar")
    controller: ControllerKeys = setting(factory=ControllerKeys, meaning="inverse kinematics and the controller's own")
    adaptation: Settings | None = setting(
        factory=ShapeLawSettings, meaning="law of the rest lengths; null: none", base=LengthLaw
    )
    bounds: LengthBoundsSettings = setting(factory=LengthBoundsSettings, meaning="of pi_hat, whatever the laws say")
    integral: TaskIntegralSettings | None = setting(
        None, "", PAPER, "integral action on the task error; null: none, Eq. (14)"
    )
    pressure: PressureControlSettings = setting(
        factory=PressureControlSettings, meaning="from lengths to pressures, of an arm with chambers"
    )
    lookahead: Settings | None = setting(
        None, "", OURS, "departures from Eq. (16) that rollouts find better; null: none", base=Lookahead
    )

    def with_keys(self, changes: Mapping[str, Any]) -> Self:
        """A copy with changes by name: of a group, settings or a mapping; of a key, the first group's that has it.

        Raises:
            ConfigError: No group has the key.
        """
        groups = {each.name: getattr(self, each.name) for each in fields(self)}
        order = ("controller", "feedback", "velocity_filter", "adaptation", "bounds")
        for name, value in changes.items():
            if name in groups:
                groups[name] = self._group(name, groups[name], value) if isinstance(value, Mapping) else value
                continue
            owner = next((g for g in order if groups[g] is not None and name in names(type(groups[g]))), None)
            if owner is None:
                known = [key for g in order if groups[g] is not None for key in names(type(groups[g]))]
                raise ConfigError(f"a controller has no setting {name!r}{did_you_mean(name, [*groups, *known])}")
            groups[owner] = groups[owner].changed(**{name: value})
        return type(self)(**groups)

    def _group(self, name: str, group: Settings | None, changes: Mapping[str, Any]) -> Settings:
        """A group's settings with changes; those of its class where there were none."""
        if group is not None:
            return group.changed(**changes)
        kind = nested_in(type(self), name)
        if kind is None:
            raise ConfigError(f"{name} is none, and only its settings say of which class it shall be")
        return resolved(kind, (), changes)

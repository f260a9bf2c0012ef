"""What differs on an arm from what is believed of it: any of its fields."""

from __future__ import annotations

from dataclasses import field, fields, make_dataclass
from typing import TYPE_CHECKING

# The types of the arm's fields are told in words, which are looked up here.
from apcc_torch.model.arm import Arm, Lengths  # noqa: F401
from apcc_torch.model.arm_placement import Placement  # noqa: F401
from apcc_torch.model.arm_tendons import Actuation, Tendons  # noqa: F401
from apcc_torch.model.chambers import Chambers  # noqa: F401
from apcc_torch.model.table import Table  # noqa: F401
from apcc_torch.settings import Setting, Settings  # noqa: F401
from apcc_torch.spread import Numbers  # noqa: F401

if TYPE_CHECKING:

    class ArmChanges(Settings):
        """What differs on an arm from what is believed of it; None: nothing."""

else:
    ArmChanges = make_dataclass(
        "ArmChanges",
        [
            (e.name, str(e.type).replace(" | None", "") + " | None", field(default=None, metadata=e.metadata))
            for e in fields(Arm)
        ],
        bases=(Settings,),
        namespace={"__doc__": "What differs on an arm from what is believed of it; None: nothing."},
        frozen=True,
        kw_only=True,
    )
    ArmChanges.__module__ = __name__


def with_changes(arm: Arm, changes: ArmChanges) -> Arm:
    """The arm with those of the changes that are not None."""
    values = {each.name: getattr(changes, each.name) for each in fields(changes)}
    return arm.changed(**{name: value for name, value in values.items() if value is not None})

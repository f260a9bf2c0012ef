"""The schemas that hydra merges files and a command line into."""

from __future__ import annotations

from hydra.core.config_store import ConfigStore

from apcc_torch.composition.schema import schema
from apcc_torch.settings import Settings

# Hydra copies its store, with every schema in it, for each group that a manual lists: seconds. What it takes from the
# store it copies once more.
ConfigStore.__deepcopy__ = lambda store, memo: store  # type: ignore[attr-defined]


def keep_schema(name: str, root: type[Settings]) -> None:
    """Gives hydra a root's schema under the name by which `conf/` refers to it.

    Args:
        name: The schema's.
        root: A program's settings.

    Example:
        >>> from apcc_torch.composition.run_settings import SimulateSettings
        >>> keep_schema("simulate_schema", SimulateSettings)
    """
    ConfigStore.instance().store(name=name, node=schema(root))

"""Where the file of an arm is: named as one, or one that comes with the package."""

from __future__ import annotations

from pathlib import Path

from apcc_torch.conf_path import conf_path
from apcc_torch.errors import ConfigError
from apcc_torch.settings import did_you_mean


def arm_path(path: str | Path) -> Path:
    """The file of an arm: what has neither folder nor suffix is a name in conf/arm, or a ConfigError."""
    path = Path(path)
    if path.suffix or len(path.parts) != 1:
        return path
    files = {file.stem: file for file in sorted(Path(conf_path(), "arm").glob("*.yaml"))}
    if path.name not in files:
        raise ConfigError(f"the package has no arm {path.name!r}{did_you_mean(path.name, files)}")
    return files[path.name]

"""Where the configurations are: inside an installed package, or beside the package in a checkout."""

from __future__ import annotations

from pathlib import Path

from apcc_torch.errors import ConfigError

_PACKAGE = Path(__file__).resolve().parent


def conf_path() -> str:
    """The absolute path of the folder of configurations, the form that hydra takes from any entry point.

    A built wheel carries conf/ as apcc_torch/conf; in a checkout, and so in an editable install, conf/ lies beside
    apcc_torch/.

    Raises:
        ConfigError: Neither folder exists.
    """
    candidates = (_PACKAGE / "conf", _PACKAGE.parent / "conf")
    for folder in candidates:
        if folder.is_dir():
            return str(folder)
    raise ConfigError(f"no configurations found in {candidates[0]} or {candidates[1]}; reinstall the package")

"""`data=` on a command line: a name in conf/data_set, a data set's file, or a recording itself."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from apcc_torch.annotations import shown
from apcc_torch.composition.arm_file import SUFFIXES, spelled
from apcc_torch.composition.evaluate import EvaluateSettings
from apcc_torch.composition.identify import IdentifySettings, LearningSettings, known_arm
from apcc_torch.composition.schema import groups
from apcc_torch.errors import ConfigError, DataError, ValueRangeError
from apcc_torch.files import read_text, yaml_in
from apcc_torch.reading import nested_in, read
from apcc_torch.recordings.data_set import DataSettings, holding, named_set, refuse, set_file, set_names
from apcc_torch.settings import Settings, did_you_mean, keys

FILE = "data.yaml"
"""Name of a data set's file in a folder that is given for it."""
ITS_OWN = ("spread", "recording", "split", "fit", "methods", "every", "seed", "online", "replay")
"""Keys of the programs that a data set's file may have beside data: nothing of folders, threads or Hydra."""


def data_override(arguments: Sequence[str], root: type[Settings] = EvaluateSettings) -> list[str]:
    """Arguments as Hydra takes them, with the arm of the recordings where they name none.

    A data set's file holds what the files of conf/data_set do, and any keys of the programs that take it; files and the
    arm's are found beside it. Of a recording, the set is the one of conf/data_set whose files it has, else it is a set
    of one recording.

    Args:
        arguments: The command line.
        root: The program's settings. Keys of a file that they lack, and another program has, are left out.

    Raises:
        ConfigError: No data is named, or the arm is not known.
        DataError: There is no such file, or it cannot be read.
    """
    given = next((word.removeprefix("data=") for word in arguments if word.startswith("data=")), None)
    learns = issubclass(root, LearningSettings)
    if given is None:
        if learns and not any(argument.startswith("-") for argument in arguments):
            names = ", ".join(set_names())
            raise ConfigError(f"data must name a data set ({names}), the file of one, or a recording: data=NAME")
        return list(arguments)
    rest = [word for word in arguments if not word.startswith("data=")]
    if given.startswith("{") or given in ("null", ""):  # spelled out already
        return list(arguments)
    words, arm = _words(given, root)
    if not learns or any(word.startswith(("arm=", "--config-name", "-cn")) for word in rest):
        return [*words, *rest]
    if not arm:
        raise ConfigError(f"arm must be named: arm=NAME or arm=FILE, as {given} is of no arm in conf/arm")
    return [*words, f"arm={arm}", *rest]


def _words(given: str, root: type[Settings]) -> tuple[list[str], str]:
    """What stands for `data=given`, and the arm that it names."""
    if given in set_names():
        return _of_file(set_file(given), root, named=True)
    path = Path(given)
    file = path / FILE if path.is_dir() else path
    if file.suffix in SUFFIXES and (file.is_file() or not path.is_dir()):
        return _of_file(file, root)
    if not path.exists():
        refuse(given)
    folder = path if path.is_dir() else path.parent
    known = holding(folder, {name: named_set(name) for name in set_names()})
    if known is not None and path.is_dir():
        words, arm = _of_file(set_file(known), root, named=True)
        return [*words, f"data.folder={spelled(str(path.resolve()))}"], arm
    alone = {"name": path.stem, "folder": str(folder.resolve()), "sessions": {"recording": {"file": ""}}}
    if not path.is_dir():
        alone["sessions"] = {"recording": {"file": path.name}}
    return [f"data={spelled(alone)}"], known_arm(given) or ""


def _of_file(file: Path, root: type[Settings], named: bool = False) -> tuple[list[str], str]:
    values = yaml_in(read_text(file, name=str(file)), str(file))
    if not isinstance(values, dict) or not isinstance(values.get("data"), dict):
        raise DataError(f"{file}: must hold the group data, as the files of conf/data_set do")
    for key in values:
        if key not in ("data", *ITS_OWN):
            raise DataError(f"{file}: {shown(key)} is nothing that a data set says{did_you_mean(str(key), ITS_OWN)}")
    data: dict[str, Any] = {"name": file.stem if file.name != FILE else file.resolve().parent.name} | values.pop("data")
    if not named and data.get("source") is None:
        data.setdefault("folder", ".")
    try:
        arm = read(data, DataSettings, "data").arm
        if arm.endswith(SUFFIXES):
            arm = str(file.resolve().parent / arm)
        elif arm and arm not in groups("evaluate")["arm"]:
            raise ConfigError(f"data.arm has no choice {arm!r}{did_you_mean(arm, groups('evaluate')['arm'])}")
        if data.get("folder") is not None:
            data["folder"] = os.path.realpath(file.resolve().parent / data["folder"])
        for key, value in values.items():
            kinds = (kind for kind in (root, EvaluateSettings, IdentifySettings) if key in _names(kind))
            part = next((nested_in(kind, key) for kind in kinds), None)
            if part is not None:
                read(value, part, key)
        # The package's own sets are split as the leaderboard has it; a fit has its own default.
        known = _names(root) - ({"split"} if named and root is not EvaluateSettings else set())
        told = {key: value for key, value in values.items() if key in known}
        words = [f"{key}={spelled(value)}" for key, value in ({"data": data} | told).items()]
    except (ConfigError, ValueRangeError) as error:
        raise type(error)(f"{file}: {error}") from error
    return words, arm


def _names(root: type[Settings]) -> set[str]:
    return {each.name for each in keys(root)}

"""Public sets of recordings: where they come from, what they hold, and their files, local or fetched."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from apcc_torch.conf_path import conf_path
from apcc_torch.errors import ConfigError, DataError, in_a_line
from apcc_torch.files import cache_folder, read_text, yaml_in
from apcc_torch.reading import read
from apcc_torch.settings import OURS, Settings, close, did_you_mean, setting

FOLDER = "data_set"
"""Of conf/, in which the sets are declared. Were it called data, Hydra would take data=FILE for a choice of them."""
STILL = "still"
"""Stands for a file in which the arm rests where the recording itself begins with it."""
ROOT = "APCC_DATA"
"""The environment's name for a folder of data sets."""


@dataclass(frozen=True, kw_only=True)
class FileSettings(Settings):
    """A file of a data set."""

    source: str = setting("", "", OURS, "its path below the set's source; empty: its own name")
    sha256: str = setting("", "", OURS, "of its content; empty: not checked")


@dataclass(frozen=True, kw_only=True)
class SessionSettings(Settings):
    """One recording of a data set."""

    file: str = setting("", "", OURS, "file or folder, below the set's folder; empty: the folder itself")
    inputs: str = setting("", "", OURS, "file of what drove the arm, by the same clock; empty: the other file says it")
    payload: float | None = setting(None, "kg", OURS, "at the tip; null: not known", least=0)


@dataclass(frozen=True, kw_only=True)
class DataSettings(Settings):
    """A set of recordings of one arm."""

    name: str = setting("recording", "", OURS, "of the set")
    source: str = setting("", "", OURS, "address that its files' paths follow; empty: it cannot be fetched")
    commit: str = setting("", "", OURS, "of the source")
    licence: str = setting("", "", OURS, "of the files")
    folder: str | None = setting(None, "", OURS, "of its files; null: the set's folder in data_root, or the cache")
    place: str = setting("", "", OURS, "its folder below data_root; empty: its name")
    files: dict[str, FileSettings] = setting(factory=dict, meaning="name: where a file comes from, and its checksum")
    arm: str = setting("", "", OURS, "of the recordings: a name in conf/arm, or an arm's file")
    kind: str = setting(
        "motion",
        "",
        OURS,
        "motion: inputs and bodies; statics: shapes of a rod under known wrenches, as SoRoSim writes them",
        choices=("motion", "statics"),
    )
    sessions: dict[str, SessionSettings] = setting(factory=dict, meaning="name: a recording")
    train: str = setting("", "", OURS, "session that methods learn from; empty: the first")
    validation: str = setting("", "", OURS, "session that judges instead of the parts that split holds back")
    rest: str | None = setting(
        None,
        "",
        OURS,
        "file in which the arm rests, straight; still: where the session to learn from begins; null: none",
    )
    rest_frames: int | None = setting(None, "", OURS, "at that file's start in which it rests; null: all", least=1)
    every_fold: bool = setting(False, "", OURS, "hold back every fold in turn, and not split.fold alone")

    def check(self) -> None:
        """Raises ConfigError where a session is named that is none, or a path leads out of the set's folder.

        A set's file may come from elsewhere, and what is fetched for it is written under the names that it says.
        """
        paths = {"place": [self.place or self.name], "rest": [self.rest or ""], "files": list(self.files)}
        sessions = [session for session in self.sessions.values() if isinstance(session, SessionSettings)]
        for name in ("file", "inputs"):
            paths[f"sessions.*.{name}"] = [getattr(session, name) for session in sessions]
        for key, path in ((key, path) for key, every in paths.items() for path in every):
            if Path(path).is_absolute() or ".." in Path(path).parts or "\0" in path:
                raise ConfigError(f"{key} must be a path inside the set's folder, got {path!r}")
        if "/" in self.commit:
            raise ConfigError(f"commit must have no slash, got {self.commit!r}")
        if "\0" in (self.folder or "") + self.commit:
            raise ConfigError("folder and commit must have no zero bytes")
        for name in ("train", "validation"):
            value = getattr(self, name)
            if value and value not in self.sessions:
                raise ConfigError(f"{name} must name a session{did_you_mean(value, self.sessions)}")
        if self.sessions and self.validation == self.learned:
            raise ConfigError(f"validation must name another session than {self.learned}, which is learned from")

    def in_motion(self) -> DataSettings:
        """The set, if it is of motion.

        Raises:
            ConfigError: It is of shapes.
        """
        if self.kind != "motion":
            raise ConfigError(f"data.kind must be motion: {self.kind} is for python -m apcc_torch.evaluate")
        return self

    @property
    def learned(self) -> str:
        """The session that methods learn from."""
        if not self.sessions:
            raise ConfigError("data must name the file or folder of a recording, or a data set: data=PATH")
        return self.train or next(iter(self.sessions))


def set_names() -> list[str]:
    """The data sets that conf/data_set declares."""
    return sorted(path.stem for path in Path(conf_path(), FOLDER).glob("*.yaml"))


def set_file(name: str) -> Path:
    """The file that declares a set."""
    return Path(conf_path(), FOLDER, f"{name}.yaml")


def named_set(name: str) -> DataSettings:
    """A data set of conf/data_set.

    Raises:
        ConfigError: There is none of that name.
    """
    if name not in set_names():
        raise ConfigError(f"data has no choice {name!r}{did_you_mean(name, set_names())}")
    file = set_file(name)
    return read(yaml_in(read_text(file), file.name)["data"], DataSettings, "data")


def refuse(data: str) -> NoReturn:
    """Raises for what is neither a data set nor there.

    Raises:
        ConfigError: It is close to a set's name.
        DataError: It is not.
    """
    if close(data, set_names()) is not None:
        raise ConfigError(f"data has no choice {data!r}{did_you_mean(data, set_names())}")
    raise DataError(f"{data}: there is no such file or folder")


def located(data: DataSettings, data_root: str | None = None) -> Path:
    """The folder of a set's files: as `data.folder` says, else below `data_root` or APCC_DATA, else fetched.

    Args:
        data: The set.
        data_root: A folder of sets; None: what the environment says, if it does.

    Raises:
        DataError: A file is missing or another than the set's, or cannot be fetched.
    """
    if data.folder is not None:
        return checked(Path(data.folder), data)
    place = data.place or data.name
    root = data_root or os.environ.get(ROOT)
    if root and (Path(root) / place).is_dir():
        return checked(Path(root) / place, data)
    if data_root:
        raise DataError(f"data_root must hold the folder {place}, and {data_root} does not")
    cached = cache_folder() / f"{place}-{data.commit or 'latest'}"
    return checked(cached if cached.is_dir() else fetched(data, cached), data)


def checked(folder: Path, data: DataSettings) -> Path:
    """The folder, where it holds the set's files as they were published.

    Raises:
        DataError: A file is missing, or another.
    """
    for name, file in data.files.items():
        try:
            with (folder / name).open("rb") as content:
                digest = hashlib.file_digest(content, "sha256").hexdigest()
        except OSError as error:
            raise DataError(f"{folder / name}: cannot be read ({error.strerror}); {data.name} needs it") from error
        if file.sha256 and digest != file.sha256:
            raise DataError(f"{folder / name}: is not the file of {data.name}, its SHA-256 is another")
    return folder


def fetched(data: DataSettings, folder: Path) -> Path:
    """Fetches a set into `folder`, whole or not at all.

    Raises:
        DataError: There is no source, no network, or a file is another than the set's.
    """
    by_hand = f"put its files into FOLDER/{data.place or data.name} and name the former with data_root=FOLDER or {ROOT}"
    if not data.source or not data.files:
        raise DataError(f"{data.name} cannot be fetched, it names no source; {by_hand}")
    addresses = {name: f"{data.source}/{file.source or name}" for name, file in data.files.items()}
    try:
        import pooch
    except ImportError as error:
        raise DataError(
            f'{data.name} is fetched by pooch: pip install "apcc-torch[evaluate]"; or fetch '
            f"{', '.join(addresses.values())}, and {by_hand}"
        ) from error
    pooch.get_logger().setLevel("ERROR")
    draft: Path | None = None
    try:
        # Private, for machine code is kept there too.
        folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        draft = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        for name, address in addresses.items():
            told = data.files[name].sha256
            pooch.retrieve(address, f"sha256:{told}" if told else None, fname=name, path=draft)
        os.replace(draft, folder)
    except (OSError, ValueError) as error:  # no network, no such file; another content
        raise DataError(
            f"{data.name} cannot be fetched ({in_a_line(error)}): fetch {', '.join(addresses.values())}, and {by_hand}"
        ) from error
    finally:
        if draft is not None:
            shutil.rmtree(draft, ignore_errors=True)
    return folder


def holding(folder: Path, sets: Mapping[str, DataSettings]) -> str | None:
    """The set whose files a folder holds, by their names; None where it is of none."""
    there = {path.name for path in folder.iterdir()}
    return next((name for name, data in sets.items() if data.files and set(data.files) <= there), None)

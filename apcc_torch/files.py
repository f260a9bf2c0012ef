"""Files are written whole or not at all: into a draft beside them, then moved into place. They are read within bounds.

What is read may come from anywhere: its size, its depth and its numbers are bounded, and all that is wrong with it is a
`DataError` of one sentence.
"""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from torch import Tensor

from apcc_torch.errors import ConfigError, DataError, WriteError, in_a_line

MOST_TEXT, MOST_ARRAYS = 2**26, 2**32
"""Largest text that is read, and largest set of arrays once they are unpacked, bytes."""
DEEPEST = 100
"""Most mappings and lists of a YAML file within each other."""
LONGEST_NUMBER = 308
"""Most characters of a number in a YAML or JSON file; every whole one that is not longer is a float too."""

NUMBER = re.compile(r"[-+.0-9][-+._:0-9a-fA-Fxo]*")
"""What YAML may take for a number."""

EXPONENT = re.compile(r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$")
"""Numbers such as 1e-3, which PyYAML takes for text, as YAML 1.1 has it; in YAML 1.2 and in JSON they are numbers."""


class Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """PyYAML's parser, in C where it was built with it: ten times faster."""


class Dumper(yaml.SafeDumper):
    """Puts text within quotes that `Loader` would take for a number."""


for _each in (Loader, Dumper):
    _each.add_implicit_resolver("tag:yaml.org,2002:float", EXPONENT, list("-+.0123456789"))


def cache_folder() -> Path:
    """Where what can be made or fetched again is kept: APCC_CACHE, else apcc_torch in the user's cache folder.

    Raises:
        ConfigError: The user has no home folder.
    """
    named, caches = os.environ.get("APCC_CACHE"), os.environ.get("XDG_CACHE_HOME")
    if named:
        return Path(named).absolute()
    try:
        return Path(caches or Path.home() / ".cache").absolute() / "apcc_torch"
    except RuntimeError as error:
        raise ConfigError("there is no home folder to keep a cache in; name a folder in APCC_CACHE") from error


@contextmanager
def draft_of(path: Path | str) -> Iterator[Path]:
    """A name beside `path`, with its suffix, to write to: moved into place if the block ends well, else removed.

    The folder is made if it is not there.

    Raises:
        WriteError: The system does not take it.
    """
    path = Path(path)
    draft = path.with_name(f".{path.stem}.{os.getpid()}.draft{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield draft
        os.replace(draft, path)
    except OSError as error:
        raise WriteError(f"{path} cannot be written: {error.strerror or error}") from error
    finally:
        with suppress(OSError):  # nor is there a draft where there is no folder
            draft.unlink()


@contextmanager
def draft_folder_of(path: Path | str) -> Iterator[Path]:
    """A folder's place to make it at, of its own name: moved to `path` if the block ends well, else removed.

    Raises:
        WriteError: There is something at `path` already, or the system does not take it.
    """
    path = Path(path)
    if path.exists():
        raise WriteError(f"{path} is there already: name another folder, or remove it")
    around = path.with_name(f".{path.name}.{os.getpid()}.draft")
    try:
        around.mkdir(parents=True)
        yield around / path.name
        os.replace(around / path.name, path)
    except OSError as error:
        raise WriteError(f"{path} cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(around, ignore_errors=True)


def write_atomically(path: Path | str, content: bytes | str) -> Path:
    """Writes `content` to `path` so that a reader, or a crash, never meets half of it; text as UTF-8, as it is.

    Returns:
        The path.
    """
    with draft_of(path) as draft, draft.open("wb") as file:
        file.write(content.encode("utf-8") if isinstance(content, str) else content)
        # On the disk before the name is: after a crash the old file is there, or the new one whole.
        file.flush()
        os.fsync(file.fileno())
    return Path(path)


def write_json(path: Path | str, data: Mapping[str, object]) -> Path:
    """Writes a mapping as indented JSON, keys in the order given."""
    return write_atomically(path, json.dumps(data, indent=2) + "\n")


def write_arrays(path: Path | str, arrays: Mapping[str, Tensor]) -> Path:
    """Writes tensors as one compressed NumPy archive (.npz)."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **{name: tensor.detach().cpu().numpy() for name, tensor in arrays.items()})  # type: ignore[arg-type]
    return write_atomically(path, buffer.getvalue())


def read_text(path: Path | str, most: int = MOST_TEXT, name: str | None = None) -> str:
    """The text of a file.

    Args:
        path: A regular file, or a link to one.
        most: Bytes that it may have.
        name: What it is called in messages; None: its name without its folder.

    Raises:
        DataError: It is no file, is too large, cannot be opened, or is not UTF-8.
    """
    path = Path(path)
    name = name or path.name
    try:
        # A pipe or a device would be read for ever.
        if path.exists() and not path.is_file():
            raise DataError(f"{name} cannot be read: it is no file")
        with path.open("rb") as file:
            content = file.read(most + 1)
    except OSError as error:
        raise DataError(f"{name} cannot be read: {error.strerror}") from error
    if len(content) > most:
        raise DataError(f"{name} cannot be read: it has over {most / 2**20:g} MiB")
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise DataError(f"{name} cannot be read: it is not UTF-8 from byte {error.start} on") from error


def json_in(text: str, name: str) -> Any:
    """What a JSON text says.

    Args:
        text: The text.
        name: What it is called in messages.

    Raises:
        DataError: It is no JSON, or too deep, or a number in it is too long.
    """
    try:
        return json.loads(text, parse_int=_whole)
    except RecursionError as error:
        raise DataError(f"{name} cannot be read: too many lists or mappings stand within each other") from error
    except ValueError as error:
        raise DataError(f"{name} cannot be read: {in_a_line(error)}") from error


def yaml_in(text: str, name: str) -> Any:
    """What a YAML text says: plain values; references to other places in it and types of its own are refused.

    Args:
        text: The text.
        name: What it is called in messages.

    Raises:
        DataError: It is not YAML, or too deep, refers to itself, names types, or a number in it is too long.
    """
    try:
        depth = 0
        for event in yaml.parse(text, Loader):
            if isinstance(event, yaml.AliasEvent):
                raise ValueError("it refers to a part of itself; write that part out")
            if isinstance(event, yaml.CollectionStartEvent):
                depth += 1
                if depth > DEEPEST:
                    raise ValueError(f"over {DEEPEST} lists or mappings stand within each other")
            elif isinstance(event, yaml.CollectionEndEvent):
                depth -= 1
            elif isinstance(event, yaml.ScalarEvent) and event.implicit[0] and NUMBER.fullmatch(event.value):
                _check_number(event.value)
            if getattr(event, "tag", None) not in (None, "!"):
                raise ValueError(f"it names a type, {event.tag}, and only plain values are read")
        return yaml.load(text, Loader)
    except yaml.MarkedYAMLError as error:
        where = "" if error.problem_mark is None else f" in line {error.problem_mark.line + 1}"
        raise DataError(f"{name} cannot be read: {error.problem or error.context}{where}") from error
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        raise DataError(f"{name} cannot be read: {in_a_line(error)}") from error


def yaml_text(values: Mapping[str, Any]) -> str:
    """Plain values as a text that `yaml_in` reads as they are: keys in their order, lists of numbers in a line."""
    return yaml.dump(dict(values), Dumper=Dumper, sort_keys=False, default_flow_style=None, width=120)


def read_arrays(path: Path | str) -> dict[str, Tensor]:
    """The arrays of a NumPy archive (.npz) as tensors.

    Raises:
        DataError: It is missing, damaged, too large, or holds what is no tensor.
    """
    path = Path(path)
    try:
        if path.exists() and not path.is_file():
            raise DataError(f"{path.name} cannot be read: it is no file")
        with zipfile.ZipFile(path) as members:
            size = sum(member.file_size for member in members.infolist())
        if size > MOST_ARRAYS:
            raise DataError(f"{path.name} cannot be read: its arrays have over {MOST_ARRAYS / 2**30:g} GiB")
        with np.load(path, allow_pickle=False) as archive:
            return {name: torch.from_numpy(archive[name]) for name in archive.files}
    except DataError:
        raise
    except Exception as error:  # zipfile, zlib, NumPy and torch raise a dozen kinds for one damaged archive
        raise DataError(f"{path.name} cannot be read: {in_a_line(error)}") from error


def _check_number(text: str) -> str:
    if len(text) > LONGEST_NUMBER:
        raise ValueError(f"it holds a number of {len(text)} characters")
    return text


def _whole(text: str) -> int:
    return int(_check_number(text))

"""Shared libraries that are kept: in a folder of the user's own, whole, and checked before they are loaded."""

from __future__ import annotations

import ctypes
import fcntl
import hashlib
import os
import shutil
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from apcc_torch.errors import CompileError, ConfigError
from apcc_torch.files import cache_folder, write_atomically
from apcc_torch.plain_text import plain_logger

log = plain_logger(__name__)

OTHERS = stat.S_IWGRP | stat.S_IWOTH
BUILD = "build_"
"""How the folder of a build begins, which ends with the build."""
ABANDONED = 3600.0
"""After this time, in which none of its files came or went, s, nobody works on a build any more."""


def private_folder() -> Path:
    """The cache folder, made for this user alone if it is not there.

    Raises:
        CompileError: It cannot be made, or another user owns it or may write to it.
    """
    try:
        folder = cache_folder()
    except ConfigError as error:
        raise CompileError(str(error)) from error
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
    except OSError as error:
        raise _unkept(error) from error
    check_private(folder)
    return folder


def swept_folder() -> Path:
    """The same, without what builds left that were killed.

    Raises:
        CompileError: As `private_folder`.
    """
    folder = private_folder()
    for left in [*folder.glob(f"{BUILD}*"), *folder.glob(".*.draft.*")]:
        with suppress(OSError):  # another process may sweep it as well
            if time.time() - left.stat().st_mtime > ABANDONED:
                shutil.rmtree(left) if left.is_dir() else left.unlink()
    return folder


def check_private(path: Path) -> None:
    """Raises CompileError where another user owns what is loaded as code, or may write to it."""
    told = path.stat()
    if told.st_uid != os.getuid():
        whose = "belongs to another user"
    elif told.st_mode & OTHERS:
        whose = "may be written by other users"
    else:
        return
    raise CompileError(f"{path} {whose}, and code from it is not run; name a folder of your own in APCC_CACHE")


def kept(name: str) -> Path | None:
    """The file of this name, if it was kept before and is whole; the log says where it is damaged.

    Raises:
        CompileError: It cannot be read, or is not this user's alone.
    """
    library = private_folder() / name  # made here: what cannot be kept is known before it is built
    try:
        if not library.exists():
            return None
        check_private(library)
        if _checksum(library).read_text(encoding="ascii") == hashlib.sha256(library.read_bytes()).hexdigest():
            return library
    except (FileNotFoundError, UnicodeDecodeError):
        pass  # the checksum is damaged too, or gone
    except OSError as error:
        raise _unkept(error) from error
    log.warning("the kept machine code %s is damaged and is built again", library)
    return None


def keep(content: bytes, name: str) -> Path:
    """Keeps what was built, whole or not at all, with its checksum beside it.

    Raises:
        CompileError: It cannot be written.
    """
    library = private_folder() / name
    try:
        for path, what in ((library, content), (_checksum(library), hashlib.sha256(content).hexdigest())):
            write_atomically(path, what).chmod(0o600)
    except OSError as error:
        raise _unkept(error) from error
    return library


@contextmanager
def alone() -> Iterator[None]:
    """Waits until no other process builds into the cache folder, and keeps others waiting; it ends with its process.

    Raises:
        CompileError: The folder cannot be opened.
    """
    try:
        lock = os.open(private_folder(), os.O_RDONLY)
    except OSError as error:
        raise _unkept(error) from error
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
    finally:
        os.close(lock)


def loaded(library: Path) -> Any:
    """The entry point of a library.

    Raises:
        CompileError: The system does not load it.
    """
    try:
        entry = ctypes.CDLL(str(library)).run
    except (OSError, AttributeError) as error:
        raise CompileError(f"machine code cannot be loaded: {error}") from error
    entry.restype = None
    entry.argtypes = [ctypes.c_long, ctypes.c_long, ctypes.c_int, *(ctypes.c_void_p,) * 4]
    return entry


def _checksum(library: Path) -> Path:
    return library.with_name(library.name + ".sha256")


def _unkept(error: OSError) -> CompileError:
    if isinstance(error.__cause__, OSError):
        error = error.__cause__  # a `WriteError` names the file as well
    why = "it is no folder" if isinstance(error, FileExistsError | NotADirectoryError) else error.strerror or error
    return CompileError(f"machine code cannot be kept in {cache_folder()}: {why}; name another folder in APCC_CACHE")

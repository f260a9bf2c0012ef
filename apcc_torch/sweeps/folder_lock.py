"""A folder held by one process: the system takes the lock back when the process ends, however it ends."""

from __future__ import annotations

import errno
import os
import platform
from contextlib import suppress
from pathlib import Path
from typing import TextIO

from apcc_torch.errors import ConfigError
from apcc_torch.plain_text import plain_logger

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

log = plain_logger(__name__)

NAME = ".lock"
"""Of the file that says who holds the folder. A process that is killed leaves it, and holds nothing."""


class FolderLock:
    """Holds a folder, which is made, until it is let go of.

    Raises:
        ConfigError: Another process holds it.
        OSError: It cannot be made or written to.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.path = folder / NAME
        self._file = self._opened()
        try:
            while not self._is_there():
                # Its last holder has taken it away since it was opened.
                self._file.close()
                self._file = self._opened()
            self._file.truncate(0)
            self._file.write(f"process {os.getpid()} on {platform.node()}")
            self._file.flush()
        except BaseException:
            self._file.close()
            raise

    def _opened(self) -> TextIO:
        # A link in a folder from elsewhere would have another file emptied.
        here = getattr(os, "O_NOFOLLOW", 0)
        return open(self.path, "a+", encoding="utf-8", opener=lambda path, flags: os.open(path, flags | here, 0o666))

    def _is_there(self) -> bool:
        """Locks the open file; whether it is the folder's still."""
        folder = self.path.parent
        try:
            if fcntl is not None:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EACCES):
                self._file.seek(0)
                holder = self._file.read(100) or "another process"
                raise ConfigError(f"{folder} is in use by {holder}; wait for it, or name another folder") from error
            log.warning("%s has no locks (%s): let one command at a time work on it", folder, error.strerror)
        with suppress(FileNotFoundError):  # its holder has just taken it away
            return os.path.samestat(os.fstat(self._file.fileno()), self.path.stat())
        return False

    def release(self) -> None:
        """Lets go of the folder."""
        # Before the lock ends: who opened the file meanwhile finds it gone, and makes another.
        self.path.unlink(missing_ok=True)
        self._file.close()

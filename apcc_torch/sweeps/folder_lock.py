"""A folder held by one process: the system takes the lock back when the process ends, however it ends."""

from __future__ import annotations

import errno
import logging
import os
import platform
from pathlib import Path

from apcc_torch.errors import ConfigError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

log = logging.getLogger(__name__)

NAME = ".lock"
"""Of the file that says who holds the folder. A process that is killed leaves it, and holds nothing."""


class FolderLock:
    """Holds a folder, which is made, until it is let go of.

    Args:
        folder: The folder.

    Raises:
        ConfigError: Another process holds it.
        OSError: It cannot be made or written to.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.path = folder / NAME
        self._file = self.path.open("a+", encoding="utf-8")
        try:
            while not self._is_there():
                # Its last holder has taken it away since it was opened.
                self._file.close()
                self._file = self.path.open("a+", encoding="utf-8")
            self._file.truncate(0)
            self._file.write(f"process {os.getpid()} on {platform.node()}")
            self._file.flush()
        except BaseException:
            self._file.close()
            raise

    def _is_there(self) -> bool:
        """Locks the open file; whether it is the folder's still."""
        folder = self.path.parent
        try:
            if fcntl is not None:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EACCES):
                self._file.seek(0)
                holder = self._file.read() or "another process"
                raise ConfigError(f"{folder} is in use by {holder}; wait for it, or name another folder") from error
            log.warning("%s has no locks (%s): let one command at a time work on it", folder, error.strerror)
        return self.path.exists() and os.path.samestat(os.fstat(self._file.fileno()), self.path.stat())

    def release(self) -> None:
        """Lets go of the folder."""
        # Before the lock ends: who opened the file meanwhile finds it gone, and makes another.
        self.path.unlink(missing_ok=True)
        self._file.close()

"""Files are written whole or not at all: into a draft beside them, then moved into place."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from torch import Tensor

from apcc_torch.errors import WriteError


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

"""Files are written whole or not at all: into a draft beside them, then renamed."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from torch import Tensor


def write_atomically(path: Path | str, content: bytes | str) -> Path:
    """Writes `content` to `path` whole, creating its folder; text as UTF-8."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.{os.getpid()}.draft")
    try:
        draft.write_bytes(content.encode("utf-8") if isinstance(content, str) else content)
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)
    return path


def write_json(path: Path | str, data: Mapping[str, object]) -> Path:
    """Writes a mapping as indented JSON, keys in the order given."""
    return write_atomically(path, json.dumps(data, indent=2) + "\n")


def write_arrays(path: Path | str, arrays: Mapping[str, Tensor]) -> Path:
    """Writes tensors as one compressed NumPy archive (.npz)."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **{name: tensor.detach().cpu().numpy() for name, tensor in arrays.items()})  # type: ignore[arg-type]
    return write_atomically(path, buffer.getvalue())

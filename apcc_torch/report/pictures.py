"""Figures and films of runs as they go into a page: small, and inside it as data URIs."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import NamedTuple

from PIL import Image

from apcc_torch.errors import DataError, in_a_line

CAPTIONS = {
    "figure_7.png": "Arm and model, tip error, length, shape error (Fig. 7)",
    "figure_8.png": "Estimated rest lengths (Fig. 8)",
    "figure_9.png": "Sensor errors (Fig. 9)",
    "stroboscopic.png": "Arm and model over time",
    "shape_error.png": "Shape error (Figs. 11, 15, 17)",
    "end_effector.png": "End-effector error",
    "psi.png": "Secondary objective (Figs. 12, 18)",
    "parameters.png": "Estimated rest lengths (Fig. 13)",
    "sensors.png": "Sensor errors (Figs. 16, 19)",
    "mapping_error.png": "Actuation mismatch (Figs. 30, 34)",
    "replay.png": "Inferred shape, residuals, and what the gate held back",
}
"""Figure file -> what it shows, with the paper's number; the order in which a page shows them."""
FILMS = {".mp4": "video/mp4", ".gif": "image/gif"}
WIDEST = 1500
"""Pixels of the widest picture."""
QUALITY = 80
LARGEST = 2**25
"""Bytes of the largest picture or film that is read."""


class Picture(NamedTuple):
    """A figure, or a film, inside a page: the file's stem, what it shows, its data URI, its pixels."""

    name: str
    caption: str
    uri: str
    film: bool = False
    width: int = 0
    height: int = 0


def data_uri(content: bytes, kind: str) -> str:
    """The content as a data URI of a media type."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def picture(name: str, content: bytes) -> Picture:
    """A PNG as a picture of a page: WebP, which is a third as large.

    Raises:
        DataError: It is no picture.
    """
    try:
        image = Image.open(io.BytesIO(content)).convert("RGB")
    except Exception as error:  # Pillow raises as many kinds as there are ways to damage a picture
        raise DataError(f"{name} is no picture: {in_a_line(error)}") from error
    if image.width > WIDEST:
        image = image.resize((WIDEST, round(image.height * WIDEST / image.width)))
    buffer = io.BytesIO()
    image.save(buffer, "WEBP", quality=QUALITY, method=2)
    stem = Path(name).stem
    caption = CAPTIONS.get(name, stem.replace("_", " "))
    return Picture(stem, caption, data_uri(buffer.getvalue(), "image/webp"), False, *image.size)


def stored(folder: Path) -> list[Picture]:
    """The figures that a run left in its folder, the known ones first; empty where it left none.

    Raises:
        DataError: One of them is no picture.
    """
    rank = {name: k for k, name in enumerate(CAPTIONS)}
    paths = sorted((folder / "figures").glob("*.png"), key=lambda path: (rank.get(path.name, len(rank)), path.name))
    return [picture(path.name, _content(path)) for path in paths]


def _content(path: Path) -> bytes:
    """The file, which must not be larger than a page may be."""
    try:
        if not path.is_file() or path.stat().st_size > LARGEST:
            raise DataError(f"{path.name} is no file, or has over {LARGEST / 2**20:g} MiB")
        return path.read_bytes()
    except OSError as error:
        raise DataError(f"{path.name} cannot be read: {in_a_line(error)}") from error


def film(path: Path) -> Picture:
    """A film file as it is."""
    return Picture(path.stem, "The run as a film", data_uri(_content(path), FILMS[path.suffix]), True)


def stored_film(folder: Path) -> Picture | None:
    """The film that a run left in its folder."""
    films = [path for path in sorted((folder / "figures").glob("animation.*")) if path.suffix in FILMS]
    # An MP4 is the smaller file.
    return film(max(films, key=lambda path: path.suffix == ".mp4")) if films else None

"""Settings as text that explains them: every key with its value, and beside it source, unit and meaning."""

from __future__ import annotations

import json
from dataclasses import fields, is_dataclass
from typing import Any, cast

from apcc_torch.classes import name_of
from apcc_torch.part import part_of
from apcc_torch.reading import plain
from apcc_torch.settings import Settings, about_of

COLUMN = 44
"""Where the explanations begin, behind shorter keys."""


def explained(settings: Any, indent: str = "") -> str:
    """One line a setting, in the form of the files of conf/, groups indented.

    Args:
        settings: A dataclass, as it is to be shown.
        indent: Before every line.
    """
    lines = []
    for each in fields(settings):
        value, about = getattr(settings, each.name), about_of(each)
        if is_dataclass(value) and not isinstance(value, type):
            lines.append(_line(f"{indent}{each.name}:", [about.meaning] if about.meaning else []))
            if about.base is not None:
                lines.append(f"{indent}  kind: {name_of(part_of(cast(Settings, value)))}")
            lines.append(explained(value, indent + "  "))
        else:
            unit = about.unit + (", " if about.unit and about.meaning else "")
            words = [f"[{about.source}]", unit + about.meaning] if about.meaning or about.unit else []
            lines.append(_line(f"{indent}{each.name}: {json.dumps(plain(value), ensure_ascii=False)}", words))
    return "\n".join(line for line in lines if line)


def _line(key: str, words: list[str]) -> str:
    return f"{key:<{COLUMN}}# {' '.join(words)}" if words else key

"""What the API pages make of this package's docstrings and settings: an extension of griffe."""

from __future__ import annotations

import ast
import re
from typing import Any

from griffe import Attribute, Docstring, ExprCall, Extension, Object

ORDER = ("default", "unit", "source", "meaning")
"""The first arguments of `apcc_torch.settings.setting`."""
TOGETHER = re.compile(r"^    (\*{0,2}\w+(?:, \*{0,2}\w+)+): (.*(?:\n {8,}.*)*)", re.MULTILINE)
"""Parameters that share one line of a docstring: their names, and what is said of them."""

EXAMPLE = re.compile(r"^Example:$", re.MULTILINE)


class Docstrings(Extension):
    """Settings say what they mean, and parameters that are explained together are known one by one."""

    def on_attribute_instance(self, *, attr: Attribute, **_: Any) -> None:
        """Gives `name: float = setting(5.0, "s", OURS, "meaning")` the docstring "meaning (s)"."""
        call = attr.value
        if not isinstance(call, ExprCall) or str(call.function) != "setting":
            return
        given = {getattr(a, "name", ORDER[min(k, 3)]): getattr(a, "value", a) for k, a in enumerate(call.arguments)}
        attr.value = given.pop("default", None)
        if "meaning" not in given or attr.docstring is not None:
            return
        told = {name: text(value) for name, value in given.items() if name in ORDER}
        aside = "; ".join(filter(None, (told.get("unit"), "paper" if told.get("source") == "PAPER" else "")))
        attr.docstring = Docstring(told["meaning"] + (f" ({aside})" if aside else ""), parent=attr)

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """Writes "a, b: What they are." as a line for each, and `Example:` as griffe knows it, as code."""
        if obj.docstring is not None:
            lines = TOGETHER.sub(apart, obj.docstring.value)
            obj.docstring.value = EXAMPLE.sub("Examples:", lines)


def apart(match: re.Match[str]) -> str:
    """A line for each name of `TOGETHER`."""
    return "\n".join(f"    {name}: {match[2]}" for name in match[1].split(", "))


def text(value: Any) -> str:
    """A literal's text, or the name as it stands."""
    written = str(value)
    try:
        return str(ast.literal_eval(written))
    except (ValueError, SyntaxError):
        return written

"""What README.md and the pages in docs/ tell a reader to type: commands and Python blocks, read from the Markdown."""

from __future__ import annotations

import re
import shlex
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import apcc_torch

ROOT = Path(apcc_torch.__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]

FENCED = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"(?:^|(?<=\n\n))((?: {4}.*\n|\n(?= {4}))+)")
SPAN = re.compile(r"`([^`]+)`")
FILE = re.compile(r"\w+\.(csv|html|json|log|mcap|npz|parquet|png|py|txt|yaml)")
SHELL = ("bash", "console", "sh", "shell")


class Command(NamedTuple):
    """One of our programs with its arguments.

    page: Where it stands. program: A module of the package below its name, "simulate", or a script's path below the
    root, "benchmarks/hold.py". arguments: As the program gets them.
    """

    page: str
    program: str
    arguments: tuple[str, ...]

    @property
    def text(self) -> str:
        """On one line, as a name of it."""
        return " ".join((self.program, *self.arguments))


class Block(NamedTuple):
    """A Python block of a page. name: Its page and number there, from 1."""

    page: str
    name: str
    code: str


def name_of(page: Path) -> str:
    """A page's name in messages."""
    return page.relative_to(ROOT).as_posix()


def python_blocks(page: Path) -> list[Block]:
    """The Python blocks of a page, in order."""
    found = [body for language, body in FENCED.findall(page.read_text(encoding="utf-8")) if language == "python"]
    return [Block(name_of(page), f"{name_of(page)} {k}", body) for k, body in enumerate(found, 1)]


def commands(page: Path) -> list[Command]:
    """The commands in a page's code blocks and in the cells of its tables, each once, in order."""
    text = page.read_text(encoding="utf-8")
    # Of fenced blocks only those of a shell; their lines, and those of indented blocks, are one kind of text from here.
    shell = [body for language, body in FENCED.findall(text) if language in SHELL]
    blocks = shell + [textwrap.dedent(body) for body in INDENTED.findall(FENCED.sub("", text))]
    known = {name: value.split() for block in blocks for name, value in re.findall(r'^(\w+)="([^"]*)"', block, re.M)}
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    found = [command for line in lines for command in _of_line(page, line, known)]
    for row in re.findall(r"^\|.*\|$", text, re.M):
        found += _of_row(page, row, found)
    return list(dict.fromkeys(found))


def _of_line(page: Path, line: str, known: dict[str, list[str]]) -> Iterator[Command]:
    """The commands of a line of shell; `known` has the words of its variables."""
    if not re.search(r"-m apcc_torch\.|\bapcc-\w|python (?:benchmarks|examples)/", line):
        return  # perhaps no shell at all
    words = [part for word in shlex.split(line, comments=True) for part in known.get(word.removeprefix("$"), [word])]
    while words:
        end = words.index("&&") if "&&" in words else len(words)
        match words[:end]:
            case [python, "-m", module, *arguments] if python.endswith("python") and module.startswith("apcc_torch."):
                yield Command(name_of(page), module.removeprefix("apcc_torch."), tuple(arguments))
            case [python, script, *arguments] if python.endswith("python") and script.endswith(".py"):
                yield Command(name_of(page), script, tuple(arguments))
            case (
                [_, "uvx", "--from", ".", script, *arguments]
                | [_, "pipx", "run", "--spec", ".", script, *arguments]
                | [script, *arguments]
            ) if script.startswith("apcc-"):
                yield Command(name_of(page), script.removeprefix("apcc-").replace("-", "_"), tuple(arguments))
        words = words[end + 1 :]


def _of_row(page: Path, row: str, before: list[Command]) -> Iterator[Command]:
    """The commands in a row's first cell, where `…` stands for the last program and `hold.py` for one beside it."""
    last = next((c.program for c in reversed(before) if not c.program.endswith(".py")), "simulate")
    for span in SPAN.findall(row.split(" | ")[0]):
        line = span
        if line.startswith("… "):
            line = f"python -m apcc_torch.{last} {line[2:]}"
        elif re.fullmatch(r"\w+\.py", line):
            line = f"python {Path(last).parent}/{line}"
        for command in _of_line(page, line, {}):
            last = command.program
            yield command


def keys(page: Path) -> set[str]:
    """Dotted keys of settings that a page names, in spans of code and in what its commands set; no names of modules."""
    text = FENCED.sub("", page.read_text(encoding="utf-8"))
    spans = {span for span in SPAN.findall(text) if re.fullmatch(r"[a-z_]+(\.\w+)+(=\S*)?", span)}
    named = {span.partition("=")[0] for span in spans if not re.fullmatch(FILE, span)}
    return {key for key in named if not (ROOT / "apcc_torch" / Path(*key.split(".")[:2])).with_suffix(".py").exists()}

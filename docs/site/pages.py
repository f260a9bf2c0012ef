"""The pages of the site that no file in docs/ is: home from README.md, the API from the rooms, linked source files.

A hook of mkdocs. The Markdown stays as a code host shows it; links that leave docs/ lead to pages of the site.
"""

from __future__ import annotations

import ast
import logging
import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

log = logging.getLogger("mkdocs.hooks.pages")

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "apcc_torch"
API = "api/"
LINK = re.compile(r"(?<=\]\()(?![a-z]+:|#)([^)#\s]+)")
"""The target of a link in Markdown, up to its anchor."""
HREF = re.compile(r'href="([^":#]+\.(?:md|ipynb))(#[^"]*)?"')
"""A link of a rendered notebook, which mkdocs leaves as it is."""
ALONE = "---\nhide: [navigation]\n---\n"
"""The head of a page that has no others beside it."""
LANGUAGES = {".py": "python", ".yaml": "yaml", ".toml": "toml", ".json": "json"}


def rooms() -> list[str]:
    """Dotted names of what gets a page: the package, and every room below it that is no program."""
    below = [path for path in sorted((ROOT / PACKAGE).iterdir()) if is_package(path) or path.suffix == ".py"]
    names = [path.stem for path in below if not path.stem.startswith("__") and not is_program(path)]
    return [PACKAGE, *(f"{PACKAGE}.{name}" for name in names)]


def is_package(path: Path) -> bool:
    """Whether a folder holds modules."""
    return (path / "__init__.py").is_file()


def is_program(path: Path) -> bool:
    """Whether a module is started, not imported."""
    return path.is_file() and any(getattr(node, "name", "") == "main" for node in tree(path).body)


def tree(path: Path) -> ast.Module:
    """A module's source, or that of a package's own module."""
    return ast.parse((path / "__init__.py" if path.is_dir() else path).read_text(encoding="utf-8"))


def offered(name: str) -> dict[str, str] | None:
    """What a package says in `__all__` that it offers: each name with the dotted path where it is defined.

    None where it says nothing. The path matters where a function has the name of its module.
    """
    body = tree(path_of(name)).body
    assigned = {ast.unparse(node.targets[0]): node.value for node in body if isinstance(node, ast.Assign)}
    if "__all__" not in assigned:
        return None
    imported = {
        alias.asname or alias.name: f"{node.module}.{alias.name}"
        for node in body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    return {each: imported[each] for each in ast.literal_eval(assigned["__all__"]) if each in imported}


def path_of(name: str) -> Path:
    """The folder or file of a module."""
    path = ROOT / Path(*name.split("."))
    return path if path.is_dir() else path.with_suffix(".py")


def front_page() -> str:
    """The Markdown of the package's own page: its names, each with what it is and a link to more."""
    names = {**(offered(PACKAGE) or {}), "compose": f"{PACKAGE}.composed.compose"}
    lines = [f"- [`{name}`][{names[name]}]: {first_line(names[name])}" for name in sorted(names, key=str.lower)]
    text = ast.get_docstring(tree(ROOT / PACKAGE)) or ""
    return "\n\n".join([f"# {PACKAGE}", text, f"## `from {PACKAGE} import ...`", "\n".join(lines)])


def first_line(at: str) -> str:
    """The first line of the docstring of a class or function."""
    module, _, name = at.rpartition(".")
    node = next(node for node in tree(path_of(module)).body if getattr(node, "name", "") == name)
    assert isinstance(node, ast.ClassDef | ast.FunctionDef)
    return (ast.get_docstring(node) or "").partition("\n")[0]


def api_page(room: str) -> str:
    """The Markdown of a room's page: what it exports, else all that its modules hold."""
    return f"# {room}\n\n" + "\n".join(sections(room, 2))


def sections(name: str, level: int) -> Iterator[str]:
    """What a module offers; of a package that exports no names, what its modules do."""
    names = offered(name) if path_of(name).is_dir() else None
    yield shown(name, level, members=names is None)
    if names is not None:
        for at in names.values():
            yield shown(at, level, heading=True)
    elif path_of(name).is_dir():
        for path in sorted(path_of(name).iterdir()):
            if is_package(path) or (path.suffix == ".py" and not path.stem.startswith("__") and not is_program(path)):
                yield f"{'#' * level} {path.stem}\n"
                yield from sections(f"{name}.{path.stem}", level + 1)


def shown(name: str, level: int, *, heading: bool = False, members: bool = True) -> str:
    """The place of a name's docstring, and of its members'."""
    options = {"heading_level": level, "show_root_heading": heading, "show_root_toc_entry": heading}
    lines = [f"      {key}: {str(value).lower()}" for key, value in options.items()]
    return "\n".join([f"::: {name}", "    options:", *lines, *([] if members else ["      members: false"]), ""])


def source_page(path: Path) -> str:
    """A file of the repository as a page."""
    body = path.read_text(encoding="utf-8").rstrip()
    return f"# {path.relative_to(ROOT).as_posix()}\n\n~~~~{LANGUAGES.get(path.suffix, 'text')}\n{body}\n~~~~\n"


def turned(text: str, where: str, linked: set[str]) -> str:
    """A page's Markdown with every link out of docs/ turned to a page of the site.

    where: The page's folder in the repository, "docs" or "". linked: Gets the repository's files that need a page.
    """

    def turn(match: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(where, match[1]))
        path = ROOT / target
        if not path.exists():
            return match[1]  # mkdocs says so where it is a link
        if target == "README.md":
            return "index.md"
        if target.startswith("docs/"):
            return target.removeprefix("docs/")
        if path.is_dir() and is_package(path):
            return f"{API}{target.replace('/', '.')}.md"
        linked.add(target)
        return f"source/{target}.md"

    return LINK.sub(turn, text)


def on_config(config: Any) -> Any:
    """Puts the API's pages where the navigation names their folder."""
    pages = [{name: f"{API}{name}.md"} for name in rooms()]
    config.nav = [{title: pages if to == API else to} for entry in config.nav for title, to in entry.items()]
    return config


def on_files(files: Files, config: Any) -> Files:
    """Adds home, the API and the files that a page links to."""
    linked: set[str] = set()
    made = {"index.md": ALONE + turned((ROOT / "README.md").read_text(encoding="utf-8"), "", linked)}
    made |= {f"{API}{name}.md": front_page() if name == PACKAGE else api_page(name) for name in rooms()}
    for file in files.documentation_pages():
        if file.src_uri.endswith(".md"):
            where = posixpath.join("docs", posixpath.dirname(file.src_uri))
            file.content_string = turned(file.content_string, where, linked)
    made |= {f"source/{name}.md": source_page(ROOT / name) for name in sorted(linked)}
    for uri, content in made.items():
        file = File.generated(config, uri, content=content)
        if uri.startswith("source/"):
            file.inclusion = InclusionLevel.NOT_IN_NAV
        files.append(file)
    return files


def on_page_content(html: str, page: Page, config: Any, files: Files) -> str:
    """Turns a notebook's links between pages to the pages of the site."""

    def turn(match: re.Match[str]) -> str:
        here = page.file.src_uri
        file = files.get_file_from_path(posixpath.normpath(posixpath.join(posixpath.dirname(here), match[1])))
        if file is None:
            log.warning("%s: the link to %s leads nowhere", here, match[1])
            return match[0]
        return f'href="{file.url_relative_to(page.file)}{match[2] or ""}"'

    return HREF.sub(turn, html) if page.file.src_uri.endswith(".ipynb") else html

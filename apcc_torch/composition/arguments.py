"""A command line of options, which is refused in one sentence as those of settings are."""

from __future__ import annotations

import argparse
import itertools
import re
from collections.abc import Iterator, Sequence
from typing import NoReturn, Self

from apcc_torch.settings import did_you_mean

WITH_VALUE = {
    *("-cd", "--config-dir", "-cp", "--config-path", "-cn", "--config-name"),
    *("-c", "--cfg", "-p", "--package", "--experimental-rerun"),
}
"""Options of hydra's that a word follows."""


def options_first(words: Sequence[str]) -> list[str]:
    """A command line as hydra takes it, which wants all of its KEY=VALUE in one piece: options stand before them.

    Example:
        >>> options_first(["experiment=mine", "-cd", "conf", "seed=1", "-m"])
        ['-cd', 'conf', '-m', 'experiment=mine', 'seed=1']
    """
    options: list[str] = []
    others: list[str] = []
    rest = iter(words)
    for word in rest:
        if word in WITH_VALUE:
            options += [word, *itertools.islice(rest, 1)]
        else:
            (options if word.startswith("-") else others).append(word)
    return [*options, *others]


class Arguments(argparse.ArgumentParser):
    """argparse's parser without its page of usage where a word is wrong."""

    @classmethod
    def described(cls, program: str, description: str | None, manual: str) -> Self:
        """The parser of `python -m apcc_torch.PROGRAM`, whose help ends with a manual, as it stands."""
        return cls(
            prog=f"python -m apcc_torch.{program}",
            description=description,
            epilog=manual,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )

    def error(self, message: str) -> NoReturn:
        """Ends the program with exit code 2 and one sentence."""
        unknown = re.match(r"unrecognized arguments: ([^\s=]+)", message)
        choice = re.search(r"invalid choice: '?([^' ]*)'? \(choose from (.*)\)", message)
        if unknown is not None:
            message = f"there is no argument {unknown[1]}{did_you_mean(unknown[1], self._options())}"
        elif choice is not None:
            names = choice[2].replace("'", "").split(", ")
            message = f"there is no {choice[1]}{did_you_mean(choice[1], names)}"
        self.exit(2, f"{self.prog}: {message}\n")

    def _options(self) -> Iterator[str]:
        for action in self._actions:
            yield from (name for name in action.option_strings if name.startswith("--"))
            if isinstance(action, argparse._SubParsersAction):
                for parser in action.choices.values():
                    yield from parser._options()

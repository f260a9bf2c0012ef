"""A command line of options, which is refused in one sentence as those of settings are."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from typing import NoReturn

from apcc_torch.settings import did_you_mean


class Arguments(argparse.ArgumentParser):
    """argparse's parser without its page of usage where a word is wrong."""

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

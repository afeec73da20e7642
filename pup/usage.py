"""Command lines whose mistakes are told in one line."""

import argparse
from typing import NoReturn

REFUSED = 2


class Usage(argparse.ArgumentParser):
    """A parser that says what is wrong, and where the options are told, instead of all of them."""

    def error(self, message: str) -> NoReturn:
        """See argparse; ends the process with 2."""
        self.exit(REFUSED, f"{self.prog}: {message}; see {self.prog} --help\n")

"""Names of studies, agents and tokens, in files and in paths."""

import re

from starlette.convertors import Convertor, register_url_convertor

PATTERN = "[A-Za-z0-9][A-Za-z0-9_.-]{0,62}"
WHOLE = f"^{PATTERN}$"


class _Name(Convertor[str]):
    """A name in a path, which ends before the colon of an action."""

    regex = PATTERN

    def convert(self, value: str) -> str:
        return value

    def to_string(self, value: str) -> str:
        return value


register_url_convertor("name", _Name())


def is_name(text: str) -> bool:
    """Whether a text is a name."""
    return re.fullmatch(PATTERN, text) is not None

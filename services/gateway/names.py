"""Names of studies, agents and tokens, in files and in paths."""

import re

from starlette.convertors import Convertor, register_url_convertor

from pup.wire import NAME

WHOLE = f"^{NAME}$"


class _Name(Convertor[str]):
    """A name in a path, which ends before the colon of an action."""

    regex = NAME

    def convert(self, value: str) -> str:
        return value

    def to_string(self, value: str) -> str:
        return value


register_url_convertor("name", _Name())


def is_name(text: str) -> bool:
    """Whether a text is a name."""
    return re.fullmatch(NAME, text) is not None

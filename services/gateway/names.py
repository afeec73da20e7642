"""Names of studies, agents and tokens, in files and in paths; numbers in paths."""

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


class _Nth(Convertor[int]):
    """The number of a trial: not one so long that Python would not read it."""

    regex = "[0-9]{1,9}"

    def convert(self, value: str) -> int:
        return int(value)

    def to_string(self, value: int) -> str:
        return str(value)


register_url_convertor("name", _Name())
register_url_convertor("nth", _Nth())


def is_name(text: str) -> bool:
    """Whether a text is a name."""
    return re.fullmatch(NAME, text) is not None

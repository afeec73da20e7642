"""A stop that a library swallows is not forgotten."""

import signal
from collections.abc import Iterator

import pytest

from services import stopping


@pytest.fixture
def answered() -> Iterator[None]:
    usual = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)}
    stopping.begin()
    yield
    for number, answer in usual.items():
        signal.signal(number, answer)


class Finalised:
    """Gone while a signal arrives: what is raised in a finaliser is printed and forgotten."""

    def __del__(self) -> None:
        signal.raise_signal(signal.SIGTERM)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_where_it_arrives(answered: None, number: int) -> None:
    stopping.check()
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(number)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_signal_that_was_swallowed_stops_the_next_one_who_asks(answered: None) -> None:
    Finalised()
    with pytest.raises(KeyboardInterrupt):
        stopping.check()
    stopping.begin()
    stopping.check()  # the next job knows nothing of it

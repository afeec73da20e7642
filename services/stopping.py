"""Ctrl-C and SIGTERM: raised where they arrive, and remembered.

An exception that a signal raises is lost where a library catches everything, or in a finaliser,
which prints it and goes on. Whoever works for long asks now and then whether that has happened.
"""

import signal
from types import FrameType


class _Answer:
    """The answer to both signals."""

    def __init__(self) -> None:
        self.asked = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        self.asked = True
        signal.default_int_handler(number, frame)


_answer = _Answer()


def begin() -> None:
    """Answer SIGTERM as Ctrl-C, also in the background, where a shell has Ctrl-C ignored."""
    _answer.asked = False
    signal.signal(signal.SIGTERM, _answer)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _answer)


def check() -> None:
    """Stop, if that has been asked for.

    Raises:
      KeyboardInterrupt: it has.
    """
    if _answer.asked:
        raise KeyboardInterrupt

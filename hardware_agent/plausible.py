"""Readings that cannot be true.

The checksum of Protocol 1.0 is a byte: of the packets that noise spoils, one in 256 passes it.
"""

import math

TURN = 2 * math.pi  # rad, beyond which no joint of a servo in joint mode is
JUMP = 0.2  # rad, in no time: a tick of lock-step passes in less of this computer's time
FASTEST = 6.0  # rad/s, of an MX-28 without load at 12 V (e-manual: 55 rev/min)


class Plausible:
    """Which positions are believed.

    One that is too far from the last to have been reached meanwhile is doubted, and believed when
    the next answer agrees: a joint may have been struck, and a first reading wrong.
    """

    def __init__(self) -> None:
        self._believed: dict[int, tuple[float, float]] = {}
        self._doubted: dict[int, tuple[float, float]] = {}

    def believes(self, name: int, position: float, now: float) -> bool:
        """Whether a reading is to be believed.

        Args:
          name: the servo's id.
          position: rad.
          now: s.
        """
        if abs(position) > TURN:
            return False
        told = (now, position)
        known, doubted = self._believed.get(name), self._doubted.pop(name, None)
        if known is None or _reached(known, told) or (doubted and _reached(doubted, told)):
            self._believed[name] = told
            return True
        self._doubted[name] = told
        return False


def _reached(before: tuple[float, float], told: tuple[float, float]) -> bool:
    return abs(told[1] - before[1]) <= JUMP + FASTEST * (told[0] - before[0])

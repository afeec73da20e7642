"""What encoders and the IMU tell, where it is not what is."""

import numpy as np
from numpy.typing import NDArray

from pup.physics.rotations import CONJUGATE, multiply, rotation
from pup.physics.terms import kernels
from pup.physics.terms.base import Parts, Quantity, Term

Array = NDArray[np.float64]


class EncoderBias(Term):
    """The encoder's zero is off: what it tells is the position plus this."""

    effect = "encoder_bias"
    constant = True
    kinds = ("joint",)
    quantities = (Quantity("offset", "rad", 0.02, 0.3, signed=True),)
    source = "estimate: 5 to 50 mrad after reassembly"

    def start(self, position: Array, torso: Array) -> None:
        """See Term: what was read first has the bias in it."""
        position -= self.values["offset"]

    def sense(self, position: Array, velocity: Array) -> tuple[Array, Array]:
        """See Term."""
        told = position.copy()
        kernels.shift(told, *self.parts())
        return told, velocity

    def parts(self) -> Parts:
        """See Term."""
        return (self.values["offset"],)


class EncoderEccentricity(Term):
    """The encoder's magnet is off centre: an error with a period of one turn."""

    effect = "encoder_eccentricity"
    kinds = ("joint",)
    quantities = (
        Quantity("sine", "rad", 0.01, 0.1, signed=True),
        Quantity("cosine", "rad", 0.01, 0.1, signed=True),
    )
    source = "estimate: 5 to 12 mrad"

    def prepare(self) -> None:
        """See Term."""
        self._periods = np.ones_like(self.values["sine"])

    def parts(self) -> Parts:
        """See Term."""
        return self.values["sine"], self.values["cosine"], self._periods

    def start(self, position: Array, torso: Array) -> None:
        """See Term."""
        nearly = 2 * position - self._told(position)
        position += nearly - self._told(nearly)

    def sense(self, position: Array, velocity: Array) -> tuple[Array, Array]:
        """See Term."""
        return self._told(position), velocity

    def _told(self, position: Array) -> Array:
        told = position.copy()
        kernels.ripple(told, position, *self.parts())
        return told


class MeasurementDelay(Term):
    """Positions are read earlier than their rows say; the servo's own loop is not late."""

    effect = "measurement_delay"
    constant = True
    kinds = ("joint", "group", "bus")
    quantities = (Quantity("time", "s", 0.01, 0.06),)
    source = "reading 20 servos one after the other takes 10 ms (paper, section III)"

    def delay(self) -> Array:
        """See Term."""
        return self.values["time"]


class ScanDelay(Term):
    """Servos are read one after the other, in the order of the joints, or from the last to first.

    A row holds the first one's position of a moment ago, and the last one's of the whole scan ago;
    where the time is negative it is the other way round.
    """

    effect = "scan_delay"
    constant = True
    kinds = ("bus",)
    quantities = (Quantity("time", "s", 0.01, 0.06, signed=True),)
    source = "reading 20 servos one after the other takes 10 ms (paper, section III)"

    def delay(self) -> Array:
        """See Term."""
        time = self.values["time"]
        share = np.arange(1, time.shape[1] + 1) / time.shape[1]
        return np.asarray(np.abs(time) * np.where(time > 0, share, share[::-1]))


class ImuMisalignment(Term):
    """The IMU is mounted with a turn against its site."""

    effect = "imu_misalignment"
    constant = True
    kinds = ("sensor",)
    layout = "one"
    quantities = (
        Quantity("roll", "rad", 0.03, 0.4, signed=True),
        Quantity("pitch", "rad", 0.03, 0.4, signed=True),
        Quantity("yaw", "rad", 0.05, 0.6, signed=True),
    )
    source = "the paper randomises the orientation by 0.3 rad (section VI)"

    def prepare(self) -> None:
        """See Term."""
        self._mount = rotation(np.hstack([self.values[a] for a in ("roll", "pitch", "yaw")]))

    def start(self, position: Array, torso: Array) -> None:
        """See Term: what was read first was read askew."""
        torso[:] = multiply(torso, self._mount * CONJUGATE)

    def tilt(self, quaternion: Array, rows: NDArray[np.int64]) -> Array:
        """See Term."""
        return multiply(quaternion, self._mount[rows])


class ImuDelay(Term):
    """The IMU's angles are older than their rows say."""

    effect = "imu_delay"
    constant = True
    kinds = ("sensor",)
    layout = "one"
    quantities = (Quantity("time", "s", 0.02, 0.1),)
    source = "estimate: 10 to 30 ms of fusion filter"

    def tilt_delay(self) -> Array:
        """See Term."""
        return self.values["time"]

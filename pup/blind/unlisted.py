"""Physics that the contract's list of effects does not have."""

import zlib

import numpy as np

from pup.blind.parts import Moment, Part
from pup.blind.world import Array

DITHER = 0.01  # s, one sweep of a driver's dither
SWEEP = 0.7  # of a level, how far it sweeps
ONSET = 0.3  # s, over which a changing friction changes


class AgeingFriction(Part):
    """Contacts that grow while they rest and are renewed as they slide (Dieterich and Ruina)."""

    def begin(self) -> None:
        """Rested for a while."""
        self.age = np.full(self.lanes, 0.5)

    def hold(self, now: Moment) -> None:
        """Grip by the age."""
        step = self.stage.step
        rate = np.abs(now.speed[self.at]) / self.shape["slip"]
        self.age = (self.age + step) / (1.0 + step * rate)
        grown = np.log1p(self.age / self.shape["young"])
        now.grip[self.at] += self.size * (0.4 + self.shape["growth"] * grown)


class HystereticGain(Part):
    """A stiffness that depends on whether the error grows or shrinks."""

    def begin(self) -> None:
        """No error remembered."""
        self.remembered = np.zeros(self.lanes)

    def command(self, now: Moment) -> None:
        """Weaken what shrinks."""
        error, width = now.error[self.at], self.shape["width"]
        self.remembered = np.clip(self.remembered, error - width, error + width)
        shrinking = 0.5 * (1.0 - np.sign(error) * (error - self.remembered) / width)
        now.duty[self.at] *= 1.0 - self.size * shrinking


class StickEvents(Part):
    """Now and then the joint catches for a moment."""

    def begin(self) -> None:
        """Draw when."""
        self.caught = [self._events(plan.id, float(plan.time[-1])) for plan in self.stage.plans]

    def _events(self, name: str, end: float) -> Array:
        rng = np.random.default_rng([self.stage.seed, zlib.crc32(name.encode())])
        starts = np.cumsum(rng.exponential(self.shape["every"], size=40)) + 0.2
        starts = starts[starts < end]
        return np.stack([starts, starts + rng.uniform(0.15, 0.45, size=len(starts))], axis=1)

    def hold(self, now: Moment) -> None:
        """Grip while caught."""
        for plan, events in enumerate(self.caught):
            if ((events[:, 0] <= now.time) & (now.time < events[:, 1])).any():
                now.grip[:, plan, self.at[1]] += self.size


class QuantisedTorque(Part):
    """A driver with few levels and a dither."""

    def command(self, now: Moment) -> None:
        """Round the duty, the mean over a kick as the dither sweeps on."""
        duty = now.duty[self.at] / self.size + SWEEP * ((now.time / DITHER) % 1.0 - 0.5)
        half = SWEEP * self.stage.step / DITHER / 2
        swept = _stairs(duty + half) - _stairs(duty - half)
        now.duty[self.at] = self.size * swept / (2 * half)


class SpeedDependentGain(Part):
    """A firmware that schedules its stiffness by the speed."""

    def command(self, now: Moment) -> None:
        """Scale by the speed."""
        fast = np.tanh(np.abs(now.speed[self.at]) / self.shape["speed"])
        now.duty[self.at] *= 1.0 + self.size * fast


class FrictionStep(Part):
    """Dry friction that sets in while the robot runs."""

    def hold(self, now: Moment) -> None:
        """Grip from then on."""
        since = (now.time - self.shape["onset"]) / ONSET
        now.grip[self.at] += self.size / (1.0 + np.exp(-np.clip(4.0 * since, -30.0, 30.0)))


class DerivativeOfError(Part):
    """A derivative gain on the filtered error, which commands kick (Åström and Hägglund)."""

    def begin(self) -> None:
        """Filtered from the first error on."""
        self.filtered = np.full(self.lanes, np.nan)
        self.share = -np.expm1(-self.stage.step / self.shape["filter"])

    def command(self, now: Moment) -> None:
        """Add the filtered error's change, the mean over a kick in which the error stays."""
        error = now.error[self.at]
        if np.isnan(self.filtered).any():
            self.filtered = error
        change = self.share * (error - self.filtered)
        self.filtered = self.filtered + change
        now.duty[self.at] += self.size * change / self.stage.step


class RelaxingHarness(Part):
    """Cables and covers that yield when held bent: a spring and a dashpot in series (Maxwell)."""

    def begin(self) -> None:
        """Rested."""
        self.bent = np.zeros(self.lanes)
        self.kept = np.exp(-self.stage.step / self.shape["time"])

    def resist(self, now: Moment) -> None:
        """Pull back, the mean over a kick."""
        before = self.bent
        way = self.shape["time"] * (1.0 - self.kept) * now.speed[self.at]
        self.bent = self.kept * before + way
        now.passive[self.at] -= self.size * 0.5 * (before + self.bent)


def _stairs(height: Array) -> Array:
    """The integral of rounding, from zero."""
    level = np.round(height)
    return np.asarray(level * height - level**2 / 2)


FORMS: dict[str, type[Part]] = {
    "ageing_friction": AgeingFriction,
    "hysteretic_gain": HystereticGain,
    "stick_events": StickEvents,
    "quantised_torque": QuantisedTorque,
    "speed_dependent_gain": SpeedDependentGain,
    "friction_step": FrictionStep,
    "derivative_of_error": DerivativeOfError,
    "relaxing_harness": RelaxingHarness,
}
"""By the form of an effect named `unknown`."""

"""Motor, supply and firmware: what makes a servo's torque other than the nominal law's."""

import numpy as np

from pup.blind.parts import Moment, Part

KNEE = 0.15  # roundness of a dead band's shoulders, share of its width
CLAMP = 0.3  # of the torque limit, the most that an integrator builds up
FEELS = 0.004  # rad of error within which an asymmetric gain changes over
WARM = 0.15  # of the torque limit, the load that heats a motor by one unit


class DeadBand(Part):
    """Small errors count as none."""

    def sense(self, now: Moment) -> None:
        """Take the band off the error."""
        error = now.error[self.at]
        past = np.abs(error) - self.size
        now.error[self.at] = (
            np.sign(error) * 0.5 * (past + np.sqrt(past**2 + (KNEE * self.size) ** 2))
        )


class GainAsymmetry(Part):
    """Another stiffness for errors of either sign."""

    def command(self, now: Moment) -> None:
        """Scale the duty by its sign."""
        now.duty[self.at] *= 1.0 + self.size * np.tanh(now.error[self.at] / FEELS)


class TorqueSpeedLimit(Part):
    """A motor at its supply's limit: back-EMF takes its share of the stall torque."""

    def command(self, now: Moment) -> None:
        """Tilt the limits by the speed."""
        taken = self.size * now.speed[self.at]
        now.high[self.at] -= taken
        now.low[self.at] -= taken


class ActuatorLag(Part):
    """Current loop and winding, one after the other."""

    def begin(self) -> None:
        """Both start at the first duty; the mean delay of each is exact at any step."""
        self.share = self.stage.step / (self.stage.step + self.size / 2)
        self.first = self.second = np.full(self.lanes, np.nan)

    def command(self, now: Moment) -> None:
        """Delay the duty, within what the supply can give against the back-EMF.

        These are the limits of the nominal law, so that without a lag it is the nominal one.
        """
        taken = now.loss[self.at] * now.speed[self.at]
        duty = np.clip(now.duty[self.at], now.low[self.at] + taken, now.high[self.at] + taken)
        if np.isnan(self.first).any():
            self.first = self.second = duty
        self.first = self.first + self.share * (duty - self.first)
        self.second = self.second + self.share * (self.first - self.second)
        now.duty[self.at] = self.second


class IntegralAction(Part):
    """A firmware's integral gain, with a clamp."""

    def begin(self) -> None:
        """Nothing has built up."""
        self.built = np.zeros(self.lanes)
        self.rate = self.size * self.stage.step
        self.most = CLAMP * self.stage.tau_max[self.at]

    def command(self, now: Moment) -> None:
        """Add what has built up."""
        self.built = np.clip(self.built + self.rate * now.error[self.at], -self.most, self.most)
        now.duty[self.at] += self.built


class VoltageSag(Part):
    """All servos draw on one supply with a resistance and a capacitor."""

    def begin(self) -> None:
        """No load yet."""
        self.sag = np.zeros((*self.lanes[:2], 1))
        self.share = -np.expm1(-self.stage.step / self.shape["buffer"])

    def command(self, now: Moment) -> None:
        """Lower the voltage by what all servos draw."""
        current = self.shape["draw"] * np.abs(now.drive).sum(axis=-1, keepdims=True)
        self.sag = self.sag + self.share * (self.size * current / self.stage.supply - self.sag)
        left = np.maximum(1.0 - self.sag, 0.3)
        now.duty *= left
        now.low *= left
        now.high *= left


class ThermalDrift(Part):
    """Torque falls with run time: a battery that empties or a winding that heats up."""

    def begin(self) -> None:
        """Fresh and cold."""
        self.heat = np.zeros(self.lanes)
        self.full = WARM * self.stage.tau_max[self.at]

    def command(self, now: Moment) -> None:
        """Weaken the motor."""
        if now.time <= 0:
            return
        if self.form == "battery":
            left = 1.0 + self.size * np.expm1(-now.time / self.shape["time"])
        else:
            load = np.minimum((now.drive[self.at] / self.full) ** 2, 4.0)
            self.heat += self.stage.step / self.shape["time"] * (load - self.heat)
            left = 1.0 / (1.0 + self.size * self.heat)
            now.loss[self.at] *= left
        now.duty[self.at] *= left
        now.low[self.at] *= left
        now.high[self.at] *= left


PARTS: dict[str, type[Part]] = {
    "dead_band": DeadBand,
    "gain_asymmetry": GainAsymmetry,
    "torque_speed_limit": TorqueSpeedLimit,
    "integral_action": IntegralAction,
    "voltage_sag": VoltageSag,
    "thermal_drift": ThermalDrift,
    "actuator_lag": ActuatorLag,
}
"""In the order in which they act: a lag is of what supply and heat leave."""

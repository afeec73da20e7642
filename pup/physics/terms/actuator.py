"""What a servo does beside its law: limits, losses and controllers nobody wrote down."""

import numpy as np
from numpy.typing import NDArray

from pup.physics.terms import kernels
from pup.physics.terms.base import Drive, Flow, Outcome, Parts, Quantity, Term

Array = NDArray[np.float64]


class QuadraticDamping(Term):
    """A torque that brakes with the square of the speed."""

    effect = "quadratic_damping"
    quantities = (Quantity("coefficient", "N m s2/rad2", 0.04, 0.5),)
    source = "estimate: 0.03 to 0.1"

    def parts(self) -> Parts:
        """See Term."""
        return (self.values["coefficient"],)

    def flow(self, flow: Flow) -> None:
        """See Term."""
        kernels.drag(flow.damping, flow.velocity, *self.parts())


class TorqueSpeedLimit(Term):
    """A motor's largest torque falls with its speed: back-EMF eats the voltage.

    Against the motion it adds to the voltage, and a servo brakes harder than it starts.
    """

    effect = "torque_speed_limit"
    quantities = (Quantity("slope", "N m s/rad", 0.2, 1.5),)
    source = "MX-28 e-manual: 2.5 N m at rest, 55 rpm free: 0.43 N m s/rad"

    def parts(self) -> Parts:
        """See Term."""
        return (self.values["slope"],)

    def drive(self, drive: Drive) -> None:
        """See Term."""
        kernels.outrun(drive.upper, drive.lower, drive.slope, drive.velocity, *self.parts())


class ActuatorLag(Term):
    """What drives the servo follows what the law asks for with a time constant, or two of half.

    The law's damping is the motor's own, back-EMF and grease, and does not wait. Nor does a torque
    that is switched off or on: it is the controller that lags, and goes on while it is off.
    """

    effect = "actuator_lag"
    quantities = (
        Quantity("time", "s", 0.008, 0.06),
        Quantity("stages", "1", 1.0, 2.0, grid=(1.0, 2.0)),
    )
    source = "estimate: 5 to 15 ms of current loop and filters"
    starts = (0.6, 1.2, 2.0)
    needs_law_damping = True
    state = ("_lagging", "_asked", "_ahead", "_lagging_more", "_asked_more", "_ahead_more")

    def prepare(self) -> None:
        """See Term."""
        two = self.values["stages"] > 1.5
        self._time = self.values["time"] / np.where(two, 2, 1)
        self._more = np.where(two, self._time, 0.0)
        steps = self.scene.timestep / np.maximum(self._time, 1e-9)
        self._kept = np.exp(-steps)
        self._share = 1 - (1 - self._kept) / steps
        self._lagging = np.full_like(steps, np.nan)
        self._lagging_more = np.where(two, np.nan, 0.0)
        self._asked, self._ahead, self._asked_more, self._ahead_more = np.zeros((4, *steps.shape))
        self._step = self.scene.steps()

    def parts(self) -> Parts:
        """See Term: of both stages alike, then of the first, and of the second."""
        both = self.scene.inertia, self._step, self._kept, self._share
        first = self._time, self._lagging, self._asked, self._ahead
        second = self._more, self._lagging_more, self._asked_more, self._ahead_more
        return (*both, *first, *second)

    def flow(self, flow: Flow) -> None:
        """See Term: what is applied is the mean over the sub-step.

        A part of it is what is asked for now, the rest what was, less the damping that is now.
        """
        law, told = flow.law_damping, self.parts()
        assert law is not None
        both = flow.torque, flow.damping, flow.velocity, law, *told[:4]
        kernels.lag(*both, *told[4:8])
        if self._more.any():
            kernels.lag(*both, *told[8:])


class VoltageSag(Term):
    """Gains and limits of all servos fall with the torque that all of them give together.

    What the supply's capacitors hold makes up for it at first.
    """

    effect = "voltage_sag"
    kinds = ("bus",)
    quantities = (
        Quantity("drop", "1/(N m)", 0.03, 0.5),
        Quantity("buffer", "s", 0.02, 0.2, grid=(0.003, 0.02, 0.08)),
    )
    source = "estimate: 5 to 15 % under the load of several joints; 1 to 5 mF behind some ohms"
    state = ("_left",)

    def prepare(self) -> None:
        """See Term."""
        self._left = np.ones_like(self.values["drop"])
        self._kept = np.exp(-self.scene.timestep / np.maximum(self.values["buffer"], 1e-9))

    def parts(self) -> Parts:
        """See Term."""
        return self._left, self.values["drop"], self._kept

    def drive(self, drive: Drive) -> None:
        """See Term."""
        kernels.dim(drive.torque, drive.upper, drive.lower, self._left)

    def settle(self, outcome: Outcome) -> None:
        """See Term."""
        left, *fixed = self.parts()
        kernels.sag(left, outcome.torque, *fixed)


class ThermalDrift(Term):
    """A servo weakens as it runs: a battery in the course of time, a motor by what it carries.

    What weakens it grows with time, or with the torque's share of the limit, and is forgotten
    again. A battery that sags takes gain and limit; a warm winding the damping too, whose
    resistance divides all of them.
    """

    effect = "thermal_drift"
    quantities = (
        Quantity("rate", "1/s", 0.005, 1.0, signed=True),
        Quantity("time", "s", 40.0, 1000.0, grid=(5.0, 40.0)),
        Quantity("load", "1", 0.0, 1.0, grid=(0.0, 1.0)),
    )
    source = "a 3S battery from 12.6 to 10.5 V loses 17 %, copper at +50 K 20 %"
    state = ("_warmth",)

    def prepare(self) -> None:
        """See Term."""
        self._warmth = np.zeros_like(self.values["rate"])
        self._heat = self.values["load"] / self.scene.limit
        step = self.scene.timestep
        self._cooling = step / np.maximum(self.values["time"], step)
        self._step = self.scene.steps()

    def parts(self) -> Parts:
        """See Term."""
        rate, load = self.values["rate"], self.values["load"]
        return self._warmth, rate, load, self._heat, self._cooling, self._step

    def drive(self, drive: Drive) -> None:
        """See Term."""
        kernels.weaken(drive.torque, drive.damping, drive.upper, drive.lower, *self.parts()[:3])

    def settle(self, outcome: Outcome) -> None:
        """See Term: nothing warms before the recording begins."""
        if np.min(outcome.time) >= 0:  # where simulations have times of their own, none is before
            warmth, _, *fixed = self.parts()
            kernels.warm(warmth, outcome.torque, *fixed)


class GainAsymmetry(Term):
    """A stiffer pull in one direction; positive is stiffer for positive errors."""

    effect = "gain_asymmetry"
    kinds = ("joint",)
    quantities = (Quantity("share", "1", 0.06, 0.5, signed=True),)
    source = "SO-101 servos: 6 to 8 % by our own fits of real recordings"

    def parts(self) -> Parts:
        """See Term."""
        return (self.values["share"],)

    def drive(self, drive: Drive) -> None:
        """See Term."""
        kernels.favour(drive.torque, drive.error, *self.parts())


SAG = 1.5
"""Of the load that gravity is, at the start: what more a joint needs is no sag but a command."""
WEAK = 0.02
"""An integral gain far below takes longer than anyone waits to take up a load, N m/(rad s)."""


class IntegralAction(Term):
    """A controller's integral part, kept within a share of the servo's limit.

    Within it the integral grows also while the servo is at its limit (it winds up). While the
    torque is off it is forgotten, or is `lasting`: the controller goes on, as one on a computer
    beside the servo may.
    """

    effect = "integral_action"
    quantities = (
        Quantity("gain", "N m/(rad s)", 15.0, 300.0),
        Quantity("share", "1", 0.3, 1.0, grid=(0.1, 0.3, 1.0)),
        Quantity("lasting", "1", 0.0, 1.0, grid=(0.0, 1.0)),
    )
    source = "estimate: an integral gain that takes a second to double the proportional part"
    state = ("_sum",)

    def prepare(self) -> None:
        """See Term."""
        self._sum = np.zeros_like(self.values["gain"])
        self._most = self.values["share"] * self.scene.limit / np.maximum(self.values["gain"], 1e-9)
        self._least = -self._most
        self._step = self.scene.steps()

    def parts(self) -> Parts:
        """See Term."""
        gain, lasting = self.values["gain"], self.values["lasting"]
        return gain, self._sum, lasting, self._least, self._most, self._step

    def held(self, load: Array, gravity: Array) -> Array:
        """See Term: a controller that has held a load for long starts with it in its integral.

        A command that jumps at the start asks for more than any load: of that it knows nothing.
        """
        sags = (np.abs(load) < SAG * np.abs(gravity)) & (self.values["gain"] > 0)
        own = np.where(sags, load, 0.0)
        self._sum += own / (self.values["gain"] + WEAK)
        return load - own

    def drive(self, drive: Drive) -> None:
        """See Term."""
        gain, total, _, *fixed = self.parts()
        kernels.integrate(drive.torque, drive.error, gain, total, *fixed)

    def settle(self, outcome: Outcome) -> None:
        """See Term: a servo whose torque is off may forget its integral."""
        _, total, *fixed = self.parts()
        kernels.add_up(total, outcome.error, np.atleast_2d(outcome.on), *fixed)


class DerivativeKick(Term):
    """A derivative part that acts on the error: a command that changes drives the servo ahead.

    The nominal law damps the velocity alone. A controller that differentiates its error adds the
    rate of the command, filtered as it takes differences: each step of the command is a kick.
    """

    effect = "derivative_kick"
    quantities = (
        Quantity("gain", "N m s/rad", 0.2, 3.0),
        Quantity("time", "s", 0.02, 0.1, grid=(0.007, 0.02, 0.05)),
    )
    source = "MX-28 e-manual: D 16 of firmware 1.0 is 0.15 to 0.25 N m s/rad"
    state = ("_goal",)

    def prepare(self) -> None:
        """See Term."""
        self._goal = np.full_like(self.values["gain"], np.nan)
        self._rate = np.zeros_like(self._goal)
        self._pace = -self.scene.timestep / np.maximum(self.values["time"], 1e-9)
        self._step = self.scene.steps()

    def parts(self) -> Parts:
        """See Term."""
        return self.values["gain"], self._step, self._goal, self._rate, self._pace

    def command(self, now: Array, before: Array, share: Array) -> tuple[Array, Array]:
        """See Term: commands stay as they are, their filtered rate is taken note of."""
        _, *own = self.parts()
        kernels.differ(now, before, np.atleast_2d(share), *own)
        return now, before

    def drive(self, drive: Drive) -> None:
        """See Term."""
        kernels.kick(drive.torque, self.values["gain"], self._rate)


class DeadBand(Term):
    """Errors below a width count as none, larger ones as less by it."""

    effect = "dead_band"
    quantities = (Quantity("width", "rad", 0.004, 0.05),)
    source = "one encoder step (MX-28: 1.5 mrad) to 0.29 degrees (RX-28 manual, margin)"

    def parts(self) -> Parts:
        """See Term."""
        return (self.values["width"],)

    def error(self, error: Array) -> Array:
        """See Term."""
        left = error.copy()
        kernels.forgive(left, *self.parts())
        return left


class TargetRateLimit(Term):
    """The controller's goal moves at most at some speed towards the command.

    Its speed changes at most at some acceleration, as in servos with a motion profile.
    """

    effect = "target_rate_limit"
    kinds = ("joint", "group", "bus")
    quantities = (
        Quantity("slowness", "s/rad", 0.25, 2.0),
        Quantity("sluggishness", "s2/rad", 0.005, 0.1),
    )
    source = "3 to 5 rad/s; BAM (arXiv:2410.08650) has it in the STS3215; 200 rad/s2: an estimate"
    state = ("_goal", "_speed")

    def prepare(self) -> None:
        """See Term."""
        slowness, sluggishness = (self.values[name] for name in ("slowness", "sluggishness"))
        self._rate = 1 / np.maximum(slowness, 1e-9)
        self._acceleration = 1 / np.maximum(sluggishness, 1e-9)
        self._limited = np.where((slowness > 0) | (sluggishness > 0), 1.0, 0.0)
        self._goal = np.full_like(slowness, np.nan)
        self._speed = np.zeros_like(slowness)
        self._step = self.scene.steps()

    def parts(self) -> Parts:
        """See Term."""
        fixed = self._step, self._rate, self._acceleration, self._limited
        return (*fixed, self._goal, self._speed)

    def command(self, now: Array, before: Array, share: Array) -> tuple[Array, Array]:
        """See Term."""
        now, before = now.copy(), before.copy()
        kernels.travel(now, before, np.atleast_2d(share), *self.parts())
        return now, before


class Cogging(Term):
    """A torque that ripples with the joint's angle."""

    effect = "cogging"
    quantities = (
        Quantity("sine", "N m", 0.03, 0.4, signed=True),
        Quantity("cosine", "N m", 0.03, 0.4, signed=True),
        # A joint that visits 2 rad tells numbers of teeth apart that differ by 3 (a sinc's lobe).
        Quantity("teeth", "1", 24.0, 200.0, grid=tuple(np.arange(8.0, 61.0, 4.0).tolist())),
    )
    source = "estimate: 0.02 to 0.06 N m"

    def parts(self) -> Parts:
        """See Term."""
        return self.values["sine"], self.values["cosine"], self.values["teeth"]

    def flow(self, flow: Flow) -> None:
        """See Term."""
        kernels.ripple(flow.torque, flow.angle, *self.parts())

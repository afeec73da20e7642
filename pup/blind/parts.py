"""What a part of a servo may do to it, instant by instant."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pup.blind.world import Array, Effect, Plan, spanned


@dataclass(eq=False)
class Moment:
    """One instant of all servos; arrays of shape (n_parameter_sets, n_plans, n_joints).

    Parts change `error`, `duty`, `loss`, `low`, `high`, `passive` and `grip` in place.

    Attributes:
      time: s since the recording began; negative while it settles.
      position: of the rotor, rad.
      speed: of the rotor in the middle of the kick, rad/s.
      acceleration: of the kick before, rad/s2.
      error: target less what the encoder tells, rad.
      duty: stiffness times error, N m.
      loss: damping that the motor's back-EMF makes, N m s/rad.
      low: lowest torque, N m.
      high: highest torque, N m.
      drive: torque of the motor, of the kick before until it is computed, N m.
      passive: torque that comes on top, N m.
      grip: largest torque of dry friction, N m.
    """

    time: float
    position: Array
    speed: Array
    acceleration: Array
    error: Array
    duty: Array
    loss: Array
    low: Array
    high: Array
    drive: Array
    passive: Array
    grip: Array


@dataclass(frozen=True, eq=False)
class Stage:
    """What a part may know of the scene it plays in.

    Attributes:
      shape: (n_parameter_sets, n_plans, n_joints).
      step: s.
      plans: what is played.
      kp: with the plans' setups, N m/rad, of that shape.
      tau_max: with the plans' setups, N m, of that shape.
      rotor: inertia, kg m2, of that shape.
      supply: nominal voltage of each plan, shape (1, n_plans, 1); 1 where the robot has no such
        knob.
      seed: of what is random in the part.
    """

    shape: tuple[int, int, int]
    step: float
    plans: Sequence[Plan]
    kp: Array
    tau_max: Array
    rotor: Array
    supply: Array
    seed: int


class Part:
    """One effect in the servos of some joints; does nothing unless a subclass says so."""

    def __init__(self, effect: Effect, joints: Sequence[int], stage: Stage) -> None:
        self.size = effect.size
        self.shape = effect.shape
        self.form = effect.form
        self.stage = stage
        self.at = (Ellipsis, spanned(joints))
        self.lanes = (stage.shape[0], stage.shape[1], len(joints))
        self.begin()

    def begin(self) -> None:
        """Set up what is remembered from instant to instant."""

    def sense(self, now: Moment) -> None:
        """Change `error`."""

    def command(self, now: Moment) -> None:
        """Change `duty`, `loss`, `low` and `high`."""

    def resist(self, now: Moment) -> None:
        """Add to `passive`."""

    def hold(self, now: Moment) -> None:
        """Add to `grip`."""


Hook = Callable[[Moment], None]


def hooks(parts: Sequence[Part], name: str) -> list[Hook]:
    """The methods of that name of all parts that have one of their own."""
    own = [part for part in parts if getattr(type(part), name) is not getattr(Part, name)]
    return [getattr(part, name) for part in own]

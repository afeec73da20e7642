"""How much work pre-sysID puts in, and from where."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from pup.errors import InputError
from pup.files import sha256
from pup.recording import Recording
from pup.robot import Actuator


@dataclass(frozen=True)
class Options:
    """How much work pre-sysID puts in.

    Attributes:
      actuator: torque law of the bounds.
      generations: of each nominal fit.
      population: candidates per generation.
      subsets: random subsets of Algorithm 1.
      subset_generations: of each subset's fit.
      fraction: share of the recordings in a subset.
      folds: leave-recordings-out fits that measure the held-out error; 0 for none.
      compare: also fit the other torque law, for the paper's comparison.
      fixed_network: keep the robot's network weights instead of fitting them. Free weights can
        trade places with rho and sigma, whose values then mean something only beside them.
      seed: of everything random.
      start: bounds file whose fitted values stand in for those of the robot's description: fits of
        its torque law begin there, and what the recordings cannot see stays there.
      as_described: whether the description's values are those of a diagnosis: what it fits (its
        nominal parameters) stays. The others, such as the torso's centre of mass, are fitted.
      fitted_to: types of motion that were diagnosed, none for all. What no recording of them can
        see, such as the floor where the robot hung, is fitted too.
      imu: whether how the IMU sits and how late it tells is fitted beside.
    """

    actuator: Actuator = "nn_pd"
    generations: int = 500
    population: int = 16
    subsets: int = 10
    subset_generations: int = 100
    fraction: float = 0.1
    folds: int = 0
    compare: bool = True
    fixed_network: bool = False
    seed: int = 0
    start: Path | None = None
    as_described: bool = False
    fitted_to: tuple[str, ...] = ()
    imu: bool = False

    def corrected(self, motions: tuple[str, ...] = ()) -> "Options":
        """The same for a robot that a diagnosis has corrected.

        Its servos are PD, as they were diagnosed: what was found is missing beside these. What the
        diagnosis has fitted, to more than the recordings, stays. How the IMU sits is fitted too: it
        is in no fit before, and would move the torso's centre of mass.

        Args:
          motions: types of motion that were diagnosed, none for all.
        """
        kept = replace(self, actuator="pd", compare=False, folds=0, start=None)
        return replace(kept, as_described=True, fitted_to=motions, imu=True)

    def told(self) -> dict[str, Any]:
        """As files have it: a file is known by its content, wherever it lies."""
        told = asdict(self)
        del told["start"]
        for name in ("fitted_to", "imu"):
            if not told[name]:  # as files have it that were written before there was such a thing
                del told[name]
        return told if self.start is None else told | {"start": sha256(self.start)}

    def check(self, recordings: Sequence[Recording]) -> None:
        """Refuse what does not go together, or not with these recordings.

        Raises:
          InputError: described values are asked to be fitted too, are not a diagnosis', or were
            fitted to no type of motion that was recorded.
        """
        if self.as_described and (self.folds or self.start is not None):
            raise InputError("values that are kept as described take no folds and no start")
        if self.as_described and self.actuator != "pd":
            raise InputError(
                "values that are kept as described are a diagnosis', whose servos are PD; use "
                "--actuator pd"
            )
        types = sorted({r.motion for r in recordings})
        if self.fitted_to and not set(self.fitted_to).intersection(types):
            raise InputError(
                f"no recording of type {', '.join(self.fitted_to)} tells what values that were "
                f"fitted to it can see; there are {', '.join(types)}"
            )
        if self.fitted_to and not self.as_described:
            raise InputError("what values were fitted to matters where they are kept as described")

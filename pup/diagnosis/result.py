"""What a diagnosis has found, and all that it was found from."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from pup.diagnosis.discover import Unexplained
from pup.diagnosis.evidence import Trace
from pup.diagnosis.experiment import NextRecording
from pup.diagnosis.held_out import HeldOut
from pup.diagnosis.hypotheses import Hypothesis
from pup.diagnosis.knocks import knocked
from pup.diagnosis.locate import MissingInput
from pup.diagnosis.models import Model, Round
from pup.diagnosis.nominal import Nominal
from pup.diagnosis.regimes import Regime
from pup.diagnosis.residuals import Measured, Noise
from pup.diagnosis.splits import Split
from pup.diagnosis.verdict import Answer, Finding
from pup.robot import RobotDescription


@dataclass(frozen=True)
class Diagnosis:
    """What was found, and all that it was found from.

    Attributes:
      robot: the robot.
      verdict: whether something material is missing.
      reason: why nothing can be said, or what was found and does not matter; else empty.
      measured: the samples.
      nominal: the nominal fit.
      regimes: the regimes of motion.
      replays: candidates simulated.
      findings: what is missing, most important first.
      held_out: errors on motions left out, before and after.
      before: the nominal model with what it predicts of motions left out.
      model: the same with what was found.
      rounds: how it came about.
      found: traces of all hypotheses.
      enough: surprise that chance does not reach.
      ask: what to record next; None where nothing is open, or nothing would settle it.
      missing: the torques that the nominal model lacks; None where nothing is to be explained.
      unexplained: what the known effects leave; None where that is noise.
      slight: effects that were found and do not matter.
      origins: of parts of one recording, that recording's id and when in it each begins, s.
      splits: how the nominal model's parameters differ between halves of the data, and how those
        of the model with what was found.
      lost: recordings that were left out, as nothing found in the others makes them follow.
      too_long: the sub-steps that the robot was given with, s, where they are too long for these
        recordings and `robot` has shorter ones; else 0.
    """

    robot: RobotDescription
    verdict: Answer
    reason: str
    measured: Measured
    nominal: Nominal
    regimes: tuple[Regime, ...]
    replays: int
    findings: tuple[Finding, ...] = ()
    held_out: HeldOut | None = None
    before: Model | None = None
    model: Model | None = None
    rounds: tuple[Round, ...] = ()
    found: tuple[Trace, ...] = ()
    enough: float = 0.0
    ask: NextRecording | None = None
    missing: MissingInput | None = None
    unexplained: Unexplained | None = None
    slight: tuple[Hypothesis, ...] = ()
    origins: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    splits: tuple[tuple[Split, ...], tuple[Split, ...]] = ((), ())
    lost: tuple[str, ...] = ()
    too_long: float = 0.0

    @property
    def unjudged(self) -> tuple[str, ...]:
        """Recordings in which a joint met its stop: what follows that was not looked at."""
        ids = (r.id for r in self.measured.recordings if knocked(self.robot, r).any())
        return tuple(dict.fromkeys(self.origins.get(id, (id, 0.0))[0] for id in ids))

    @property
    def noise(self) -> Noise:
        """The noise of the channels."""
        return self.nominal.noise

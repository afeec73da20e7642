"""What every rival is given: a case's samples and the diagnosis's own nominal fit of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.document import document
from pup.diagnosis.fit import Fit
from pup.diagnosis.held_out import HeldOut, held_out
from pup.diagnosis.models import Model
from pup.diagnosis.noise import assumed_noise
from pup.diagnosis.nominal import Nominal, certified, fit_nominal
from pup.diagnosis.pieces import pieces
from pup.diagnosis.replays import Bench, Replays, threads
from pup.diagnosis.residuals import Measured, Noise
from pup.diagnosis.result import Diagnosis
from pup.diagnosis.selection import Selector
from pup.diagnosis.verdict import Alternative, Finding
from pup.physics.parameters import robot_space
from pup.physics.terms import Place
from pup.recording import Recording
from pup.robot import RobotDescription

Array = NDArray[np.float64]

SEED = 0
"""That of `pup diagnose`, so that the nominal fit is the same."""


@dataclass(frozen=True)
class Named:
    """One name that a rival gives, and how sure it is of it."""

    effect: str
    place: Place
    probability: float


@dataclass(frozen=True, eq=False)
class Verdict:
    """What a rival says of a case.

    Attributes:
      mismatch: whether something is missing.
      named: what, the surest first.
      instead: what else the first name might be.
      fit: its model, with the terms that it names; None where it has none.
      predicted: what fits of that model without each fold predict, shape (n_samples,), rad; None
        where `fit` is to be refitted for that, or there is none.
    """

    mismatch: bool
    named: tuple[Named, ...] = ()
    instead: tuple[Named, ...] = ()
    fit: Fit | None = None
    predicted: Array | None = None


@dataclass(frozen=True, eq=False)
class Case:
    """A case, as the diagnosis sees it after its nominal fit.

    Attributes:
      robot: the robot.
      replays: simulates its recordings.
      nominal: the nominal fit, with the noise floor.
    """

    robot: RobotDescription
    replays: Replays
    nominal: Nominal

    @classmethod
    def of(cls, robot: RobotDescription, recordings: Sequence[Recording]) -> "Case":
        """Fit the nominal model as `engine.diagnose` does."""
        measured = Measured.of(robot, pieces(recordings))
        runner = threads(Bench(measured), 1)
        replays = Replays(measured, robot_space(robot, "pd"), runner, 1)
        rng = np.random.default_rng(SEED)
        nominal = certified(fit_nominal(replays, assumed_noise(measured), rng), replays, rng)
        return cls(robot, replays, nominal)

    @property
    def measured(self) -> Measured:
        """The samples."""
        return self.replays.measured

    @property
    def noise(self) -> Noise:
        """The noise of the channels."""
        return self.nominal.noise

    @cached_property
    def before(self) -> Model:
        """The nominal model with what it predicts of motions left out."""
        return self._predicting(self.nominal.fit)

    def judged(self, after: Model) -> HeldOut:
        """Errors of the nominal model and of another on motions left out."""
        return held_out(self.measured, self.before, after, SEED)

    def document(self, verdict: Verdict, simulations: int, corrected: str) -> dict[str, Any]:
        """A verdict as `diagnosis.json`.

        Errors on motions left out are those of refits; who has no model is left with the nominal.

        Args:
          verdict: of a rival.
          simulations: candidates that it took.
          corrected: path of the corrected robot.
        """
        after = self.before
        if verdict.predicted is not None:
            after = replace(self.before, predicted=verdict.predicted)
        elif verdict.fit is not None:
            after = self._predicting(verdict.fit)
        found = Diagnosis(
            robot=self.robot,
            verdict="mismatch" if verdict.mismatch else "none",
            reason="",
            measured=self.measured,
            nominal=self.nominal,
            findings=_findings(verdict),
            held_out=self.judged(after),
            model=None,
            rounds=(),
            found=(),
            enough=0.0,
            regimes=(),
            replays=simulations,
        )
        return document(found, corrected)

    def _predicting(self, fit: Fit) -> Model:
        """A fit with what fits without each fold predict."""
        return Selector(self.replays, self.noise, (), 0.0, fit).nominal


def _findings(verdict: Verdict) -> tuple[Finding, ...]:
    nothing: Mapping[str, Any] = {}
    return tuple(
        Finding(
            effect=named.effect,
            place=named.place,
            regime="",
            when=(),
            parameters=nothing,
            probability=named.probability,
            equivalents=() if number else tuple(_alternative(other) for other in verdict.instead),
            absorbed_by=nothing,
            law=None,
        )
        for number, named in enumerate(verdict.named)
    )


def _alternative(named: Named) -> Alternative:
    return Alternative(named.effect, named.place, named.probability)

"""The whole diagnosis: from recordings to what the simulator leaves out."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.discover import Unexplained, beside, unexplained
from pup.diagnosis.evidence import Trace
from pup.diagnosis.experiment import (
    NextRecording,
    next_recording,
    recorded_again,
    recorded_besides,
    rivals_of,
)
from pup.diagnosis.fit import Fit
from pup.diagnosis.fitting import complete, differentiate, fit_together
from pup.diagnosis.held_out import HeldOut, held_out
from pup.diagnosis.hypotheses import Hypothesis
from pup.diagnosis.locate import MissingInput, missing_input
from pup.diagnosis.materiality import improves, little, matters
from pup.diagnosis.models import Model, Round, chosen_in
from pup.diagnosis.noise import assumed_noise, quiet_noise, told_anew
from pup.diagnosis.nominal import Nominal, certified, fit_nominal, unfitted
from pup.diagnosis.pieces import origins, pieces
from pup.diagnosis.poor import Poor, why_poor
from pup.diagnosis.regimes import Regime, regimes
from pup.diagnosis.repeatability import unrepeated
from pup.diagnosis.replays import Replays, Runner
from pup.diagnosis.residuals import Measured, Noise
from pup.diagnosis.search import (
    Search,
    carried,
    drags,
    followed,
    followed_well,
    in_the_air,
    nowhere,
    search,
    search_on,
)
from pup.diagnosis.selection import Selector
from pup.diagnosis.splits import Split, splits
from pup.diagnosis.verdict import Answer, Finding, findings, in_order
from pup.physics.actuators import per_joint
from pup.physics.parameters import robot_space
from pup.recording import Recording
from pup.robot import RobotDescription

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

ALONE = 0.5
"""Mean square of a channel's errors beyond its noise, in that of the noise, from which something
that has no name is told though no law of it predicts motions left out."""


@dataclass(frozen=True)
class Diagnosis:
    """What was found, and all that it was found from.

    Attributes:
      robot: the robot.
      verdict: whether something material is missing.
      reason: why nothing can be said, or what was found and does not matter; else empty.
      measured: the samples.
      nominal: the nominal fit.
      findings: what is missing, most important first.
      held_out: errors on motions left out, before and after.
      before: the nominal model with what it predicts of motions left out.
      model: the same with what was found.
      rounds: how it came about.
      found: traces of all hypotheses.
      enough: surprise that chance does not reach.
      regimes: the regimes of motion.
      replays: candidates simulated.
      ask: what to record next; None where nothing is open, or nothing would settle it.
      missing: the torques that the nominal model lacks; None where nothing is to be explained.
      unexplained: what the known effects leave; None where that is noise.
      slight: effects that were found and do not matter.
      origins: of parts of one recording, that recording's id and when in it each begins, s.
      lost: recordings that were left out, as nothing found in the others makes them follow.
      splits: how the nominal model's parameters differ between halves of the data, and how those
        of the model with what was found.
    """

    robot: RobotDescription
    verdict: Answer
    reason: str
    measured: Measured
    nominal: Nominal
    findings: tuple[Finding, ...]
    held_out: HeldOut | None
    model: Model | None
    rounds: tuple[Round, ...]
    found: tuple[Trace, ...]
    enough: float
    regimes: tuple[Regime, ...]
    replays: int
    before: Model | None = None
    ask: NextRecording | None = None
    missing: MissingInput | None = None
    unexplained: Unexplained | None = None
    slight: tuple[Hypothesis, ...] = ()
    origins: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    splits: tuple[tuple[Split, ...], tuple[Split, ...]] = ((), ())
    lost: tuple[str, ...] = ()

    @property
    def noise(self) -> Noise:
        """The noise of the channels."""
        return self.nominal.noise


def diagnose(
    robot: RobotDescription,
    recordings: Sequence[Recording],
    runner: Callable[[Measured], Runner],
    lanes: int,
    progress: Progress,
    seed: int = 0,
    effects: int = 8,
) -> Diagnosis:
    """Locate and name what the simulator of a robot leaves out.

    Args:
      robot: the robot, with the nominal actuator of docs/physics.md.
      recordings: of that robot; one alone is taken in parts, where it comes to rest between them.
      runner: makes what runs batches of replays.
      lanes: how many run at once.
      progress: told the stage and the share of all that is done.
      seed: of everything random.
      effects: that are looked for at most; each may act at several places.
    """
    rng = np.random.default_rng(seed)
    parts = pieces(recordings)
    measured = Measured.of(robot, parts)
    replays = Replays(measured, robot_space(robot, "pd"), runner(measured), lanes)
    progress("nominal fit", 0.0)
    poor, noise = why_poor(measured), assumed_noise(measured)
    nominal = unfitted(replays, noise) if poor else fit_nominal(replays, noise, rng)
    seen = _regimes(nominal, replays)

    def told(verdict: Answer, reason: str = "", **more: Any) -> Diagnosis:
        known: dict[str, Any] = {
            "findings": (),
            "held_out": None,
            "model": None,
            "rounds": (),
            "found": (),
            "enough": 0.0,
        }
        if verdict == "undetermined":
            known["ask"] = _instead(measured, poor, seed)
        return Diagnosis(
            robot=robot,
            verdict=verdict,
            reason=reason,
            measured=measured,
            nominal=nominal,
            regimes=tuple(seen),
            replays=replays.count,
            origins=origins(recordings, parts),
            **(known | more),
        )

    if poor:
        return told("undetermined", poor.reason)
    first = _first_look(followed(nominal, replays), replays, rng, progress, effects)
    contact = bool(measured.grounded.any())
    if first is None or contact:
        nominal = certified(nominal, replays, rng)
    if first is None and not nominal.certificate.holds:
        near = in_the_air(measured) or followed_well(nominal, replays)
        first = _first_look(near, replays, rng, progress, effects)
    if first is not None:
        whole, part = nominal.certificate, first[0].certificate
        nominal = replace(nominal, certificate=part.beside(whole) if contact else part)
    if not nominal.certificate.holds:
        return told("undetermined", _unsettled(nominal))
    done = search(replays, nominal, rng, progress, first[1] if first else None, effects)
    if done is not None and not contact:
        if first is None and nowhere(done, nominal):
            # Around a motion that is far off no slope shows what is missing, though none is lost.
            first = _first_look(followed_well(nominal, replays), replays, rng, progress, effects)
            base = carried(first[1], replays, nominal) if first else nominal.fit
            if first is not None and base is not nominal.fit:
                again = search(replays, nominal, rng, progress, first[1], effects, base)
                done = min((s for s in (done, again) if s), key=lambda s: s.model.worth)
        if first is not None and drags(first[1], done):
            kept = first[1].selector.replays.measured.recordings
            some = diagnose(robot, kept, runner, lanes, progress, seed, effects)
            if some.verdict == "mismatch":  # of the others alone, nothing else may be said
                left_out = {r.id for r in measured.recordings} - {r.id for r in kept}
                lost = tuple(sorted({*some.lost, *left_out}))
                return replace(some, lost=lost, replays=some.replays + replays.count)
    if done is not None and nominal.noise.source == "assumed":
        nominal, done = _weighed(nominal, done, replays, rng, progress, effects)
    if done is None:
        return told("undetermined", "the motions would not show any effect of the library")
    selector = done.selector
    settled, rounds = selector.settled(done.model, done.rounds)
    progress("what is left", 0.8)
    model = selector.predicting(settled)
    left = unexplained(model, selector, seen)
    final = selector.predicting(left.model if left else model)
    shown = held_out(measured, selector.nominal, final, seed)
    slight, evidence = "", dict[str, Any]()
    if not _matters(selector.nominal, model, left, shown, nominal.noise):
        slight, evidence["slight"] = little(model, shown), model.hypotheses
        left, model = None, selector.nominal
        final = model
        shown = held_out(measured, model, model, seed)
    evidence |= {
        "found": done.found,
        "enough": done.enough,
        "rounds": tuple(rounds),
        "held_out": shown,
        "before": selector.nominal,
        "model": final,
        "unexplained": left,
    }
    odd = unrepeated(measured, replays.errors(final.fit.row()), nominal.noise, seen)
    if not model.hypotheses and not left and not odd:
        return told("none", slight, **evidence)
    progress("where", 0.87)
    differentiate([final.fit], replays, nominal.noise)
    evidence["missing"] = missing_input(nominal.fit, replays, nominal.noise)
    evidence["splits"] = tuple(
        splits(fit, replays, nominal.noise) for fit in (nominal.fit, final.fit)
    )
    progress("findings", 0.92)
    named = findings(model, rounds, selector, measured, seen) if model.hypotheses else ()
    progress("next recording", 0.95)
    ask = _next(named, rounds, selector, lambda m: Replays(m, replays.space, runner(m), lanes))
    nameless = beside(left.finding, named, robot) if left else odd
    evidence["findings"] = in_order((*named, nameless) if nameless else named)
    return told("mismatch", ask=ask, **evidence)


def _instead(measured: Measured, poor: Poor | None, seed: int) -> NextRecording:
    """What to record where these recordings tell nothing."""
    cure = poor.cure if poor else ""
    return recorded_again(measured, cure) if cure else recorded_besides(measured, seed)


def _weighed(
    nominal: Nominal,
    done: Search,
    replays: Replays,
    rng: np.random.Generator,
    progress: Progress,
    effects: int,
) -> tuple[Nominal, Search]:
    """The search gone on with where what it leaves is not the noise that it was weighed by.

    With nothing recorded twice, noise is first taken from how errors flicker at rest, of which
    there may be little.
    """
    measured, errors = replays.measured, replays.errors(done.model.fit.row())
    noise = told_anew(nominal.noise, quiet_noise(measured, errors), measured)
    if noise is None:
        return nominal, done
    fit = Fit(nominal.fit.coordinates, nominal.fit.at)
    fit_together([fit], replays, noise)
    complete([fit], replays, noise)
    certificate = nominal.certificate
    left = certificate.left * fit.chi2 / nominal.fit.chi2
    nominal = Nominal(fit, noise, replace(certificate, left=left))
    return nominal, search_on(done, replays, nominal, rng, progress, effects)


def _matters(
    nominal: Model, model: Model, left: Unexplained | None, shown: HeldOut, noise: Noise
) -> bool:
    """Whether what was found is material, or something unknown: that is large, or predicted."""
    if model.hypotheses and matters(nominal, model, shown, noise):
        return True
    if left is None:
        return False
    if left.excess > ALONE:
        return True
    return improves(model, shown, noise) if model.hypotheses else shown.interval[0] > 0


def _first_look(
    kept: Sequence[int],
    replays: Replays,
    rng: np.random.Generator,
    progress: Progress,
    effects: int,
) -> tuple[Nominal, Search] | None:
    """What is missing in some of the recordings, where a fit to all of them tells little.

    None where there are none of these, or their nominal fit does not converge either.
    """
    if not kept:
        return None
    some = replays.narrowed(kept)
    fitted = certified(fit_nominal(some, assumed_noise(some.measured), rng), some, rng)
    holds = fitted.certificate.holds
    found = search(some, fitted, rng, progress, most=effects) if holds else None
    replays.simulated += some.simulated
    return None if found is None else (fitted, found)


def _next(
    found: Sequence[Finding],
    rounds: Sequence[Round],
    selector: Selector,
    factory: Callable[[Measured], Replays],
) -> NextRecording | None:
    """What to record next: what would settle the most important finding that can be settled."""
    robot = selector.replays.measured.robot
    for finding in found:
        if finding.equivalents:
            chosen = chosen_in(rounds, (finding.effect, finding.place))
            rivals = rivals_of(finding, chosen, selector)
            ask = next_recording(robot, rivals, selector.noise, factory)
            if ask is not None:
                return ask
    return None


def _regimes(nominal: Nominal, replays: Replays) -> list[Regime]:
    """The regimes of the nominal fit's motion."""
    simulated = replays([nominal.fit.row()])[0]
    measured, space = replays.measured, replays.space
    values = space.at(nominal.fit.values).candidates()
    limits, gains = (per_joint(measured.robot, values, kind)[0] for kind in ("tau_max", "kp"))
    return regimes(measured, np.where(np.isnan(simulated), 0.0, simulated), limits, gains)


def _unsettled(nominal: Nominal) -> str:
    told = nominal.certificate
    if not told.agree:
        ends = ", ".join(f"{c:.1f}" for c in told.starts)
        return f"the nominal fit does not settle: its starts end at chi-squared {ends}"
    return (
        "the nominal fit does not find itself again: a refit of its own simulation ends "
        f"{told.recovered:.1f} standard deviations away"
    )

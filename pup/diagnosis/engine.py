"""The whole diagnosis: from recordings to what the simulator leaves out."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.discover import Unexplained, beside, unexplained
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
from pup.diagnosis.locate import missing_input
from pup.diagnosis.looks import (
    FirstLook,
    drags,
    first_look,
    followed,
    followed_well,
    in_the_air,
    nowhere,
)
from pup.diagnosis.materiality import astray, improves, little, matters
from pup.diagnosis.models import Model, Round, chosen_in
from pup.diagnosis.noise import assumed_noise, told_anew
from pup.diagnosis.nominal import Nominal, certified, fit_nominal, unfitted
from pup.diagnosis.patchwork import patched
from pup.diagnosis.pieces import origins, pieces
from pup.diagnosis.poor import why_poor
from pup.diagnosis.regimes import Regime, regimes
from pup.diagnosis.repeatability import unrepeated
from pup.diagnosis.replays import Replays, Runner
from pup.diagnosis.residuals import Measured, Noise
from pup.diagnosis.result import Diagnosis
from pup.diagnosis.search import Search, carried, search, search_on
from pup.diagnosis.selection import Selector
from pup.diagnosis.splits import splits
from pup.diagnosis.substeps import shorter_stepped
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

LOUDER = (
    "errors are larger than the noise that was assumed, but no effect and no law foretells them "
    "on motions left out; with nothing recorded twice, they may be noise"
)


@dataclass(frozen=True, eq=False)
class _Task:
    """What all stages of a diagnosis share.

    Attributes:
      recordings: as they were given.
      parts: the same, or the parts of one that is alone.
      measured: the samples of these.
      replays: simulates them.
      runner: makes what runs batches of replays.
      lanes: how many run at once.
      progress: told the stage and the share of all that is done.
      seed: of everything random.
      effects: that are looked for at most.
      rng: drawn from so far.
    """

    recordings: Sequence[Recording]
    parts: Sequence[Recording]
    measured: Measured
    replays: Replays
    runner: Callable[[Measured], Runner]
    lanes: int
    progress: Progress
    seed: int
    effects: int
    rng: np.random.Generator

    @property
    def contact(self) -> bool:
        """Whether the robot stands on the ground in any of the recordings."""
        return bool(self.measured.grounded.any())

    def replays_of(self, measured: Measured) -> Replays:
        """What simulates other samples, as of recordings that are planned."""
        return Replays(measured, self.replays.space, self.runner(measured), self.lanes)

    def look(self, kept: Sequence[int]) -> FirstLook | None:
        """What some of the recordings show."""
        return first_look(kept, self.replays, self.rng, self.progress, self.effects)

    def search(
        self, nominal: Nominal, first: FirstLook | None, base: Fit | None = None
    ) -> Search | None:
        """What all recordings show, from what a first look has found on."""
        known = first.search if first else None
        return search(self.replays, nominal, self.rng, self.progress, known, self.effects, base)

    def told(
        self, nominal: Nominal, regimes: Sequence[Regime], verdict: Answer, reason: str = ""
    ) -> Diagnosis:
        """A diagnosis that says so much and no more."""
        return Diagnosis(
            robot=self.measured.robot,
            verdict=verdict,
            reason=reason,
            measured=self.measured,
            nominal=nominal,
            regimes=tuple(regimes),
            replays=self.replays.count,
            origins=origins(self.recordings, self.parts),
        )


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
    task = _Task(recordings, parts, measured, replays, runner, lanes, progress, seed, effects, rng)
    progress("nominal fit", 0.0)
    poor, noise = why_poor(measured), assumed_noise(measured)
    nominal = unfitted(replays, noise) if poor else fit_nominal(replays, noise, rng)
    seen = _regimes(nominal, replays)

    if poor:
        return _undetermined(task, nominal, seen, poor.reason, poor.cure)
    finer = shorter_stepped(nominal, replays, task.replays_of)
    if finer is not None:
        again = diagnose(finer, recordings, runner, lanes, progress, seed, effects)
        return replace(again, replays=again.replays + replays.count, too_long=robot.timestep)
    nominal, first = _settled(task, nominal)
    if not nominal.certificate.holds:
        return _undetermined(task, nominal, seen, _unsettled(nominal))
    done = task.search(nominal, first)
    if done is not None and not task.contact:
        done, first = _looked_again(task, nominal, first, done)
        alone = _others_alone(task, first, done)
        if alone is not None:
            return alone
    if done is None:
        reason = "the motions would not show any effect of the library"
        return _undetermined(task, nominal, seen, reason)
    if nominal.noise.source == "assumed":
        nominal, done = _weighed(task, nominal, done)
    return _judged(task, nominal, done, seen)


def _settled(task: _Task, nominal: Nominal) -> tuple[Nominal, FirstLook | None]:
    """A nominal fit with its certificate, and what motions show that must be looked at first.

    These are the motions that it does not lose track of, or, where no fit to all of them can be
    trusted, those in the air, or those that are followed best.
    """
    replays = task.replays
    first = task.look(followed(nominal, replays))
    if first is None or task.contact:
        nominal = certified(nominal, replays, task.rng)
    if first is None and not nominal.certificate.holds:
        first = task.look(in_the_air(task.measured) or followed_well(nominal, replays))
    if first is not None:
        whole, part = nominal.certificate, first.nominal.certificate
        trusted = part.beside(whole) if task.contact else part
        nominal = replace(nominal, certificate=trusted)
    return nominal, first


def _looked_again(
    task: _Task, nominal: Nominal, first: FirstLook | None, done: Search
) -> tuple[Search, FirstLook | None]:
    """A search made anew from what is followed best, where that of all motions has led nowhere.

    Around a motion that is far off no slope shows what is missing, though none is lost.
    """
    if first is not None or not nowhere(done, nominal):
        return done, first
    first = task.look(followed_well(nominal, task.replays))
    if first is None:
        return done, None
    base = carried(first.search.model.fit, task.replays, nominal)
    if base is nominal.fit:
        return done, first
    again = task.search(nominal, first, base)
    return min((s for s in (done, again) if s), key=lambda s: s.model.worth), first


def _others_alone(task: _Task, first: FirstLook | None, done: Search) -> Diagnosis | None:
    """The diagnosis without the motions that keep all others from being followed.

    None where there are none, or where the others alone show no mismatch: of them alone nothing
    else may be said.
    """
    if first is None or not drags(first.search, done):
        return None
    kept = first.search.selector.replays.measured.recordings
    some = diagnose(
        task.measured.robot,
        kept,
        task.runner,
        task.lanes,
        task.progress,
        task.seed,
        task.effects,
    )
    if some.verdict != "mismatch":
        return None
    left_out = {r.id for r in task.measured.recordings} - {r.id for r in kept}
    lost = tuple(sorted({*some.lost, *left_out}))
    return replace(some, lost=lost, replays=some.replays + task.replays.count)


def _weighed(task: _Task, nominal: Nominal, done: Search) -> tuple[Nominal, Search]:
    """The search gone on with where what it leaves is not the noise that it was weighed by.

    With nothing recorded twice, noise is first taken from how errors flicker at rest, of which
    there may be little.
    """
    measured, replays = task.measured, task.replays
    errors = replays.errors(done.model.fit.row())
    noise = told_anew(nominal.noise, measured, errors)
    if noise is None:
        return nominal, done
    fit = Fit(nominal.fit.coordinates, nominal.fit.at)
    fit_together([fit], replays, noise)
    complete([fit], replays, noise)
    certificate = nominal.certificate
    left = certificate.left * fit.chi2 / nominal.fit.chi2
    nominal = Nominal(fit, noise, replace(certificate, left=left))
    return nominal, search_on(done, replays, nominal, task.rng, task.progress, task.effects)


def _judged(task: _Task, nominal: Nominal, done: Search, seen: Sequence[Regime]) -> Diagnosis:
    """The verdict on what a search has found: whether it is material, and what is left."""
    measured, selector = task.measured, done.selector
    settled, rounds = selector.settled(done.model, done.rounds)
    task.progress("what is left", 0.8)
    model = selector.predicting(settled)
    left = unexplained(model, selector, seen)
    final = selector.predicting(left.model if left else model)
    shown = held_out(measured, selector.nominal, final, task.seed)
    reason, slight = "", model.hypotheses[:0]
    if not _matters(selector.nominal, model, left, shown, nominal.noise):
        reason, slight = little(model, shown), model.hypotheses
        left, model = None, selector.nominal
        final = model
        shown = held_out(measured, model, model, task.seed)
    odd = unrepeated(measured, task.replays.errors(final.fit.row()), nominal.noise, seen)
    told = replace(
        task.told(nominal, seen, "none", reason),
        found=done.found,
        enough=done.enough,
        rounds=tuple(rounds),
        held_out=shown,
        before=selector.nominal,
        model=final,
        unexplained=left,
        slight=slight,
    )
    if left and not odd and _only_louder(model, left, shown, nominal.noise):
        return _undetermined(task, nominal, seen, LOUDER, "each of them twice")
    if model.hypotheses or left or odd:
        return _explained(task, told, model, selector, odd)
    far = astray(final, shown, nominal.noise)
    if not far:
        return told
    reason = f"nothing was found, but motions left out are not foretold: {far}"
    return _undetermined(task, nominal, seen, reason)


def _explained(
    task: _Task, told: Diagnosis, model: Model, selector: Selector, odd: Finding | None
) -> Diagnosis:
    """A mismatch with all that is told of it: where, what, and what to record next.

    Args:
      task: of which diagnosis.
      told: what is known of it.
      model: the effects of the library that were found.
      selector: which found them.
      odd: a joint that does not repeat.
    """
    nominal, replays, seen, left = told.nominal, task.replays, told.regimes, told.unexplained
    assert told.model is not None
    task.progress("where", 0.87)
    differentiate([told.model.fit], replays, nominal.noise)
    missing = missing_input(nominal.fit, replays, nominal.noise)
    before, after = (splits(fit, replays, nominal.noise) for fit in (nominal.fit, told.model.fit))
    task.progress("findings", 0.92)
    named = (
        findings(model, told.rounds, selector, task.measured, seen, told.model)
        if model.hypotheses
        else ()
    )
    task.progress("next recording", 0.95)
    ask = _next(named, told.rounds, selector, task)
    assert told.held_out is not None
    known = left.finding if left else odd
    nameless = patched(named, known, told.held_out, told.model, nominal.noise, seen)
    if nameless and (left or not odd):
        nameless = beside(nameless, named, told.robot)
    return replace(
        told,
        verdict="mismatch",
        reason="",
        missing=missing,
        splits=(before, after),
        findings=in_order((*named, nameless) if nameless else named),
        ask=ask,
        replays=replays.count,
    )


def _undetermined(
    task: _Task,
    nominal: Nominal,
    seen: Sequence[Regime],
    reason: str,
    cure: str = "",
) -> Diagnosis:
    """No verdict, why, and what to record; `cure` is what helps where that is the same again."""
    measured = task.measured
    ask = recorded_again(measured, cure) if cure else recorded_besides(measured, task.seed)
    return replace(task.told(nominal, seen, "undetermined", reason), ask=ask)


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


def _only_louder(model: Model, left: Unexplained, shown: HeldOut, noise: Noise) -> bool:
    """Whether all there is to tell is more noise than was assumed, where nothing was repeated."""
    if noise.source == "repeats" or model.hypotheses or left.terms:
        return False
    return shown.interval[0] <= 0


def _next(
    found: Sequence[Finding],
    rounds: Sequence[Round],
    selector: Selector,
    task: _Task,
) -> NextRecording | None:
    """What to record next: what would settle the most important finding that can be settled."""
    robot = task.measured.robot
    for finding in found:
        if finding.equivalents:
            chosen = chosen_in(rounds, (finding.effect, finding.place))
            rivals = rivals_of(finding, chosen, selector)
            ask = next_recording(robot, rivals, selector.noise, task.replays_of, task.seed)
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

"""What is left when the best known effects are in the model: is it more than noise, and what?

A model that fits leaves errors that no torque explains better than noise does, that do not repeat
when a motion is repeated, and whose squares add up to what the noise floor says. Where they do not,
the torque that is missing is looked for in laws of what the servo sees and does.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.doubts import UNKNOWN, doubt, left_outside, left_over, unexplained_errors
from pup.diagnosis.fit import Fit
from pup.diagnosis.fitting import fit_together
from pup.diagnosis.impulses import BUDGET, responses
from pup.diagnosis.lacks import Lack, lack_of_fit
from pup.diagnosis.lawfit import LAWS, Law, laws
from pup.diagnosis.locate import BAND, MissingInput, explained_by
from pup.diagnosis.models import Model
from pup.diagnosis.regimes import Regime, strongest, windows
from pup.diagnosis.residuals import Measured
from pup.diagnosis.selection import KEPT, Selector
from pup.diagnosis.starts import closely
from pup.diagnosis.verdict import Finding, Parameter, reaches
from pup.physics.terms import Place
from pup.physics.terms.learned import LearnedLaw, unit
from pup.robot import RobotDescription, TermSpec

Array = NDArray[np.float64]

EVIDENCE = 10.0
"""Logarithm of odds from which a missing torque is believed."""
SURPRISE = 4.5
"""Standard deviations from which errors are more than noise."""
MATERIAL = 0.09
"""Mean square of a channel's unexplained errors, in that of its noise, that matters."""
LIKELY = 0.5
"""Probability from which something of a class is more likely there than not."""
FORM = 0.05
"""Share of its own trace that a wrong form of a known effect may leave."""
ROUGH = 5
"""Steps of all laws' refits until they are compared: they may start far from where they end."""
CLOSE = 3
"""So many of them are refitted to the end."""
TRIED = 2
"""Laws that are refitted without each fold."""
SHARED = 0.6
"""A law that this share of all joints asks for is the robot's."""


@dataclass(frozen=True, eq=False)
class Unexplained:
    """Something that the library does not explain.

    Attributes:
      finding: as it is told.
      missing: the torques that are missing with the known effects in the model.
      lacks: the errors of each channel.
      laws: the best laws in words, best first: those that hold, then those that were promising.
      model: the model with the law, fitted; the one given where no law holds.
      terms: what stands for the law in a robot's description.
    """

    finding: Finding
    missing: MissingInput
    lacks: tuple[Lack, ...]
    laws: tuple[str, ...]
    model: Model
    terms: tuple[TermSpec, ...]

    @property
    def excess(self) -> float:
        """Mean square beyond noise of the worst channel whose errors are more than noise."""
        return max(lack.excess for lack in _flagged(self.lacks, self.missing))


def unexplained(
    model: Model, selector: Selector, found: Sequence[Regime], budget: int = BUDGET
) -> Unexplained | None:
    """Look at what a selected model leaves; None where it is noise or does not matter.

    Args:
      model: what selection has left, with its Jacobian.
      selector: knows the replays, the noise and the folds.
      found: the regimes of motion.
      budget: sub-steps of simulation for the missing torques.
    """
    replays, fit = selector.replays, model.fit
    measured = replays.measured
    assert fit.residual is not None
    if left_over(model, selector.noise) <= selector.blur(model, FORM):
        return None
    answers = responses(fit, replays, selector.noise, budget)
    missing = explained_by(answers, fit)
    errors = unexplained_errors(model)
    lacks = lack_of_fit(measured, errors, missing, selector.noise.unsure)
    flagged = _flagged(lacks, missing)
    if not flagged:
        return None
    place, joints = _place(measured, missing, flagged)
    tried: list[Law] = []
    if joints and not _has_law(measured.robot, place):
        tried = laws(answers, fit, replays, replays([fit.row()])[0], joints)
    kept = _kept(tried, place, model, selector)
    law, corrected = kept[0] if kept else (None, model)
    after = fit.residual - missing.explained if law is None else corrected.fit.residual
    assert after is not None
    gain = fit.residual**2 - after**2
    told = [str(one) for one, _ in kept] + [str(one) for one in tried]
    return Unexplained(
        Finding(
            effect="unknown",
            place=place,
            regime=strongest(found, gain),
            when=tuple(windows(measured, gain)),
            parameters={} if law is None else _parameters(law, place, corrected),
            probability=_probability(model, selector),
            equivalents=(),
            absorbed_by={},
            law=None if law is None else str(law),
            gain=float(gain.sum()),
        ),
        missing,
        tuple(lacks),
        tuple(told[:LAWS]),
        corrected,
        () if law is None else (_term(law, place),),
    )


def beside(nameless: Finding, named: Sequence[Finding], robot: RobotDescription) -> Finding:
    """What has no name beside what has one there: no surer than the first whose class is likely.

    How much a name leaves on motions that were left out may only say that no other motion tells how
    strong a servo is, or that the effect has a form of its own: of that name it is a part.
    """
    there = [f for f in named if _meet(f.place, nameless.place, robot)]
    first = next((f.probability for f in there if f.of_class >= LIKELY), 1.0)
    return replace(nameless, probability=min(nameless.probability, first))


def _meet(one: Place, other: Place, robot: RobotDescription) -> bool:
    """Whether two places have a joint in common, or one of them is not of joints."""
    first, second = (set(place.joints(robot)) for place in (one, other))
    return not first or not second or bool(first & second)


def _probability(model: Model, selector: Selector) -> float:
    """That there is something without a name: sure alone, else by what named effects leave."""
    if not model.hypotheses:
        return 1 - UNKNOWN
    all_of_it = left_outside(selector.nominal, selector.noise)
    left = left_outside(model, selector.noise)
    return doubt(all_of_it - left, left)


def _flagged(lacks: Sequence[Lack], missing: MissingInput) -> list[Lack]:
    """The channels whose errors are more than noise, and large enough to care."""
    return [lack for lack in lacks if _matters(lack, missing)]


def _matters(lack: Lack, missing: MissingInput) -> bool:
    """Whether a channel's errors are more than noise, and large enough to care."""
    joint = lack.channel < len(missing.evidence) - 6
    believed = joint and missing.evidence[lack.channel] > EVIDENCE and lack.explained > MATERIAL
    repeated = lack.repeated_surprise > SURPRISE and (lack.repeated or 0.0) > MATERIAL
    return bool(believed or repeated or (lack.surprise > SURPRISE and lack.excess > MATERIAL))


def _place(
    measured: Measured, missing: MissingInput, flagged: Sequence[Lack]
) -> tuple[Place, list[int]]:
    """Where it is, and the joints that a law would act on."""
    robot = measured.robot
    joints = len(robot.joints)
    strong = [i for i in range(joints) if missing.evidence[i] > EVIDENCE]
    best = int(np.argmax(missing.evidence))
    if missing.evidence[best] <= EVIDENCE:  # no torque explains it: a sensor, or what is too fast
        worst = max(flagged, key=lambda lack: lack.surprise + lack.repeated_surprise)
        if worst.channel >= joints:
            return Place("sensor"), []
        return Place("joint", robot.joint_names[worst.channel]), [worst.channel]
    if best >= joints:
        return Place("body", robot.torso or ""), []
    if len(strong) > max(1, SHARED * joints):
        return Place("robot"), list(range(joints))
    group = robot.group_index[best]
    members = [int(i) for i in np.flatnonzero(robot.group_index == group)]
    if len(members) > 1 and set(members) <= set(strong):
        return Place("group", robot.groups[group]), members
    return Place("joint", robot.joint_names[best]), [best]


def _kept(
    tried: Sequence[Law], place: Place, model: Model, selector: Selector
) -> list[tuple[Law, Model]]:
    """The laws that predict motions left out, refitted, best first."""
    kept: list[tuple[float, Law, Model]] = []
    gained = [
        (law, fit)
        for law, fit in _refitted(tried, place, model, selector)
        if model.fit.chi2 - fit.chi2 > selector.enough
    ]
    if not gained:
        return []
    corrected = selector.models([(model.hypotheses, fit) for _, fit in gained])
    for (law, fit), after in zip(gained, corrected, strict=True):
        inside = model.fit.chi2 - fit.chi2
        deviation = np.sqrt(np.diag(fit.covariance()))[-len(law.features) :]
        if (np.abs(fit.at[-len(law.features) :]) < BAND * deviation).any():
            continue  # a part of it is not needed
        outside = float((model.held_out - after.held_out).sum())
        if outside > max(KEPT * inside, 0.5 * selector.enough):
            values = tuple(fit.values[name] for name in law.columns(place))
            worth = (inside + outside) / 2 - law.price * len(values)
            kept.append((worth, replace(law, coefficients=values), after))
    kept.sort(key=lambda told: -told[0])
    return _foreseen([(law, after) for _, law, after in kept], model, selector)


def _refitted(
    tried: Sequence[Law], place: Place, model: Model, selector: Selector
) -> list[tuple[Law, Fit]]:
    """The most promising laws, each refitted with the model."""
    fits = [(law, law.started(model.fit, place)) for law in tried]
    fit_together([fit for _, fit in fits], selector.replays, selector.noise, iterations=ROUGH)
    fits.sort(key=lambda told: told[1].chi2 + told[0].price * len(told[0].features))
    close = [fit for _, fit in fits[:CLOSE]]
    closely(close, selector.replays, selector.noise)
    return fits[:CLOSE]


def _foreseen(
    ranked: Sequence[tuple[Law, Model]], model: Model, selector: Selector
) -> list[tuple[Law, Model]]:
    """The laws from the first on whose refits without each fold predict it better than none does.

    A law that holds by its slopes may still send a refit astray: it may brake or push as it likes.
    """
    usual = _error(selector.predicting(model), selector) if ranked else 0.0
    for i, (law, after) in enumerate(ranked[:TRIED]):
        predicted = selector.predicting(after)
        if _error(predicted, selector) < usual:
            return [(law, predicted), *ranked[i + 1 :]]
    return []


def _error(model: Model, selector: Selector) -> float:
    """Sum of squared errors on the folds, weighed by the noise."""
    measured = selector.replays.measured
    white = measured.whiten((measured.values - model.predicted)[None], selector.noise)[0]
    return float(white @ white)


def _parameters(law: Law, place: Place, model: Model) -> dict[str, Parameter]:
    """The law's coefficients with their 90 % intervals."""
    reach = reaches(model)
    told = {}
    for feature, name in zip(law.features, law.columns(place), strict=True):
        i = model.fit.names.index(name)
        coordinate, at = model.fit.coordinates[i], float(model.fit.at[i])
        ends = (at - reach[i], at + reach[i])
        told[feature] = Parameter(
            coordinate.value(at), unit(feature), *(coordinate.value(e) for e in ends)
        )
    return told


def _has_law(robot: RobotDescription, place: Place) -> bool:
    """Whether a robot's description has a law at a place already: two cannot stand there."""
    laws_there = (t for t in robot.terms if t.effect == LearnedLaw.effect)
    return any((t.kind, t.name) == (place.kind, place.name) for t in laws_there)


def _term(law: Law, place: Place) -> TermSpec:
    values = dict(zip(law.features, law.coefficients, strict=True))
    return TermSpec(LearnedLaw.effect, place.kind, place.name, values)

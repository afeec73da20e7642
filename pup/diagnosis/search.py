"""The search for what is missing: from the nominal fit to a model that holds."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.beginnings import begun
from pup.diagnosis.evidence import Projector, Trace, threshold, traced
from pup.diagnosis.exchanges import Exchanger
from pup.diagnosis.fit import Fit
from pup.diagnosis.fitting import complete, fit_together, start_best
from pup.diagnosis.hypotheses import hypotheses
from pup.diagnosis.models import Model, Round
from pup.diagnosis.nominal import Nominal, floors
from pup.diagnosis.replays import Replays
from pup.diagnosis.residuals import Measured
from pup.diagnosis.reweighing import Reweighing
from pup.diagnosis.selection import full
from pup.diagnosis.starts import LOUD, closely
from pup.diagnosis.tracing import traces

Array = NDArray[np.float64]

FALSE_ALARMS = 0.002
"""Chance that pure noise makes any hypothesis stand out."""
HALFWAY = 3
"""So many effects found are half of what refits do, as far as anybody can know."""


@dataclass(frozen=True, eq=False)
class Search:
    """What a search has found.

    Attributes:
      selector: which did it.
      model: the model that is left.
      rounds: how it came about.
      found: traces of all hypotheses.
      base: the fit that they were found around.
      enough: surprise that chance does not reach.
    """

    selector: Exchanger
    model: Model
    rounds: tuple[Round, ...]
    found: tuple[Trace, ...]
    base: Fit
    enough: float


def search(
    replays: Replays,
    nominal: Nominal,
    rng: np.random.Generator,
    progress: Callable[[str, float], None],
    first: Search | None = None,
    most: int = 8,
    base: Fit | None = None,
) -> Search | None:
    """Look for effects; None where the motions would show none.

    Args:
      replays: simulates.
      nominal: the fit of the nominal model.
      rng: draws noise.
      progress: told the stage and the share of all that is done.
      first: what was found in some of the recordings.
      most: effects that are looked for.
      base: what `carried` makes of that, where it is known.
    """
    progress("score test", 0.3)
    if base is None:
        base = nominal.fit if first is None else carried(first.model.fit, replays, nominal)
    if first is not None and base is not nominal.fit and full(first.model, most):
        found = _seen_first(first, base, replays)  # nothing more is looked for
    else:
        found = traces(hypotheses(replays.measured), base, replays, nominal.noise)
    if not found:
        return None
    enough = max(threshold(found, rng, FALSE_ALARMS), nominal.certificate.left)
    told = _teller(progress)
    near = None if first is None else looked_at(first, replays.measured)
    selector = Exchanger(replays, nominal.noise, found, enough, nominal.fit, base, most, told, near)
    progress("refits", 0.5)
    before: tuple[Round, ...] = ()
    start = selector.nominal
    if first is not None and base is not nominal.fit:
        before, start = first.rounds, selector.model(first.model.hypotheses, base)
    return _searched(selector, start, found, base, before)


def search_on(
    done: Search,
    replays: Replays,
    nominal: Nominal,
    rng: np.random.Generator,
    progress: Callable[[str, float], None],
    most: int = 8,
) -> Search:
    """Go on with a search where its samples are weighed by another noise.

    It begins at the model that was found, and may add to it, exchange its effects or do without.

    Args:
      done: the search, by another noise.
      replays: simulates.
      nominal: the fit of the nominal model, by this one.
      rng: draws noise.
      progress: told the stage and the share of all that is done.
      most: effects that are looked for.
    """
    progress("refits, noise told anew", 0.65)
    turned = Reweighing(replays.measured, done.selector.noise, nominal.noise)
    base = turned.fit(done.base)
    found = turned.traces(done.found, base)
    enough = max(threshold(found, rng, FALSE_ALARMS), nominal.certificate.left)
    known, fit = done.model.hypotheses, nominal.fit
    if known:
        fit = turned.fit(done.model.fit)
        closely([fit], replays, nominal.noise)
        complete([fit], replays, nominal.noise)
    near = done.selector.traces.base is done.model.fit
    own = {h.key for h in known}
    others = (t for t in done.selector.traces.found if t.hypothesis.key not in own)
    latest = [*turned.traces(others, fit), *(t for t in found if t.hypothesis.key in own)]
    around = fit if near else base
    told = _teller(progress)
    followed = done.selector.followed
    selector = Exchanger(
        replays, nominal.noise, latest, enough, nominal.fit, around, most, told, followed
    )
    start = selector.model(known, fit) if known else selector.nominal
    models = {done.selector.nominal: selector.nominal, done.model: start}
    rounds = turned.rounds(done.rounds, models, selector)
    earlier = [r for r in done.rounds if r.before.measured is not replays.measured]
    return _searched(selector, start, found, base, earlier, rounds)


def _searched(
    selector: Exchanger,
    start: Model,
    found: Sequence[Trace],
    base: Fit,
    earlier: Sequence[Round],
    known: Sequence[Round] = (),
) -> Search:
    """The search from a model on, after rounds of other samples and of these."""
    model, rounds = selector.run(start, known)
    complete([model.fit], selector.replays, selector.noise)
    return Search(selector, model, (*earlier, *rounds), tuple(found), base, selector.enough)


def _teller(progress: Callable[[str, float], None]) -> Callable[[Model], None]:
    """Tells of each effect that is added."""

    def told(model: Model) -> None:
        newest, number = model.hypotheses[-1], len(model.hypotheses)
        progress(
            f"refits, {newest.effect} at {newest.place} found",
            0.5 + 0.3 * number / (number + HALFWAY),
        )

    return told


def carried(known: Fit, replays: Replays, nominal: Nominal) -> Fit:
    """A first look's model, fitted to all recordings; the nominal fit where that is better.

    What only the others show, as the floor's friction, starts as the nominal fit has it, or from
    elsewhere. The nominal model lost track of these others, and from a little off this one does
    too: where it leaves more, or many times the noise, how they begin leads it to them.

    Args:
      known: the model's fit to some recordings.
      replays: simulates all of them.
      nominal: the fit of the nominal model to all.
    """
    fit = extended(known, nominal.fit)
    if len(fit.at) > len(known.at):
        start_best([fit], [[fit.at, *floors(fit)]], replays, nominal.noise)
    other = fit.fresh()
    fit_together([fit], replays, nominal.noise)
    if fit.chi2 >= min(nominal.fit.chi2, LOUD * len(replays.measured.values)):
        begun([other], replays, nominal.noise)
        fit_together([other], replays, nominal.noise)
        fit = min(fit, other, key=lambda fit: fit.chi2)
    if fit.chi2 >= nominal.fit.chi2:
        return nominal.fit
    complete([fit], replays, nominal.noise)
    return fit


def extended(known: Fit, whole: Fit) -> Fit:
    """A fit to some recordings, to be gone on with for all: with what only a nominal one has."""
    new = [i for i, c in enumerate(whole.coordinates) if c.name not in known.names]
    return Fit(
        (*(whole.coordinates[i] for i in new), *known.coordinates),
        np.r_[whole.at[new], known.at],
        fixed=known.fixed,
    )


def _seen_first(first: Search, base: Fit, replays: Replays) -> list[Trace]:
    """Traces of a first look, as if the motions that it left out showed nothing."""
    inside = looked_at(first, replays.measured)
    project = Projector(base.slopes)

    def widened(trace: Trace) -> Trace | None:
        whole = np.zeros((len(inside), trace.whole.shape[1]))
        whole[inside] = trace.whole
        return traced(trace.hypothesis, whole, project)

    return [trace for trace in map(widened, first.found) if trace is not None]


def looked_at(first: Search, measured: Measured) -> NDArray[np.bool_]:
    """The samples of the recordings of a first look."""
    looked = {recording.id for recording in first.selector.replays.measured.recordings}
    return measured.only([i for i, r in enumerate(measured.recordings) if r.id in looked])

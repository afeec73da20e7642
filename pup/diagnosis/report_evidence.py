"""Sections of the report on what was tried, what fell behind, and what nominal parameters hide."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis import summary
from pup.diagnosis.evidence import Score
from pup.diagnosis.figures import gains, likeness, masking, ranking_bars
from pup.diagnosis.hypotheses import Hypothesis
from pup.diagnosis.models import Round
from pup.diagnosis.result import Diagnosis
from pup.diagnosis.search import FALSE_ALARMS
from pup.diagnosis.wording import (
    Speech,
    capital,
    change,
    digits,
    effect_words,
    parameter_words,
    percent,
    quantity_words,
)
from pup.physics.terms import TERMS
from pup.sysid.html import Column, Html, figure, table, tag
from pup.sysid.wording import counted, listed

Array = NDArray[np.float64]

BEST = 12
"""Hypotheses shown of a ranking."""
FAINT = 0.5
"""Surprise of less is not drawn."""
MOST = 12
"""Nominal parameters shown of those that hide an effect."""
MOVED = 0.02
"""A parameter that moves by less hides nothing."""


def evidence(diagnosis: Diagnosis, speech: Speech) -> Iterator[Html]:
    """The score test and the refits of each round."""
    first = summary.first_ranking(diagnosis)
    if not first:
        return
    tried = len({s.trace.hypothesis.key for s in first})
    yield tag(
        "p",
        f"{capital(counted(tried, 'combination'))} of effect and place were each simulated once. "
        "What the nominal parameters could imitate was taken out, and the rest compared with the "
        "errors. Surprise says how much squared error a hypothesis promises to remove, in units of "
        f"the noise; pure noise would reach the dashed line once in {1 / FALSE_ALARMS:.0f} times.",
    )
    if not diagnosis.rounds:
        yield from _ranking(diagnosis, speech, first, None)
    for number, chosen in enumerate(diagnosis.rounds, start=1):
        if len(diagnosis.rounds) > 1:
            known = [speech.short(h.effect, h.place) for h in chosen.before.hypotheses]
            beside = f", beside {listed(known)}" if known else ""
            again = ", compared again" if chosen.again else ""
            yield tag("h3", f"Round {number}{again}{beside}")
        if not chosen.again:
            yield from _ranking(diagnosis, speech, chosen.ranking, chosen)
        yield from _refits(diagnosis, speech, chosen)


def _ranking(
    diagnosis: Diagnosis, speech: Speech, ranking: Sequence[Score], chosen: Round | None
) -> Iterator[Html]:
    """Bars of the best hypotheses."""
    shown = [s for s in summary.distinct(ranking, BEST) if s.surprise > FAINT]
    if not shown:
        return
    taken = chosen.chosen.key if chosen and chosen.accepted else None
    above = sum(s.surprise > diagnosis.enough for s in summary.distinct(ranking, len(ranking)))
    best = shown[0]
    named = _label(speech, best.trace.hypothesis)
    takeaway = (
        f"{capital(named)} stands out most, at {best.surprise:,.0f}; chance stays below "
        f"{diagnosis.enough:.0f}. {above} of all lie beyond it, so refits have to decide."
        if above
        else f"Nothing stands out: the best, {named}, stays at {best.surprise:.1f} of the "
        f"{diagnosis.enough:.0f} that chance reaches."
    )
    yield figure(
        ranking_bars(
            [_label(speech, s.trace.hypothesis) for s in shown],
            np.array([s.surprise for s in shown]),
            diagnosis.enough,
            [s.trace.hypothesis.key == taken for s in shown],
        ),
        f"Bars of the {len(shown)} best hypotheses. {takeaway}",
        takeaway + (" Blue: what the refits chose." if taken else ""),
    )


def _refits(diagnosis: Diagnosis, speech: Speech, chosen: Round) -> Iterator[Html]:
    """The finalists after their refits, and why they fell behind."""
    finalists = summary.rivals(chosen, diagnosis)
    if not finalists:
        yield tag("p", f"{capital(summary.why_rejected(chosen, diagnosis))}.")
        return
    names = [_label(speech, r.score.trace.hypothesis) for r in finalists]
    best = finalists[0]
    inside = np.array([r.inside for r in finalists])
    outside = np.array([r.outside for r in finalists])
    verdict = "is kept" if chosen.again else "was added"
    if not chosen.accepted:
        verdict = f"was not added: {summary.why_rejected(chosen, diagnosis)}"
    takeaway = f"{capital(names[0])} explains most where it was not fitted, and {verdict}."
    if not np.isclose(outside[0], outside.max()):
        takeaway = f"{capital(names[0])} is best by fit, prediction and simplicity, and {verdict}."
    if len(finalists) > 1:
        yield figure(
            gains(names, inside, outside),
            f"Squared error explained by each finalist. {takeaway}",
            f"After refits of each together with all nominal parameters. {takeaway}",
        )
    columns = [Column("Finalist", "long"), Column("Chi-squared", "number")]
    columns += [Column("Left out", "number"), Column("Probability", "number"), Column("", "long")]
    rows = []
    for name, rival in zip(names, finalists, strict=True):
        own = verdict if rival is best else summary.why_behind(rival, best)
        held = float(rival.model.held_out.sum())
        rows.append(
            (
                name,
                f"{rival.model.fit.chi2:,.0f}",
                f"{held:,.0f}",
                percent(rival.probability) if rival.probability >= 5e-4 else "below 0.1 %",
                own,
            )
        )
    before = chosen.before
    yield table(
        "Chi-squared is the sum of squared errors in units of the noise, on what was fitted and on "
        f"what was left out; without any of these {before.fit.chi2:,.0f} and "
        f"{float(before.held_out.sum()):,.0f}. Noise alone would give about "
        f"{before.samples:,}.",
        columns,
        rows,
    )


def hiding(diagnosis: Diagnosis, speech: Speech) -> Iterator[Html]:
    """What nominal parameters hide, what looks alike, and what would not have been seen."""
    ranking = summary.first_ranking(diagnosis)
    if not ranking:
        return
    yield from _masked(diagnosis, speech)
    alike = [s for s in summary.distinct(ranking, BEST - 2) if s.surprise > diagnosis.enough]
    if len(alike) > 1:
        values = summary.overlaps(alike)
        off = np.where(np.eye(len(alike), dtype=bool), 0.0, values)
        i, j = np.unravel_index(int(np.argmax(off)), off.shape)
        names = [_label(speech, s.trace.hypothesis) for s in alike]
        takeaway = f"Most alike: {names[i]} and {names[j]}, {100 * off[i, j]:.0f} %."
        yield tag("h3", "What looks alike")
        yield figure(
            likeness(names, values),
            f"Heat map of overlaps. {takeaway}",
            f"Whatever overlaps by nearly 100 % needs another motion to be told apart. {takeaway}",
        )
    yield from _unseen(diagnosis, speech)


def _masked(diagnosis: Diagnosis, speech: Speech) -> Iterator[Html]:
    """How nominal parameters imitate the finalists."""
    finalists = [r for chosen in diagnosis.rounds for r in summary.rivals(chosen, diagnosis)]
    fit = diagnosis.nominal.fit
    traces = {t.hypothesis: t for t in diagnosis.found}
    told: dict[object, tuple[str, float, Array]] = {}
    for rival in sorted(finalists, key=lambda r: -r.outside):
        hypothesis = rival.score.trace.hypothesis
        if hypothesis.key in told or hypothesis not in traces:
            continue
        at = dict(zip(rival.model.fit.names, rival.model.fit.at, strict=True))
        sizes = np.array([at[name] for name in hypothesis.magnitudes])
        hidden, changes = summary.imitation(traces[hypothesis], fit, sizes)
        told[hypothesis.key] = (_label(speech, hypothesis), hidden, changes)
    if not told:
        return
    shown = list(told.values())[:BEST]
    names = [name for name, _, _ in shown]
    shares = np.array([share for _, share, _ in shown])
    changes = np.array([change for _, _, change in shown])
    largest = np.abs(changes).max(axis=0)
    order = [int(i) for i in np.argsort(-largest)[:MOST] if largest[i] >= MOVED]
    order = sorted(order) or [int(np.argmax(largest))]
    main = int(np.argmax(np.abs(changes[0])))
    takeaway = (
        f"The nominal parameters alone hide {percent(shares[0])} of {names[0]}, mostly by moving "
        f"the {parameter_words(fit.names[main])} by {change(changes[0, main])}."
    )
    yield figure(
        masking(names, shares, [fit.names[i] for i in order], changes[:, order]),
        f"Masking of the finalists. {takeaway}",
        "Why a good fit proves little: left, the share of each effect that refitting hides at the "
        f"size found; right, how it does so. {takeaway}",
    )


def _unseen(diagnosis: Diagnosis, speech: Speech) -> Iterator[Html]:
    """Up to which size effects could hide in these recordings."""
    rows = []
    for trace, size in summary.hardest(diagnosis)[:BEST]:
        hypothesis = trace.hypothesis
        lengths = np.linalg.norm(trace.left, axis=0)
        clearest = int(np.argmax(lengths))
        quantity = TERMS[hypothesis.effect].magnitudes()[clearest]
        rows.append(
            (
                effect_words(hypothesis.effect),
                speech.place(hypothesis.place, hypothesis.effect).removeprefix("the "),
                f"{quantity_words(quantity.name)}: "
                + speech.quantity(size * hypothesis.typical[clearest], quantity.unit),
                digits(size) if size < 100 else f"{size:,.0f}",
                percent(trace.absorbed),
            )
        )
    if not rows:
        return
    yield tag("h3", "What these recordings would not show")
    columns = [Column("Effect"), Column("Hardest to see at", "long"), Column("Seen from", "long")]
    columns += [Column("In typical sizes", "number"), Column("Hidden by the fit", "number")]
    yield table(
        "Smaller than this, an effect would be missed more than once in ten times. Above 1, even "
        "one of a typical size could hide.",
        columns,
        rows,
    )


def _label(speech: Speech, hypothesis: Hypothesis) -> str:
    return speech.short(hypothesis.effect, hypothesis.place)

"""The report of a diagnosis: one page that needs nothing but itself."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from pup.diagnosis import (
    report_errors,
    report_evidence,
    report_findings,
    report_fit,
    report_missing,
    report_rivals,
    report_splits,
    report_unknown,
    summary,
)
from pup.diagnosis.drawing import draw_robot
from pup.diagnosis.knocks import SHAKEN
from pup.diagnosis.laws import NAMELESS, WORDS
from pup.diagnosis.report_findings import badge, otherwise
from pup.diagnosis.result import Diagnosis
from pup.diagnosis.rivals import Rivals
from pup.diagnosis.sentences import items
from pup.diagnosis.verdict import SLIGHT
from pup.diagnosis.wording import Speech, capital, minus, percent
from pup.files import write_atomic
from pup.sysid.accuracy import JointUnits
from pup.sysid.figures import drawing_style
from pup.sysid.html import Column, Html, figure, join, page, table, tag
from pup.sysid.wording import counted, flattened, listed, recordings_words, thousandths

SURE = 0.7
"""A finding less probable than this is told as the likeliest of several."""
LEFT = 1.3
"""An error of more than so many times the noise is too much for noise."""
NEXT = "next_recording"
LIST = "list-style: none; padding-left: 0; font-size: 1.15rem"
"""Looks of the list of what is missing."""


def write_report(
    diagnosis: Diagnosis,
    path: Path,
    provenance: Mapping[str, Any],
    rivals: Rivals | None = None,
) -> None:
    """Write `report.html`, whole or not at all.

    Args:
      diagnosis: what was found.
      path: the file.
      provenance: how it came about, as JSON values; under `next_recording` what to record next,
        with `motion`, `reason` and `splits`, if anything.
      rivals: other models of the same recordings, if any were fitted.
    """
    with drawing_style():
        content = _Report(diagnosis, provenance, rivals).content()
        write_atomic(path, page(f"Diagnosis of {diagnosis.robot.name}", *content))


class _Report:
    def __init__(
        self, diagnosis: Diagnosis, provenance: Mapping[str, Any], rivals: Rivals | None
    ) -> None:
        self.diagnosis = diagnosis
        self.rivals = rivals
        units = JointUnits.of(diagnosis.robot, diagnosis.measured.recordings)
        self.speech = Speech(diagnosis.robot, units)
        self.provenance = {k: v for k, v in provenance.items() if k != NEXT}
        self.next: Mapping[str, Any] = provenance.get(NEXT) or {}
        self.items = items(diagnosis, self.speech)

    def content(self) -> Iterator[Html]:
        """The page's body; a section with nothing to say is left out."""
        case = (self.diagnosis, self.speech)
        mended = summary.corrected(self.diagnosis)
        errors = "Before and after" if mended else "Errors on motions left out"
        sections: dict[str, Callable[[], Iterable[Html]]] = {
            "What is missing": lambda: report_findings.missing(*case),
            "Where": lambda: chain(self.where(), report_missing.torques(*case)),
            "Parameters that differ between halves of the data": lambda: report_splits.gaps(*case),
            "What no known effect explains": lambda: report_unknown.left(*case),
            errors: lambda: report_errors.before_and_after(*case),
            "Beside its rivals": lambda: report_rivals.beside(*case, self.rivals),
            "When the model is off": lambda: report_errors.maps(*case),
            "Evidence": lambda: report_evidence.evidence(*case),
            "What could hide": lambda: report_evidence.hiding(*case),
            "What to record next": self.record_next,
            "The nominal fit": lambda: report_fit.nominal(*case),
            "Provenance": self.came_about,
        }
        told = {title: list(section()) for title, section in sections.items()}
        told = {title: parts for title, parts in told.items() if parts}
        ids = {title: title.lower().replace(" ", "-") for title in told}
        yield from self.headline()
        links = (tag("li", tag("a", title, href=f"#{name}")) for title, name in ids.items())
        yield tag("nav", tag("ul", *links), aria_label="Contents")
        for title, parts in told.items():
            yield tag("section", tag("h2", title), *parts, id=ids[title])

    def headline(self) -> Iterator[Html]:
        """The verdict in plain words."""
        diagnosis = self.diagnosis
        parts = diagnosis.measured.recordings
        count = recordings_words(parts)
        if diagnosis.origins:
            count = f"one recording, in {counted(len(parts), 'part')} between its rests"
        yield tag("p", f"Diagnosis of {diagnosis.robot.name}, from {count}", class_="lead")
        yield tag("h1", self.title())
        if len(self.items) > 1:
            lines = (
                [*map(badge, item.numbers), "Perhaps: " if item.doubtful else "", item.text]
                for item in self.items
            )
            yield tag("ul", *(tag("li", join(line)) for line in lines), style=LIST)
        for words in {"mismatch": self.hid, "none": self.nothing, "undetermined": self.unclear}[
            diagnosis.verdict
        ]():
            yield tag("p", words)
        yield tag("dl", *(_fact(*fact) for fact in self.facts()), class_="facts")

    def title(self) -> str:
        """The verdict in one sentence."""
        diagnosis = self.diagnosis
        if diagnosis.verdict == "undetermined":
            return "These recordings cannot tell whether anything is missing."
        if diagnosis.verdict == "none":
            if self.left() > LEFT:
                return (
                    "No known effect is missing, but the simulator is off by "
                    f"{self.left():.1f} times the noise."
                )
            least = self.error(summary.smallest_material(diagnosis))
            return f"Nothing material is missing from the simulator beyond {least}."
        if len(self.items) == 1:
            unsure = min(finding.probability for finding in diagnosis.findings) < SURE
            perhaps = "Perhaps: " if self.items[0].doubtful else "Most likely: "
            return (perhaps if unsure else "") + self.single()
        known = [item for item in self.items if item.effect != NAMELESS]
        sure = [item for item in known if not item.doubtful] or known
        lacks = sure[0].name if len(sure) == 1 else f"{len(sure)} effects"
        beyond = f", perhaps {len(known) - len(sure)} more" if len(sure) < len(known) else ""
        beyond += f", and {WORDS[NAMELESS]}" if len(known) < len(self.items) else ""
        likely = "Perhaps the" if sure[0].doubtful else "The"
        return f"{likely} simulator lacks {lacks}{beyond}."

    def single(self) -> str:
        """The one effect that is missing, at one place or at several."""
        item = self.items[0]
        return item.text if len(item.numbers) == 1 else f"The simulator lacks {item.name}."

    def error(self, value: float) -> str:
        """An error as `2.1 mrad (0.12°)`."""
        return self.speech.units.words(value)

    def left(self) -> float:
        """What the final model leaves of motions left out, in units of the noise."""
        model = self.diagnosis.model
        return summary.left_over(self.diagnosis, model) if model else float("nan")

    def hid(self) -> Iterator[str]:
        """Where a mismatch hid and what naming it is worth."""
        diagnosis = self.diagnosis
        if not summary.corrected(diagnosis):
            yield self.unmended()
            return
        added = [f for f in diagnosis.findings if f.effect != NAMELESS or f.law]
        it = "it" if len(added) == 1 else "them"
        shifts = self.speech.shifts(added[0].absorbed_by)
        hidden = f"Your fit hid {it} in the {shifts}. " if shifts else ""
        if diagnosis.held_out is None:
            if hidden:
                yield hidden.rstrip()
            return
        held = diagnosis.held_out
        low, high = (percent(end) for end in held.interval)
        yield minus(
            f"{hidden}With {it}, the error on motions that the fit had not seen falls from "
            f"{self.error(held.before)} to {self.error(held.after)}: by "
            f"{percent(1 - held.after / held.before)} (90 % interval {low} to {high})."
        )
        if diagnosis.lost:
            s, was = ("", "was") if len(diagnosis.lost) == 1 else ("s", "were")
            yield (
                f"Recording{s} {listed(diagnosis.lost)} {was} left out: nothing that was found in "
                "the others explains what was recorded there, where something acts that is not "
                "named here."
            )
        if self.left() > LEFT:
            yield (
                f"What is left is still {self.left():.1f} times the noise: more is missing than "
                "the effects named here."
            )

    def unmended(self) -> str:
        """What it means that a cause was found but neither its name nor its law."""
        tried = counted(len({t.hypothesis.key for t in self.diagnosis.found}), "combination")
        return (
            f"None of {tried} of effect and place is its cause, and no law for a torque predicts "
            "motions that were left out of the fit. So nothing was added to the corrected robot: "
            f"it is the simulator refitted, off by {self.left():.1f} times the noise."
        )

    def nothing(self) -> Iterator[str]:
        """What it means that nothing is missing."""
        diagnosis = self.diagnosis
        tried = counted(len({t.hypothesis.key for t in diagnosis.found}), "combination")
        if diagnosis.slight:
            named = listed([self.speech.words(h.effect, h.place) for h in diagnosis.slight])
            yield (
                f"Of {tried} of effect and place these motions show {named}, but too little to "
                f"matter: below {SLIGHT:.0%} of what is typical, or of no use in predicting "
                "motions left out of the fit. So nothing was added to the corrected robot."
            )
        else:
            yield (
                f"Of {tried} of effect and place none explains an error of more than "
                f"{self.error(summary.smallest_material(diagnosis))} on motions left out of the "
                "fit."
            )
        yield "An effect that these motions do not excite may still be missing."
        if diagnosis.unjudged:
            yield (
                f"So may one that shows only within {SHAKEN:g} s after a joint met its stop, which "
                f"is not judged: one did in {listed(diagnosis.unjudged)}."
            )
        if self.left() > LEFT:
            yield (
                "But what is left is too much for noise: its cause is none of the effects "
                "in the library, or noise is larger than it seems at rest. The maps below show "
                "where and when it happens."
            )
        else:
            yield (
                "With its parameters refitted, the simulator as it is will do for motions like "
                "these."
            )
        if not diagnosis.slight and diagnosis.rounds and diagnosis.rounds[-1].finalists:
            closest = diagnosis.rounds[-1]
            named = self.speech.words(closest.chosen.effect, closest.chosen.place)
            yield f"Closest was {named}; {summary.why_rejected(closest, self.diagnosis)}."
        if diagnosis.noise.source == "assumed":
            yield (
                "No motion was recorded twice, so the noise level is assumed from how readings "
                "flicker at rest. Repeat one motion three times to measure it."
            )

    def unclear(self) -> Iterator[str]:
        """Why nothing can be said, and what would change that."""
        yield f"{capital(self.diagnosis.reason)}."
        if self.next:
            return
        yield (
            "Record at least two types of motion, one of them twice: steps of 0.1, 0.3 and 0.6 rad "
            "at irregular times, a slow triangle, a chirp from 0.2 to 5 Hz, and holds of three "
            "seconds approached from both sides."
        )

    def facts(self) -> Iterator[tuple[str, str, str]]:
        """Numbers to remember: name, value and a remark."""
        diagnosis, units = self.diagnosis, self.speech.units
        held = diagnosis.held_out
        if held is not None:
            mended = summary.corrected(diagnosis)
            after = f" → {thousandths(held.after)}" if mended else ""
            yield (
                "Error on motions left out",
                f"{thousandths(held.before)}{after} {units.small}",
                "nominal → corrected model" if after else "nominal model, refitted",
            )
        source = "measured from repeats" if diagnosis.noise.source == "repeats" else "assumed"
        yield (
            "Noise of a reading",
            f"{thousandths(summary.joint_noise(diagnosis))} {units.small}",
            source,
        )
        if np.isfinite(self.left()):
            yield "What is left", f"{self.left():.2f}", "times the noise; 1: nothing but noise"
        named = [f.probability for f in diagnosis.findings if f.effect != NAMELESS]
        if named:
            of = "" if len(named) == 1 else "of the least sure finding"
            yield "Probability", percent(min(named)), of or "that effect and place are right"
        if not diagnosis.nominal.certificate.holds:
            made = diagnosis.nominal.certificate.made
            yield "Nominal fit", "not converged" if made else "not made", ""

    def where(self) -> Iterator[Html]:
        """The robot with the places in colour."""
        diagnosis = self.diagnosis
        recordings = diagnosis.measured.recordings
        supports = {r.support for r in recordings}
        joints = [c for c in summary.channels(diagnosis) if c < len(diagnosis.robot.joints)]
        fit = diagnosis.nominal.fit
        misfits = {
            diagnosis.robot.joint_names[c]: summary.misfit(
                diagnosis, fit, diagnosis.measured.channel == c
            )
            for c in joints
        }
        misfits = {n: v for n, v in misfits.items() if np.isfinite(v)}
        if not misfits:
            return
        drawing = draw_robot(
            diagnosis.robot,
            min(supports - {"ground"} or supports),
            [f.place for f in diagnosis.findings],
            misfits,
        )
        worst = max(misfits, key=misfits.__getitem__)
        marked = listed(
            [
                f"{i} {self.speech.place(f.place, f.effect)}"
                for i, f in enumerate(diagnosis.findings, start=1)
            ]
        )
        cause = f"Rings and numbers, the causes: {marked}. " if marked else ""
        yield figure(
            drawing,
            f"Outline of {diagnosis.robot.name}. {cause}",
            f"{cause}Colours of the joints, the symptoms: the nominal fit is furthest off at the "
            f"{self.speech.channels()[diagnosis.robot.joint_names.index(worst)]}, by "
            f"{misfits[worst]:.1f} times the noise.",
        )

    def record_next(self) -> Iterator[Html]:
        """The recording that would tell more; where none would, that it is so."""
        if not self.next:
            yield from self.record_none()
            return
        yield tag("p", tag("strong", "Motion: "), str(self.next.get("motion", "")))
        reason = str(self.next.get("reason", "")).removesuffix(".")
        if reason:
            yield tag("p", f"{capital(reason)}.")
        pairs = [tag("li", f"{_named(a)} from {_named(b)}") for a, b in self.splits() if a != b]
        if pairs:
            yield tag("p", "It would tell")
            yield tag("ul", *pairs)
        for finding in self.diagnosis.findings:
            if finding.equivalents:
                named = self.speech.words(finding.effect, finding.place)
                yield tag("p", f"{capital(named)}: {otherwise(finding, self.speech)}")

    def splits(self) -> Iterable[tuple[Any, Any]]:
        """Pairs of effects that it would tell apart."""
        ask = self.diagnosis.ask
        if ask is None:
            told: Iterable[tuple[Any, Any]] = self.next.get("splits", ())
            return told
        # The document calls what the contract has no name for unknown, which it is not.
        return dict.fromkeys((pair.first, pair.second) for pair in ask.splits)

    def record_none(self) -> Iterator[Html]:
        """Why nothing is asked for though findings have rivals."""
        for finding in self.diagnosis.findings:
            if not finding.equivalents:
                continue
            one = self.speech.words(finding.effect, finding.place)
            others = [self.speech.words(a.effect, a.place) for a in finding.equivalents]
            yield tag(
                "p",
                f"No motion and no change of the setup that could be asked for tells {one} from "
                f"{listed(others)}: whichever it is, the corrected simulator moves alike.",
            )

    def came_about(self) -> Iterator[Html]:
        """How the result came about."""
        rows = flattened(self.provenance)
        if rows:
            yield table("How this came about", [Column("What"), Column("Value", "long")], rows)


def _named(effect: Any) -> str:
    return WORDS.get(str(effect), str(effect))


def _fact(name: str, value: str, more: str) -> Html:
    return tag("div", tag("dt", name), tag("dd", value, *([tag("small", more)] if more else [])))

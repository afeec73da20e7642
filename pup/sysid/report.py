"""The report of pre-sysID: one page that needs nothing but itself."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from pup.files import write_atomic
from pup.physics.simulator import Trajectories
from pup.recording import Recording
from pup.robot import RobotDescription
from pup.sysid import wording
from pup.sysid.accuracy import JointUnits, accuracy
from pup.sysid.bounds import SPLIT_LEVEL
from pup.sysid.figures import (
    INK,
    LABELS,
    SOFT,
    bounds_bars,
    convergence,
    correlation_matrix,
    drawing_style,
    joint_errors,
    line_style,
    split_values,
)
from pup.sysid.html import Column, Drawing, Html, figure, join, page, table, tag
from pup.sysid.loss import ReplayLoss
from pup.sysid.overlays import Overlays, Panel, by_motion
from pup.sysid.result import Bounds

_NOT = "not identified by these recordings"
_AT_EDGE = "; at the range's end"


def write_report(
    path: Path,
    bounds: Bounds,
    robot: RobotDescription,
    recordings: Sequence[Recording],
    replays: Mapping[str, Trajectories],
    loss: ReplayLoss,
) -> None:
    """Write `report.html`, whole or not at all.

    Args:
      path: the file.
      bounds: what pre-sysID found.
      robot: the robot.
      recordings: what was fitted.
      replays: label such as `NN-PD`, `PD` or `authors` to the replay of one candidate over all
        recordings. The one of the fitted actuator picks what is shown; else the first.
      loss: the measurements of the same recordings in the same order.
    """
    with drawing_style():
        content = _Report(bounds, robot, recordings, replays, loss).content()
        write_atomic(path, page(f"Model bounds of {bounds.robot}", *content))


class _Report:
    def __init__(
        self,
        bounds: Bounds,
        robot: RobotDescription,
        recordings: Sequence[Recording],
        replays: Mapping[str, Trajectories],
        loss: ReplayLoss,
    ) -> None:
        self.bounds = bounds
        self.robot = robot
        self.recordings = recordings
        self.labels = list(replays)
        self.accuracies = {label: accuracy(loss, t) for label, t in replays.items()}
        self.units = JointUnits.of(robot, recordings)
        self.overlays = Overlays(robot, loss, replays, self.accuracies, self.units)
        fitted = LABELS[bounds.actuator]
        self.main = fitted if fitted in replays else self.labels[0]

    def content(self) -> Iterator[Html]:
        """The page's body."""
        sections = {
            "Bounds": self.parameters,
            "Convergence": self.histories,
            "Real against simulated": self.motions,
            "Errors": self.errors,
            "Correlation": self.correlation,
            "Splits": self.splits,
            "Left out": self.omitted,
            "Provenance": self.provenance,
        }
        ids = {title: title.lower().replace(" ", "-") for title in sections}
        yield from self.headline()
        links = (tag("li", tag("a", title, href=f"#{name}")) for title, name in ids.items())
        yield tag("nav", tag("ul", *links), aria_label="Contents")
        for title, section in sections.items():
            yield tag("section", tag("h2", title), *section(), id=ids[title])

    def headline(self) -> Iterator[Html]:
        """What came out, in plain words."""
        bounds, words = self.bounds, self.units.words
        count, vague = len(bounds.space), wording.unidentified(bounds)
        yield tag("h1", f"Model bounds of {bounds.robot}")
        fits = wording.counted(len(bounds.subsets), "fit") if bounds.subsets else "no fits"
        yield tag(
            "p",
            f"From {wording.recordings_words(self.recordings)} with the {LABELS[bounds.actuator]} "
            f"actuator; bounds from {fits} to random subsets.",
            class_="lead",
        )
        determined = f"not determined: {wording.listed(vague)}" if vague else ""
        yield tag(
            "dl",
            _fact("Joint error, recordings fitted", words(bounds.train["rmse"]), self.before()),
            _fact("Joint error, recordings left out", *self.left_out()),
            _fact("Parameters the data determine", f"{count - len(vague)} of {count}", determined),
            class_="facts",
        )
        split = wording.split_words(bounds, self.recordings)
        yield tag("p", tag("strong", "Contact against suspended: "), split)

    def before(self) -> str:
        """The error at the robot's nominal values, where it is known."""
        before = self.bounds.train.get("rmse_before")
        if before is None or before == self.bounds.train["rmse"]:
            return ""
        return f"before the fit: {self.units.words(before)}"

    def left_out(self) -> tuple[str, str]:
        """The error on recordings that a fit did not see, and how it was measured."""
        measures = self.bounds.held_out
        if measures is None:
            return "not measured", "no recording was left out"
        folds = measures.get("folds")
        how = f"each left out once, in {folds:g} folds" if folds else ""
        return self.units.words(measures["rmse"]), how

    def parameters(self) -> Iterator[Html]:
        """Table and figure of the bounds."""
        bounds, number = self.bounds, wording.number
        columns = [Column("Parameter"), Column("Unit", "words")]
        columns += [Column(t, "number") for t in ("Nominal", "Lower", "Upper", "90 % interval")]
        rows = [
            (
                bounds.space.names[i],
                bounds.space.units[i],
                number(bounds.nominal[i]),
                number(bounds.lower[i]),
                number(bounds.upper[i]),
                wording.interval(bounds, i),
                ("yes" if bounds.identified[i] else _NOT)
                + ("; at the range's end" if edge else ""),
            )
            for i, edge in enumerate(bounds.at_end)
        ]
        yield table(
            f"Bounded parameters (grey: {_NOT}; unit 1: plain number)",
            [*columns, Column("Identified?", "status")],
            rows,
            ["" if known else "unknown" for known in bounds.identified],
        )
        yield tag(
            "p",
            "Nominal: the fit to all recordings, or the values that were kept. Lower and "
            "upper: the range of this and of the fits to random subsets, 10 % wider at both ends, "
            "and widened towards an interval that holds all parameters at once in 95 % of cases, "
            "by a twentieth of the search range at most, or to all of it where fewer than two "
            "subsets see the parameter; the whole search range where the recordings tell next to "
            "nothing. 90 % interval: how far the nominal fit is "
            "determined if the model is right, with values that were kept taken as known.",
        )
        if len(bounds.imu):
            yield tag("p", "Fitted beside, of the IMU: ", wording.imu_words(bounds), ".")
        if bounds.at_end.any():
            yield tag(
                "p",
                "At the range's end: the fit stopped at an end of its search range, so the best "
                "value may lie beyond it.",
            )
        shown = "; ".join(f"{row[0]} {row[3]} to {row[4]}, nominal {row[2]}" for row in rows)
        yield figure(
            bounds_bars(bounds),
            f"Bars of the bounds in the search range with a red line at each nominal: {shown}.",
            "Bounds (bars) and nominal values (red), each search range drawn from 0 to 1. "
            "Long bars: no single value serves all recordings.",
        )

    def histories(self) -> Iterator[Html]:
        """Convergence of the fits, NN-PD against PD."""
        known = {name: h for name, h in self.bounds.histories.items() if len(h)}
        if not known:
            yield tag("p", "No history of the fits was kept.")
            return
        ends = [f"{LABELS.get(n, n)} ends at {wording.number(h[-1])}" for n, h in known.items()]
        law, after = self.bounds.actuator, self.bounds.train["loss"]
        ends.append(f"{LABELS.get(law, law)} polished by least squares at {wording.number(after)}")
        yield tag("p", f"{wording.listed(ends)}.")
        yield figure(
            convergence(known),
            f"Best loss over the generations of the nominal fit: {'; '.join(ends)}.",
            "Best value of equation 1 so far, over the generations of the nominal fit.",
        )

    def motions(self) -> Iterator[Html]:
        """Overlays of joints and torso per motion type."""
        if len(self.robot.joints) > 1:
            shown = (
                f"joints with the largest, the median and the smallest error of {self.main}, each "
                "in the recording where its error is the median one. Joints told to stay where "
                "they are rank only as the worst"
            )
        else:
            shown = f"recordings with the largest, the median and the smallest error of {self.main}"
        yield tag("p", f"Per motion type the {shown}. Axes side by side span the same range.")
        yield self.key()
        tilted = False
        for heading, members in by_motion(self.recordings, self.units.position).items():
            yield tag("h3", heading)
            yield self.panels(self.overlays.joint_panels(members, self.main))
            if tilt := self.overlays.tilt_panels(members, self.main):
                tilted = True
                yield self.panels(tilt)
        if not tilted and any(r.support == "ground" for r in self.recordings):
            yield tag(
                "p",
                "No recording on the ground has the torso's roll or pitch, so there is no tilt to "
                "compare.",
            )

    def key(self) -> Html:
        """What the lines of the overlays are."""
        dashes = {"-": "solid", "--": "dashed", "-.": "dashed", ":": "dotted"}
        lines = [("command", SOFT, "solid"), ("measured", INK, "solid")]
        for label in self.labels:
            colour, dash = line_style(label, self.labels)
            lines.append((label, colour, dashes[dash]))
        items = [
            tag("li", tag("span", style=f"border-top: 3px {dash} {colour}"), name)
            for name, colour, dash in lines
        ]
        return tag("ul", *items, class_="key")

    def panels(self, panels: Sequence[Panel]) -> Html:
        """Small multiples."""
        return tag(
            "div", *(self.panel(p, d) for p, d in self.overlays.draw(panels)), class_="panels"
        )

    def panel(self, panel: Panel, drawing: Drawing) -> Html:
        """One of the small multiples."""
        unit = "mrad" if panel.target is None else self.units.small
        told = [
            f"{label} {wording.thousandths(error)} {unit}" for label, error in panel.errors.items()
        ]
        where = f"{panel.signal} in {panel.recording.id}"
        rank = f"{panel.rank.capitalize()}: " if panel.rank else ""
        lines = "command, measurement" if panel.target is not None else "measurement"
        alt = f"Over time, {where}: {lines} and simulation; RMSE {', '.join(told)}."
        return figure(drawing, alt, join([rank, where, *(tag("span", error) for error in told)]))

    def errors(self) -> Iterator[Html]:
        """RMSE per joint and per recording."""
        small, joints = self.units.small, self.robot.joint_names
        total = "; ".join(f"{n} {self.units.words(a.total)}" for n, a in self.accuracies.items())
        yield tag("p", f"Over all recordings and joints: {total}.")
        per_joint = {label: a.per_joint for label, a in self.accuracies.items()}
        best = "; ".join(f"{label} {wording.extremes(joints, e)}" for label, e in per_joint.items())
        yield figure(
            joint_errors(joints, per_joint, small),
            f"Bars of the RMSE per joint in {small}: {best}.",
            "Root mean square error per joint over all recordings, each with the same weight.",
        )
        columns = [Column("Recording", "long")]
        columns += [Column(f"{label} [{small}]", "number") for label in self.labels]
        columns += [Column("Motion"), Column("Support")]
        columns += [Column("Duration [s]", "number"), Column("Samples", "number")]
        columns += [Column("Setup", "words")] if any(r.setup for r in self.recordings) else []
        rows = []
        for i, r in enumerate(self.recordings):
            row = [r.id]
            row += [
                wording.error(a.per_recording[i], a.diverged[i]) for a in self.accuracies.values()
            ]
            row += [r.motion, r.support, f"{np.ptp(r.time):.2f}", str(len(r.time))]
            rows.append([*row, wording.setup(r)][: len(columns)])
        yield table(f"Root mean square joint error per recording, in {small}", columns, rows)
        yield from self.notes()

    def notes(self) -> Iterator[Html]:
        """What the recordings say of themselves, the same words once."""
        by_note: dict[str, list[str]] = defaultdict(list)
        for recording in self.recordings:
            if recording.notes.strip():
                by_note[recording.notes.strip()].append(recording.id)
        if by_note:
            yield tag("h3", "Notes in the recordings")
            items = (
                tag("li", tag("strong", self.among(ids)), ": ", note)
                for note, ids in by_note.items()
            )
            yield tag("ul", *items)

    def among(self, ids: Sequence[str]) -> str:
        """Some of the recordings, in few words."""
        if len(ids) == len(self.recordings) > 1:
            return "All recordings"
        return wording.listed(ids if len(ids) <= 6 else [*ids[:5], f"{len(ids) - 5} more"])

    def correlation(self) -> Iterator[Html]:
        """Correlation matrix and the pairs the recordings hardly tell apart."""
        if len(self.bounds.space) < 2:
            yield tag("p", "There is only one parameter.")
            return
        pairs = wording.strong_pairs(self.bounds)
        if pairs:
            yield tag("p", "The recordings hardly tell apart:")
            yield tag("ul", *(tag("li", pair) for pair in pairs))
        else:
            yield tag("p", f"No two parameters are correlated beyond {wording.STRONG:g}.")
        named = "; ".join(pairs) or f"none beyond {wording.STRONG:g}"
        yield figure(
            correlation_matrix(self.bounds),
            f"Correlation matrix of the bounded parameters; strong pairs: {named}.",
            "Correlation of the nominal fit's estimates, if the model is right; numbers from 0.5. "
            "Beside the names: 90 % intervals; grey names: not identified.",
        )

    def splits(self) -> Iterator[Html]:
        """Parameters between subsets with and without contact."""
        yield tag("p", tag("strong", wording.split_words(self.bounds, self.recordings)))
        yield from (tag("p", words) for words in wording.split_meaning(self.bounds))
        splits = self.bounds.splits
        if not splits:
            return
        contact = [s.contact for s in self.bounds.subsets]
        named = wording.splitting(self.bounds)
        marks = {n: f"not seen {side} contact" for n, side in wording.blind(self.bounds).items()}
        marks |= dict.fromkeys(named, "split")
        yield figure(
            split_values(self.bounds, named),
            "Values of each parameter in the subset fits, those with contact beside those without; "
            f"split: {wording.listed(named) or 'none'}.",
            f"One mark per subset fit: {contact.count(False)} without contact, "
            f"{contact.count(True)} with at least one recording on the ground.",
        )
        titles = ("Without contact", "With contact", "p, contact", "p, two clusters")
        columns = [Column("Parameter", "words"), *(Column(title, "number") for title in titles)]
        rows = [
            (
                wording.with_unit(s.name, self.bounds.space),
                wording.spread(s.without),
                wording.spread(s.with_contact),
                wording.p_value(s.p_value),
                wording.p_value(s.two_clusters),
                marks.get(s.name, ""),
            )
            for s in splits
        ]
        yield table("Mean ± standard deviation of the subset fits", [*columns, Column("")], rows)
        yield tag(
            "p",
            "p, contact: chance of a difference as large if contact did not matter, by permuting "
            f"the labels, corrected for the {len(splits)} parameters looked at. p, two clusters: "
            "chance of values as clustered from one normal population, labels unseen, not "
            f"corrected; below {SPLIT_LEVEL / len(splits):.4f} it counts.",
        )

    def omitted(self) -> Iterator[Html]:
        """What of equation 1 the recordings could not give."""
        if self.bounds.omitted:
            yield tag("ul", *(tag("li", line) for line in self.bounds.omitted))
        else:
            yield tag("p", "Nothing: the recordings give every term of the loss.")

    def provenance(self) -> Iterator[Html]:
        """How the result came about."""
        rows = wording.flattened(self.bounds.provenance)
        if not rows:
            yield tag("p", "None was recorded.")
            return
        yield table("How this came about", [Column("What"), Column("Value", "long")], rows)


def _fact(name: str, value: str, more: str) -> Html:
    return tag("div", tag("dt", name), tag("dd", value, *([tag("small", more)] if more else [])))

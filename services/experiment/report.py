"""The report of an experiment: one page that needs nothing but itself."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pup.files import write_atomic
from pup.sysid.figures import LABELS, convergence, drawing_style
from pup.sysid.html import Column, Html, figure, page, table, tag
from services.experiment import figures
from services.experiment.statistics import FEW
from services.experiment.verdicts import FLEETS, budget, walking

MISSING = "-"


def write_report(document: Mapping[str, Any], file: Path) -> None:
    """Write the report, whole or not at all.

    Args:
      document: of `experiment.json`.
      file: where to.
    """
    with drawing_style():
        write_atomic(file, page("Concealed robots", *_content(document)))


def estimated(told: Mapping[str, Any] | None, digits: int = 2) -> str:
    """A number with its interval, in words."""
    if not told or told["value"] is None:
        return MISSING
    value = f"{told['value']:.{digits}f}"
    interval = told.get("ci90")
    if not interval:
        return value
    ends = zip(interval, ("-∞", "∞"), strict=True)
    low, high = (without if end is None else f"{end:.{digits}f}" for end, without in ends)
    return f"{value} ({low} to {high})"


def _content(told: Mapping[str, Any]) -> Iterator[Html]:
    plan = told["plan"]
    yield tag("h1", "Concealed robots")
    yield tag(
        "p",
        f"{len(plan['seeds'])} virtual robots of {told['robot']} with physics that training never "
        "saw, through the real chain: recordings from the servo bus, bounds, policies, trials over "
        "ZeroMQ. Intervals are 90 %, for other robots of their kind: of shares by Clopper and "
        "Pearson, of means by Student, of ratios by Fieller, of medians from the order of robots. "
        f"What fewer than {FEW} robots say is indicative.",
        class_="lead",
    )
    if told["acceptance"]:
        yield tag("h2", "What was to be shown")
        yield from _acceptance(told)
    yield from _other_bounds(told)
    for direction, part in told["directions"].items():
        if not part["walks"]:
            continue
        yield tag("h2", f"Walking {direction}")
        yield from _direction(part)
    yield from _walked(told["directions"])
    if told["bounds"]:
        yield tag("h2", "Bounds of the fleet")
        yield from _bounds(told["bounds"])
    if told["bounds_diagnosed"]:
        yield tag("h2", "Bounds of the fleet with what its diagnoses share")
        yield from _bounds(told["bounds_diagnosed"])
    if told["diagnosis"]["robots"]:
        yield tag("h2", "Diagnosis")
        yield from _diagnosis(told)
    if told["real"]:
        yield tag("h2", "A real robot's recordings")
        yield from _real(told["real"])
    yield tag("h2", "How it came about")
    yield from _provenance(told)


def _acceptance(told: Mapping[str, Any]) -> Iterator[Html]:
    columns = [Column("Line", "long"), Column("Found", "number"), Column("Robots", "number")]
    columns += [Column("Bar", "number"), Column("", "status")]
    rows = [
        (
            line["line"],
            _found(line),
            _of_planned(line),
            f"{line['bar']:g}",
            line["answer"] + (", indicative" if line["indicative"] else ""),
        )
        for line in told["acceptance"]
    ]
    yield table("Bars, and what was found", columns, rows)
    yield tag(
        "p",
        "A line holds where the whole interval is above its bar; it is not shown where the number "
        "is and the interval is not, and fails where the number is below. It is incomplete where "
        "robots are missing that were planned. Each method is one training: intervals are over "
        "robots, and do not hold the luck of its seed.",
    )


def _found(line: Mapping[str, Any]) -> str:
    """A number of a line; there is no ratio to a mean of nothing."""
    return "other does not walk" if line["robots"] and line["value"] is None else estimated(line)


def _of_planned(told: Mapping[str, Any]) -> str:
    return f"{told['robots']} of {told['planned']}"


def _other_bounds(told: Mapping[str, Any]) -> Iterator[Html]:
    """A sentence for policies that were given and trained on bounds that are not the fleet's."""
    together: dict[str, list[str]] = {}
    for name, policy in told["policies"].items():
        if policy["other_bounds"]:
            together.setdefault(policy["bounds_sha256"], []).append(name)
    for bounds, names in together.items():
        outside = told["policies"][names[0]]["outside"]
        by_name = ", ".join(f"{name} {share:.0%}" for name, share in outside.items() if share)
        share = f"{np.mean(list(outside.values())):.0%}" if outside else "an unknown share"
        yield tag(
            "p",
            f"{', '.join(names)}: given, and trained on bounds ({bounds[:12]}) that are not this "
            f"fleet's; {share} of the parameters that were fitted to its robots lie outside of "
            f"these{f' ({by_name})' if by_name else ''}; the fitted eta is of the nearest within.",
        )


def _walked(directions: Mapping[str, Any]) -> Iterator[Html]:
    shown = {name: part for name, part in directions.items() if part["walks"]}
    if not shown:
        return
    yield tag("h2", "Distance and time")
    for quantity, words in (("distance", "Distance"), ("time", "Time before the fall")):
        yield figure(
            figures.walked(shown, quantity),
            f"{words} of each direction and method; the tables above have the numbers.",
            f"{words}, after the choice of eta. Bars: mean over robots; error bars: one standard "
            "deviation of all walks; dots: means of single robots.",
        )


def _direction(part: Mapping[str, Any]) -> Iterator[Html]:
    told = part["statistics"]
    columns = [Column("Policy", "words"), Column("Distance [m]", "number")]
    columns += [Column(t, "number") for t in ("sd", "sd of a robot", "Time [s]", "sd", "Robots")]
    rows = [
        (
            name,
            estimated(arm["distance"]),
            _sd(arm["distance"]["std"]),
            _sd(arm["distance"]["std_of_a_robot"]),
            estimated(arm["time"], 1),
            _sd(arm["time"]["std"]),
            str(arm["distance"]["robots"]),
        )
        for key, name in figures.NAMES.items()
        if (arm := told["arms"].get(key)) is not None
    ]
    yield table("Walks: mean over robots, with the deviation of all walks", columns, rows)
    for end, words in zip(FLEETS, ("", ", trained on with what diagnoses share"), strict=True):
        if any(method + end in part["walks"] for method in figures.METHODS):
            yield figure(
                figures.per_robot(part["walks"], end),
                f"Mean distance of each method on each robot{words}.",
            )
    compared = {f"farther than {name}": one for name, one in told["above"].items()}
    compared |= {f"{name}{budget(one)}": one for name, one in told["ratios"].items()}
    rows = [(name, estimated(one), _of_planned(one)) for name, one in compared.items()]
    if rows:
        columns = [Column("PUP against others", "words"), Column("Share or ratio", "number")]
        columns += [Column("Robots", "number")]
        yield table(
            "Shares of robots, and ratios of mean distances. Farther: by more than two standard "
            "errors of the difference of this robot's walks, and not backwards",
            columns,
            rows,
        )
    yield from _searches(part)


def _sd(value: float | None) -> str:
    return MISSING if value is None else f"{value:.2f}"


def _searches(part: Mapping[str, Any]) -> Iterator[Html]:
    told = part["statistics"]["needed"]
    if not told:
        return
    left_out = _not_walking(told)
    if walking(part["walks"]):
        yield figure(
            figures.searches(part),
            "Best walk so far over trials, for each search.",
            "Median over robots of the best walk so far; bands: the middle half. A best walk is "
            f"one walk, and lucky: the tables tell what chosen etas come to.{left_out}",
        )
    columns = [Column("Search", "words"), Column("Trials", "number")]
    columns += [Column("Needed (median)", "number"), Column("Share that got there", "number")]
    columns += [Column("Robots", "number")]
    rows = [
        (
            figures.NAMES.get(arm, arm),
            str(one["trials"]),
            MISSING if one["median"] is None else f"{one['median']:g}",
            estimated(one["reached"]),
            str(one["reached"]["robots"]),
        )
        for arm, one in told.items()
    ]
    yield table(
        f"Trials until a walk came as far as 95 % of PUP's distance after all trials.{left_out}",
        columns,
        rows,
    )


def _not_walking(needed: Mapping[str, Any]) -> str:
    """Which robots are not counted in what is a share of PUP's distance, and why."""
    left_out = sorted({robot for one in needed.values() for robot in one["not_walking"]})
    counted = {robot for one in needed.values() for robot in one["robots"]}
    if not left_out:
        return ""
    of = f"{len(left_out)} of {len(left_out) + len(counted)} robots"
    return f" Left out, as PUP does not walk there after them: {of}, {', '.join(left_out)}."


def _bounds(told: Mapping[str, Any]) -> Iterator[Html]:
    yield figure(
        figures.fleet_bounds(told),
        "Bounds of the fleet in the search range, with the fits of single robots.",
        "Grey: not identified by these recordings.",
    )
    histories = {name: np.array(values, float) for name, values in told["histories"].items()}
    if histories:  # there are none where the fleet was not fitted as one
        names = " and ".join(LABELS.get(name, name) for name in histories)
        yield figure(
            convergence(histories),
            f"Loss over generations, {names}.",
            f"Fit of all robots: {names}.",
        )
    columns = [Column("Parameter"), Column("Lower", "number"), Column("Upper", "number")]
    columns += [Column("Nominal", "number"), Column("Robots inside", "number")]
    rows = [
        (
            p["name"],
            *(f"{p[k]:.4g}" for k in ("lower", "upper", "nominal")),
            f"{told['inside'][p['name']]:.0%}" if p["name"] in told["inside"] else MISSING,
        )
        for p in told["parameters"]
    ]
    yield table("Bounds, and the share of robots whose own fit lies within them", columns, rows)


def _diagnosis(told: Mapping[str, Any]) -> Iterator[Html]:
    found = told["diagnosis"]
    robots = found["robots"]
    held = {
        robot: (1e3 * one["rmse_before"], 1e3 * one["rmse_after"])
        for robot, one in robots.items()
        if one["rmse_before"] is not None
    }
    if held:
        yield figure(
            figures.before_after(held, "error on motions left out, mrad"),
            "Error on motions left out of each robot, before and after its diagnosis.",
            f"Lower by {estimated(found['improvement'])} (median share of "
            f"{found['improvement']['robots']} robots; {found['undetermined']} undetermined, which "
            "count as 0).",
        )
    for direction, part in told["directions"].items():
        yield from _without_trials(direction, part["walks"])
    columns = [Column("Robot"), Column("Verdict"), Column("Classes named", "long")]
    columns += [Column("Before [mrad]", "number"), Column("After", "number")]
    rows = [
        (
            robot,
            one["verdict"],
            ", ".join(one["classes"]) or MISSING,
            MISSING if one["rmse_before"] is None else f"{1e3 * one['rmse_before']:.2f}",
            MISSING if one["rmse_after"] is None else f"{1e3 * one['rmse_after']:.2f}",
        )
        for robot, one in robots.items()
    ]
    yield table("Verdicts, and errors on motions left out", columns, rows)
    columns = [Column("Named", "words"), Column("Share of robots", "number")]
    rows = [(part, estimated(one)) for part, one in found["named"].items()]
    rows += [(f"class {name}", estimated(one)) for name, one in found["classes"].items()]
    yield table("Concealed parts and classes of effects that were named", columns, rows)


def _without_trials(direction: str, walks: Mapping[str, Any]) -> Iterator[Html]:
    before = walks.get("pup+fitted", {})
    for way, where in (
        ("corrected", "the corrected simulator of this robot"),
        ("undiagnosed", "the fleet's own simulator, for as long as with the diagnoses"),
        ("diagnosed", "a simulator of the fleet with what its diagnoses share"),
    ):
        after = walks.get(f"pup+{way}+fitted", {})
        pairs = {
            robot: tuple(float(np.mean(w[robot]["distance"])) for w in (before, after))
            for robot in before
            if robot in after
        }
        if pairs:
            yield figure(
                figures.before_after(pairs, "distance without trials, m"),
                f"Distance {direction} without trials, before and after training in {where}.",
                f"{direction}: eta of the fitted parameters, before (fleet's policy) and after "
                f"(trained on in {where}).",
            )


def _real(told: Mapping[str, Any]) -> Iterator[Html]:
    if told["histories"]:
        histories = {name: np.array(v, float) for name, v in told["histories"].items()}
        yield figure(convergence(histories), "Loss over generations of both torque laws.")
    rivals = (told["diagnosis"] or {}).get("rivals")
    if rivals:
        yield figure(
            figures.held_out(rivals["models"]),
            "Errors of the models on motions left out.",
            "Each type of motion left out in turn: what the other motions say of it.",
        )


def _provenance(told: Mapping[str, Any]) -> Iterator[Html]:
    made, cells = told["written_by"], told["cells"]
    engines = sorted({cell["source_sha256"][:12] for cell in cells.values()})
    hosts = sorted({cell["host"] for cell in cells.values()})
    seconds = sum(cell["seconds"] for cell in cells.values())
    yield tag(
        "p",
        f"Robots {', '.join(map(str, told['plan']['seeds']))}. {len(cells)} cells, "
        f"{seconds / 3600:.2f} hours in all on one core each, on {', '.join(hosts) or 'no host'}; "
        f"sources {', '.join(engines) or MISSING}; report by commit {made['git_sha'] or 'none'}"
        f"{' with changes' if made['dirty'] else ''}, {told['written']}.",
    )
    stopped = [
        f"{name}: {why}"
        for one in told["recordings"].values()
        for name, why in one["stopped"].items()
    ]
    failures = [f"{name}: {why}" for name, why in told["failed"].items()] + stopped
    yield tag("h3", "What failed")
    yield tag("ul", *(tag("li", line) for line in failures or ["nothing"]))
    yield from _policies(told["policies"])
    columns = [Column("Cell"), Column("Took [s]", "number"), Column("Digest of what it found")]
    rows = [(name, f"{c['seconds']:,.0f}", c["digest"][:16]) for name, c in cells.items()]
    yield table("Cells; `pup experiment --cell NAME` does one again and compares", columns, rows)


def _policies(told: Mapping[str, Any]) -> Iterator[Html]:
    if not told:
        return
    columns = [Column("Policy"), Column("Came", "words"), Column("Steps", "number")]
    columns += [Column("Bounds")]
    rows = [
        (
            name,
            "given" if policy["given"] else "trained here",
            MISSING if policy["steps"] is None else f"{policy['steps']:,}",
            (policy["bounds_sha256"] or MISSING)[:16],
        )
        for name, policy in told.items()
    ]
    yield table("Policies, with the digest of the bounds that each was trained on", columns, rows)

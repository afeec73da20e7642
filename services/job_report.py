"""The report of a whole job: one page that needs nothing but itself."""

import base64
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

from matplotlib.ticker import MaxNLocator

from pup.files import write_atomic
from pup.sysid.figures import BLUE, INK, SOFT, VERMILLION, as_svg, drawing_style, new_figure
from pup.sysid.html import Column, Drawing, Html, figure, page, table, tag
from services.diagnosis import CORRECTED
from services.rehearsal import rehearsal_figure, rehearsal_words
from services.stages import Done

TITLES = {
    "presysid": "Parameters and bounds",
    "replay": "Replay of the recordings",
    "train": "Training",
    "walk": "Walk in simulation",
    "transfer": "Walks of the virtual robot",
    "rehearsal": "Walks of the robot, made again in simulation",
    "diagnosis": "What the simulator leaves out",
    CORRECTED: "The same with the robot as it was found to be",
}


@dataclass(frozen=True)
class Job:
    """What a job came to.

    Attributes:
      robot: name.
      out: folder of the job.
      documents: of its stages, by name.
      done: what the journal tells of them.
      left_out: stages that were left out, and why.
    """

    robot: str
    out: Path
    documents: Mapping[str, Any]
    done: Mapping[str, Done]
    left_out: Mapping[str, str]


def title(stage: str) -> str:
    """What a stage is called; one of the second half says so."""
    half, kind = _parts(stage)
    return f"{TITLES[kind]}, corrected robot" if half else TITLES[kind]


def _parts(stage: str) -> tuple[str, str]:
    """The half's folder with a slash, empty for the first, and what is done in it."""
    half, _, kind = stage.rpartition("-")
    return (f"{half}/" if half else "", kind)


def write_report(job: Job) -> None:
    """Write `report.html`, whole or not at all."""
    with drawing_style():
        write_atomic(job.out / "report.html", page(f"Job of {job.robot}", *_content(job)))


def found(documents: Mapping[str, Any]) -> dict[str, str]:
    """What each stage found, in a few words.

    Args:
      documents: of the stages, by name.
    """
    words = {
        "presysid": _bounds_words,
        "replay": _replay_words,
        "train": _training_words,
        "walk": _walk_words,
        "transfer": _transfer_words,
        "rehearsal": rehearsal_words,
        "diagnosis": _diagnosis_words,
    }
    return {name: words[_parts(name)[1]](document) for name, document in documents.items()}


def _bounds_words(told: Mapping[str, Any]) -> str:
    known = [p["identified"] for p in told["parameters"]]
    train = told["loss"]["train"]
    words = f"{len(known)} parameters, {sum(known)} determined by the recordings; "
    if told["provenance"]["options"].get("as_described"):
        return words + f"values of the diagnosis, loss {train['loss']:.3g}"
    return words + f"loss {train['loss_before']:.3g} before, {train['loss']:.3g} after"


def _replay_words(told: Mapping[str, Any]) -> str:
    count = len(told["per_recording"])
    return f"joint error {told['rmse']:.3g} {told['unit']} over {count} recordings"


def _training_words(told: Mapping[str, Any]) -> str:
    start = told["provenance"]["start"]
    words = f"{told['steps']:,} steps, {told['direction']}, "
    if start is None:
        return words + "from scratch"
    words += "further from a policy"
    return words + (" that was trained on other bounds" if start["other_bounds"] else "")


def _walk_words(told: Mapping[str, Any]) -> str:
    shown = told["shown"]
    fell = f", fallen after {shown['time']:.1f} s" if shown["fell"] else ""
    return (
        f"{shown['distance']:.2f} m with the fitted parameters{fell}; median "
        f"{told['distance_median']:.2f} m in {told['time_median']:.1f} s over the bounds, "
        f"{told['upright_share']:.0%} without a fall"
    )


def _transfer_words(told: Mapping[str, Any]) -> str:
    searched = sum(w["purpose"] in ("initial", "search") for w in told["walks"])
    return (
        f"{searched} trials; chosen eta {spread(told['chosen'])}, "
        f"eta of the fitted parameters {spread(told['fitted'])}"
    )


def _diagnosis_words(told: Mapping[str, Any]) -> str:
    if told["verdict"] != "mismatch":
        return f"verdict {told['verdict']}" + (f": {told['reason']}" if told["reason"] else "")
    named = ", ".join(_finding(f) for f in told["findings"])
    if told["held_out"] is None:
        return named
    before, after = (1000 * told["held_out"][f"rmse_{when}"] for when in ("before", "after"))
    unit = "m" + told["position_unit"]
    return f"{named}; motions left out {before:.3g} {unit} before, {after:.3g} {unit} after"


def _finding(finding: Mapping[str, Any]) -> str:
    return f"{finding['effect'].replace('_', ' ')} ({finding['probability']:.0%})"


def spread(told: Mapping[str, Any]) -> str:
    """Mean and standard deviation of distances, in words."""
    if told["mean"] is None:
        return "not walked"
    deviation = "" if told["std"] is None else f" ± {told['std']:.2f}"
    return f"{told['mean']:.2f}{deviation} m"


def _content(job: Job) -> Iterator[Html]:
    yield tag("h1", f"Job of {job.robot}")
    yield tag(
        "p",
        "Recordings, bounds, a policy within them, and the eta with which a robot of concealed "
        "physics walks furthest; what the simulator leaves out, and the same with that in it. "
        "Distances of the virtual robot are results in simulation too.",
        class_="lead",
    )
    yield tag("dl", *_facts(job), class_="facts")
    yield from _stages(job)
    sections = {
        "presysid": _presysid,
        "replay": _replay,
        "train": _train,
        "walk": _walk,
        "transfer": _transfer,
        "rehearsal": _rehearsal,
        "diagnosis": _diagnosis,
    }
    for name, document in job.documents.items():
        half, kind = _parts(name)
        told = sections[kind](job, document, half)
        yield tag("section", tag("h2", title(name)), *told, id=name)
    yield tag("section", tag("h2", "Artefacts"), *_artefacts(job), id="artefacts")


def _facts(job: Job) -> Iterator[Html]:
    told = job.documents
    unit = told["replay"]["unit"]
    for half, of in (("", ""), (f"{CORRECTED}-", ", corrected")):
        if (replayed := told.get(f"{half}replay")) is None:
            continue
        before = told["presysid"]["loss"]["train"]["rmse_before"]
        more = f"before the fit: {before:.3g} {unit}"
        yield _fact(f"Joint error{of}", f"{replayed['rmse']:.3g} {unit}", more)
        if walked := told.get(f"{half}walk"):
            median = walked["distance_median"]
            fitted = f"median over the bounds; {walked['shown']['distance']:.2f} m as fitted"
            yield _fact(f"Walk in simulation{of}", f"{median:.2f} m", fitted)
        if tried := told.get(f"{half}transfer"):
            yield _fact(f"Virtual robot, chosen eta{of}", spread(tried["chosen"]), "")
            yield _fact(f"Virtual robot, eta fitted{of}", spread(tried["fitted"]), "no trials")
        if again := told.get(f"{half}rehearsal"):
            walked = f"{again['distance']:.2f} m by the robot"
            yield _fact(f"Its walks, simulated{of}", f"{again['simulated_distance']:.2f} m", walked)


def _fact(name: str, value: str, more: str) -> Html:
    return tag("div", tag("dt", name), tag("dd", value, *([tag("small", more)] if more else [])))


def _stages(job: Job) -> Iterator[Html]:
    words = found(job.documents)
    rows = [(title(n), f"{job.done[n].seconds:,.0f}", words[n]) for n in job.documents]
    rows += [(TITLES[name], "", f"left out: {why}") for name, why in job.left_out.items()]
    columns = [Column("Stage"), Column("Took [s]", "number"), Column("Found", "long")]
    yield table("Stages, with the time since each was last interrupted", columns, rows)


def _presysid(job: Job, told: Mapping[str, Any], half: str) -> Iterator[Html]:
    columns = [Column("Parameter"), Column("Unit", "words")]
    columns += [Column(t, "number") for t in ("Nominal", "Lower", "Upper")]
    rows = [
        (p["name"], p["unit"], *(f"{p[k]:.4g}" for k in ("nominal", "lower", "upper")))
        for p in told["parameters"]
    ]
    vague = ["" if p["identified"] else "unknown" for p in told["parameters"]]
    yield table("Bounds (grey: not identified by these recordings)", columns, rows, vague)
    yield tag(
        "p", "More: ", tag("a", "the report of pre-sysID", href=f"{half}presysid/report.html"), "."
    )


def _replay(job: Job, told: Mapping[str, Any], half: str) -> Iterator[Html]:
    columns = [Column("Recording", "long"), Column(f"RMSE [{told['unit']}]", "number")]
    rows = [(name, f"{error:.3g}") for name, error in told["per_recording"].items()]
    yield table("Joint error of the fitted model", columns, rows)


def _train(job: Job, told: Mapping[str, Any], half: str) -> Iterator[Html]:
    yield tag("p", f"{_training_words(told)}.")
    yield _picture(
        job.out / f"{half}train" / "curve.png",
        f"Curves of the training over {told['steps']:,} steps.",
        "While still exploring: distance, time before the fall, reward and divergence over steps.",
    )


def _walk(job: Job, told: Mapping[str, Any], half: str) -> Iterator[Html]:
    shown = told["shown"]
    end = "fell" if shown["fell"] else "stayed up"
    yield tag("p", f"{_walk_words(told)}.")
    yield _picture(
        job.out / f"{half}walk" / "gait.png",
        f"Stick figures of the walk, {shown['distance']:.2f} m in {shown['time']:.1f} s.",
        f"With the fitted parameters: {shown['distance']:.2f} m in {shown['time']:.1f} s, {end}.",
    )
    video = Path(told["video"]).name
    yield tag("p", "The walk as a ", tag("a", "video", href=f"{half}walk/{video}"), ".")


def _transfer(job: Job, told: Mapping[str, Any], half: str) -> Iterator[Html]:
    yield tag(
        "p",
        f"Walks of at most {told['horizon']:g} s, through gateway, agent and servo bus, of the "
        f"virtual robot {told['virtual_robot']}. Chosen eta: {_eta(told['eta'])}; "
        f"eta of the fitted parameters: {_eta(told['fitted_eta'])}.",
    )
    yield figure(
        trials_figure(told),
        f"Distance of each walk in order and the best so far; {_transfer_words(told)}.",
        "Dots: trials of the search; line: the best so far; afterwards, in turn, walks of the "
        "chosen eta and of the fitted parameters' eta.",
    )
    rows = [(name, spread(told[key]), _walks(told[key])) for name, key in _COMPARED.items()]
    columns = [Column("Eta", "words"), Column("Mean ± sd", "number"), Column("Walks [m]", "long")]
    yield table("After the search", columns, rows)
    columns = [Column("Walk"), Column("Purpose", "words"), Column("Eta", "words")]
    columns += [Column("Distance [m]", "number"), Column("Time [s]", "number"), Column("End")]
    rows = [
        (
            str(w["number"]),
            w["purpose"],
            _eta(w["eta"]),
            "" if w["distance"] is None else f"{w['distance']:.3f}",
            "" if w["time"] is None else f"{w['time']:.1f}",
            w["reason"] if w["state"] == "succeeded" else f"{w['state']}: {w['reason']}",
        )
        for w in told["walks"]
    ]
    yield table("All walks", columns, rows)


def _rehearsal(job: Job, told: Mapping[str, Any], half: str) -> Iterator[Html]:
    yield tag("p", f"{rehearsal_words(told)}.")
    yield figure(
        as_svg(rehearsal_figure(told)),
        "Distances in simulation over those of the robot, a dot for each eta.",
        "A dot for each eta that the robot walked by the first half's policy; line: where both "
        "walk alike. Bars: standard errors of the simulated means.",
    )


def _diagnosis(job: Job, told: Mapping[str, Any], half: str) -> Iterator[Html]:
    yield tag("p", f"{_diagnosis_words(told)}.")
    if told["findings"]:
        columns = [Column("Effect", "words"), Column("Place", "long"), Column("Regime", "words")]
        columns += [Column("Probability", "number"), Column("Law", "long")]
        rows = [
            (
                finding["effect"].replace("_", " "),
                f"{finding['place']['kind']} {', '.join(finding['place']['names'])}".strip(),
                finding["regime"],
                f"{finding['probability']:.0%}",
                finding["law"] or "none that held",
            )
            for finding in told["findings"]
        ]
        yield table("What was found, by how much it explains", columns, rows)
    link = tag("a", "the report of the diagnosis", href=f"{half}diagnosis/report.html")
    yield tag("p", "More: ", link, ".")


_COMPARED = {"chosen": "chosen", "of the fitted parameters": "fitted"}


def _eta(eta: list[float]) -> str:
    return ", ".join(f"{x:+.2f}" for x in eta)


def _walks(told: Mapping[str, Any]) -> str:
    return ", ".join(f"{d:.2f}" for d in told["distance"])


def trials_figure(told: Mapping[str, Any]) -> Drawing:
    """Distances of the walks in their order, and the best trial so far.

    Args:
      told: document of `transfer.json`.
    """
    walked = [w for w in told["walks"] if w["distance"] is not None]
    searched = [w for w in walked if w["purpose"] in ("initial", "search")]
    axes = (drawn := new_figure(4.6, 2.9)).subplots()
    best = accumulate((w["distance"] for w in searched), max)
    axes.step(
        [w["number"] for w in searched], list(best), where="post", color=SOFT, label="best so far"
    )
    for label, colour, purposes in (
        ("trial", INK, ("initial", "search")),
        ("chosen eta", VERMILLION, ("repeat",)),
        ("eta of the fitted parameters", BLUE, ("compare",)),
    ):
        chosen = [w for w in walked if w["purpose"] in purposes]
        x, y = [w["number"] for w in chosen], [w["distance"] for w in chosen]
        axes.plot(x, y, "o", markersize=4, color=colour, label=label)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("walk")
    axes.set_ylabel("distance, m")
    axes.grid(axis="y")
    drawn.legend(loc="outside upper left", ncols=2, fontsize=8)
    return as_svg(drawn)


def _picture(file: Path, alt: str, caption: str) -> Html:
    source = "data:image/png;base64," + base64.b64encode(file.read_bytes()).decode()
    image = tag("img", src=source, alt=alt, style="width: 100%")
    return tag("figure", image, tag("figcaption", caption))


def _artefacts(job: Job) -> Iterator[Html]:
    columns = [Column("File", "words"), Column("Stage"), Column("SHA-256", "long")]
    rows = [
        (f, name, digest) for name, done in job.done.items() for f, digest in done.files.items()
    ]
    yield table("What the job left, and its SHA-256", columns, rows)
    columns = [Column("Stage"), Column("Input", "words"), Column("SHA-256, or what it is", "long")]
    rows = [
        (name, what, is_) for name, done in job.done.items() for what, is_ in done.inputs.items()
    ]
    yield table("What each stage depends on", columns, rows)

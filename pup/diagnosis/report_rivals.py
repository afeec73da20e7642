"""The section of the report that holds the diagnosis against a black box and the paper's NN-PD."""

from collections.abc import Iterator, Mapping

from pup.diagnosis import summary
from pup.diagnosis.figures_rivals import rival_dots
from pup.diagnosis.folds import fold_words
from pup.diagnosis.residuals import Measured
from pup.diagnosis.result import Diagnosis
from pup.diagnosis.rivals import DIAGNOSED, NETWORK, NN_PD, NOMINAL, Errors, Rivals
from pup.diagnosis.wording import Speech, capital, minus, percent, spoken
from pup.sysid.html import Column, Html, figure, table, tag
from pup.sysid.wording import counted, listed, thousandths

LABELS = {
    NOMINAL: "nominal model",
    NN_PD: "NN-PD",
    NETWORK: "residual network",
    DIAGNOSED: "corrected model",
}


def beside(diagnosis: Diagnosis, speech: Speech, rivals: Rivals | None) -> Iterator[Html]:
    """What the corrected model is worth beside others that were fitted to the same recordings."""
    if rivals is None:
        return
    yield tag("p", _about(rivals, diagnosis.measured, speech))
    errors = dict(rivals.errors)
    if not summary.corrected(diagnosis):
        del errors[DIAGNOSED]  # it is the nominal model
    motions = list(errors[NOMINAL].per_motion)
    drawing = rival_dots(
        motions,
        {name: [e.per_motion[motion] for motion in motions] for name, e in errors.items()},
        LABELS,
        speech.units.small,
        summary.joint_noise(diagnosis),
    )
    told = takeaway(errors, speech)
    yield figure(drawing, f"Errors of {len(errors)} models by type of motion. {told}", told)
    yield _models(errors, motions, rivals, speech)
    joints = list(errors[NOMINAL].per_joint)
    if len(joints) > 1:
        yield _joints(errors, joints, speech)


def takeaway(errors: Mapping[str, Errors], speech: Speech) -> str:
    """Which model is best on motions left out, and in how many types of motion."""
    ranked = sorted(errors, key=lambda name: errors[name].overall)
    best, others = ranked[0], ranked[1:]
    motions = list(errors[best].per_motion)
    wins = [m for m in motions if best == min(errors, key=lambda n: errors[n].per_motion[m])]
    others_told = listed(
        [f"{_named(name)}'s {thousandths(errors[name].overall)}" for name in others]
    )
    return (
        f"{capital(_named(best))}'s error on motions left out is the smallest: "
        f"{thousandths(errors[best].overall)} {speech.units.small}, against {others_told}; it is "
        f"the best in {len(wins)} of {counted(len(motions), 'type')} of motion."
    )


def _named(model: str) -> str:
    """A model within a sentence."""
    return LABELS[model] if model == NN_PD else f"the {LABELS[model]}"


def _about(rivals: Rivals, measured: Measured, speech: Speech) -> str:
    """What the rivals are and how they were fitted."""
    network = (
        "The residual network learns what the nominal model's simulation leaves of a reading from "
        "what that simulation knows then and just before."
    )
    whole = (
        "Each model was fitted to the same recordings without one "
        f"{fold_words(measured)} and predicts it."
    )
    if rivals.nn_pd_fit is None:
        return f"{network} {whole}"
    before, after = (thousandths(value) for value in rivals.nn_pd_fit)
    return (
        "NN-PD is the paper's servo, whose gains come from a small network; its fit lowers its "
        f"error on what it was fitted to from {before} to {after} {speech.units.small}. {network} "
        f"{whole}"
    )


def _models(
    errors: Mapping[str, Errors], motions: list[str], rivals: Rivals, speech: Speech
) -> Html:
    """Errors by model and type of motion, and how much better the corrected model is."""
    columns = [Column("Model"), Column("All", "number")]
    columns += [Column(motion, "number") for motion in motions]
    mended = DIAGNOSED in errors
    columns += [Column("Corrected is better by (90 % interval)", "number")] if mended else []
    rows = []
    for name, error in errors.items():
        values = [error.overall, *(error.per_motion[motion] for motion in motions)]
        row = [LABELS[name], *map(thousandths, values)]
        if mended:
            ends = rivals.better.get(name)
            row.append(minus(f"{percent(ends[0])} to {percent(ends[1])}") if ends else "")
        rows.append(row)
    caption = f"Root mean square errors of the joints on motions left out [{speech.units.small}]"
    return table(caption, columns, rows)


def _joints(errors: Mapping[str, Errors], joints: list[str], speech: Speech) -> Html:
    """Errors by joint and model."""
    columns = [Column("Joint"), *(Column(LABELS[name], "number") for name in errors)]
    rows = [
        [spoken(joint), *(thousandths(e.per_joint[joint]) for e in errors.values())]
        for joint in joints
    ]
    return table(f"The same by joint [{speech.units.small}]", columns, rows)

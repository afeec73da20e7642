"""The section of the report on the nominal fit: whether to trust it, its parameters, its data."""

from collections.abc import Iterator

import numpy as np

from pup.diagnosis import summary
from pup.diagnosis.fit import Fit
from pup.diagnosis.folds import fold_words
from pup.diagnosis.nominal import SELF
from pup.diagnosis.result import Diagnosis
from pup.diagnosis.wording import Speech, capital, change, digits, parameter_words
from pup.physics.terms import split_column
from pup.sysid.html import Column, Html, table, tag
from pup.sysid.wording import counted, setup, thousandths

BAND = 1.645
"""Standard deviations of a 90 % interval."""


def nominal(diagnosis: Diagnosis, speech: Speech) -> Iterator[Html]:
    """Certificate, noise, parameters and recordings."""
    yield tag("p", _certificate(diagnosis))
    if len(diagnosis.measured.values):
        yield tag("p", _noise(diagnosis, speech))
    if diagnosis.too_long:
        yield tag("p", _substeps(diagnosis))
    yield tag(
        "p",
        f"{len(diagnosis.measured.values):,} readings were compared with "
        f"{diagnosis.replays:,} simulations.",
    )
    if diagnosis.nominal.certificate.made:
        yield _parameters(diagnosis, speech)
    yield _recordings(diagnosis, speech)


def _certificate(diagnosis: Diagnosis) -> str:
    told = diagnosis.nominal.certificate
    if not told.made:
        return "Nothing was fitted: these recordings could not tell what is right."
    ends = ", ".join(f"{chi2:,.1f}" for chi2 in told.starts)
    text = (
        "An optimiser that stops short looks like missing physics, so the fit is checked twice. "
        f"From {counted(len(told.starts), 'start')} it ends at chi-squared {ends}: the best two "
    )
    if not told.agree:
        return text + "do not agree."
    text += (
        "agree. Fitted to a simulation of itself it comes back to within "
        f"{max(told.recovered, 0.1):.1f} standard deviations ({SELF:g} are allowed)"
    )
    if told.recovered <= SELF:
        return f"{text}."
    return f"{text}, but leaves no more than {told.left / told.samples:.1%} of the noise there."


def _substeps(diagnosis: Diagnosis) -> str:
    """That the robot's own sub-steps are too long, and what was done about it."""
    own, used = (1e3 * step for step in (diagnosis.too_long, diagnosis.robot.timestep))
    return (
        f"The robot's sub-steps of {own:g} ms are too long for what was recorded on the ground: in "
        f"shorter ones it moves otherwise by more than the noise of the readings hides. So all was "
        f"simulated in sub-steps of {used:g} ms, and the corrected robot has these."
    )


def _noise(diagnosis: Diagnosis, speech: Speech) -> str:
    noise, joints = diagnosis.noise, len(diagnosis.robot.joints)
    read = [c for c in summary.channels(diagnosis) if c < joints]
    sigma = noise.sigma[read]
    spread = thousandths(float(sigma.min()))
    if len(read) > 1:
        spread += f" to {thousandths(float(sigma.max()))}"
    source = "assumed from how readings flicker at rest, as no motion was repeated"
    if noise.source == "repeats":
        source = "measured from what differs between repeats of one motion"
    elif not diagnosis.nominal.certificate.made:
        source = "assumed: what is usual of such sensors"
    text = f"Noise of the joints: {spread} {speech.units.small}, {source}"
    tilts = [c for c in summary.channels(diagnosis) if c >= joints]
    if tilts:
        text += f"; of the torso's angles {thousandths(float(noise.sigma[tilts].max()))} mrad"
    rho = float(noise.rho[read].mean()) if read else 0.0
    text += f". From tick to tick it is correlated by {rho:.2f}."
    if noise.late:
        late = speech.quantity(noise.late, "s")
        text += f" Done again, a motion comes earlier or later by ±{late}, which weighs as noise."
    return text


def _parameters(diagnosis: Diagnosis, speech: Speech) -> Html:
    """Nominal parameters in the robot's file, after the nominal fit, and corrected."""
    robot = {p.name: p for p in diagnosis.robot.parameters}
    before = _intervals(diagnosis.nominal.fit)
    corrected = summary.models(diagnosis).get("corrected")
    after = _intervals(corrected.fit) if corrected else {}
    columns = [Column("Parameter"), Column("Unit", "words"), Column("Robot's file", "number")]
    columns.append(Column("Nominal fit", "number"))
    if corrected:
        columns += [Column("Corrected", "number"), Column("Nominal fit was off by", "number")]
    rows = []
    for name, (value, reach) in before.items():
        known = robot.get(name)
        row = [
            parameter_words(name),
            speech.unit(known.unit) if known else "",
            digits(known.nominal, 4) if known else "",
            _with(value, reach),
        ]
        if name in after:
            row += [_with(*after[name]), change(value / after[name][0] - 1)]
        rows.append(row)
    return table("Nominal parameters, with half of their 90 % intervals", columns, rows)


def _with(value: float, reach: float) -> str:
    return f"{digits(value, 4)} ± {digits(reach, 2)}"


def _intervals(fit: Fit) -> dict[str, tuple[float, float]]:
    """Nominal parameters of a fit, each with half of its 90 % interval."""
    deviation = np.sqrt(np.diag(fit.covariance()))
    return {
        c.name: (c.value(at), BAND * sigma * c.slope(at))
        for c, at, sigma in zip(fit.coordinates, fit.at, deviation, strict=True)
        if split_column(c.name) is None
    }


def _recordings(diagnosis: Diagnosis, speech: Speech) -> Html:
    """What was recorded, and how well each is predicted when its type is left out."""
    measured = diagnosis.measured
    joints = measured.channel < len(diagnosis.robot.joints)
    models = summary.models(diagnosis)
    columns = [Column("Recording", "long"), Column("Motion"), Column("Support")]
    columns += [Column("Duration [s]", "number"), Column("Readings", "number")]
    columns += [Column(f"{capital(name)} [{speech.units.small}]", "number") for name in models]
    knobs = any(r.setup for r in measured.recordings)
    columns += [Column("Setup", "words")] if knobs else []
    rows = []
    for number, recording in enumerate(measured.recordings):
        inside = joints & (measured.recording == number)
        row = [recording.id, recording.motion, recording.support]
        row += [f"{np.ptp(recording.time):.1f}", f"{int((measured.recording == number).sum())}"]
        for model in models.values():
            error = (measured.values - model.predicted)[inside]
            row.append(thousandths(float(np.sqrt(np.mean(error**2)))) if inside.any() else "none")
        rows.append([*row, setup(recording)] if knobs else row)
    caption = "Recordings"
    if models:
        left = "themselves" if (one := fold_words(measured)) == "recording" else f"their {one}"
        caption += f", with the joint errors of models that were fitted without {left}"
    return table(caption, columns, rows)

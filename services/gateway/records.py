"""Studies and trials as rows and as JSON values, and back."""

from dataclasses import asdict, fields
from typing import Any

from pup.transfer.study import Gate, Study, StudySettings, StudyState
from pup.transfer.trial import Purpose, Result, Trial, TrialState
from services.gateway.jobs import Attempt, Job, JobState

Row = dict[str, Any]


def settings_of(told: Row) -> StudySettings:
    """Settings from their JSON values; what a newer gateway added is left out."""
    known = {f.name: told[f.name] for f in fields(StudySettings) if f.name in told}
    for name in ("lower", "upper"):
        if name in known:
            known[name] = tuple(map(float, known[name]))
    known["compare"] = tuple(tuple(map(float, eta)) for eta in known.get("compare", ()))
    return StudySettings(**known | {"gate": Gate(known.get("gate", Gate.OPERATOR))})


def _stored(told: Row) -> StudySettings:
    """Settings that were stored, when more of the trials than there were could be initial."""
    most = told.get("trials", StudySettings.trials)
    return settings_of(told | {"initial": min(told.get("initial", StudySettings.initial), most)})


def study_row(study: Study) -> Row:
    """The row of a study, without its trials."""
    return {
        "name": study.name,
        "state": study.state.value,
        "reason": study.reason,
        "fence": study.fence,
        "chosen": None if study.chosen is None else list(study.chosen),
        "settings": asdict(study.settings),
        "mark": study.mark,
    }


def trial_row(trial: Trial) -> Row:
    """The row of a trial; its mark is its study's."""
    row = {f.name: getattr(trial, f.name) for f in fields(Trial) if f.name != "mark"}
    return row | {
        "eta": list(trial.eta),
        "purpose": trial.purpose.value,
        "state": trial.state.value,
        "result": None if trial.result is None else asdict(trial.result),
    }


def trial_of(row: Row, mark: str) -> Trial:
    """The trial of a row, of the study that has a mark."""
    result = row["result"]
    return Trial(
        **{f.name: row[f.name] for f in fields(Trial) if f.name != "mark"}
        | {
            "mark": mark,
            "eta": tuple(row["eta"]),
            "purpose": Purpose(row["purpose"]),
            "state": TrialState(row["state"]),
            "result": result and Result(**result | {"state": TrialState(result["state"])}),
        }
    )


def study_of(row: Row, trials: list[Row]) -> Study:
    """The study of its row and its trials' rows."""
    return Study(
        row["name"],
        _stored(row["settings"]),
        StudyState(row["state"]),
        row["reason"],
        row["fence"],
        None if row["chosen"] is None else tuple(row["chosen"]),
        tuple(sorted((trial_of(t, row["mark"]) for t in trials), key=lambda t: t.number)),
        row["mark"],
    )


def trial_document(trial: Trial) -> Row:
    """A trial as the REST interface tells it."""
    result = trial.result
    return {
        "id": trial.id,
        "number": trial.number,
        "eta": list(trial.eta),
        "purpose": trial.purpose.value,
        "state": trial.state.value,
        "attempt": trial.attempt,
        "agent": trial.agent,
        "released": trial.released,
        "distance": result.distance if result else None,
        "time": result.time if result else None,
        "reason": result.reason if result else "",
        "recording": result.recording if result else None,
        "digest": result.digest if result else None,
    }


def study_document(study: Study) -> Row:
    """A study as the REST interface tells it, without its trials."""
    walked = [t for t in study.searched if t.result and t.result.distance is not None]
    best = max(walked, key=lambda t: t.result.distance or 0.0, default=None)
    return {
        "name": study.name,
        "state": study.state.value,
        "reason": study.reason,
        "chosen": None if study.chosen is None else list(study.chosen),
        "walks": len(study.searched),
        "trials": len(study.trials),
        "farthest": best.result.distance if best and best.result else None,
        "open": study.open.number if study.open else None,
        "settings": asdict(study.settings),
    }


def job_row(job: Job) -> Row:
    """The row of a job."""
    return asdict(job) | {"arguments": list(job.arguments), "state": job.state.value}


def job_of(row: Row) -> Job:
    """The job of a row."""
    attempts = tuple(Attempt(**attempt) for attempt in row["attempts"])
    told = {"arguments": tuple(row["arguments"]), "state": JobState(row["state"])}
    return Job(**row | told | {"attempts": attempts})


def job_document(job: Job) -> Row:
    """A job as the REST interface tells it."""
    return asdict(job) | {"state": job.state.value}

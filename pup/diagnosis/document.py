"""`diagnosis.json` (docs/diagnosis.md)."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from pup.diagnosis.held_out import HeldOut
from pup.diagnosis.knocks import SHAKEN
from pup.diagnosis.laws import contract_name
from pup.diagnosis.regimes import Window
from pup.diagnosis.result import Diagnosis
from pup.diagnosis.verdict import Alternative, Finding
from pup.diagnosis.wording import SLIDING
from pup.physics.terms import TERMS, Term
from pup.robot import RobotDescription
from pup.sysid.accuracy import JointUnits

SCHEMA = 1
ALL_SERVOS = frozenset(
    name for name, term in TERMS.items() if term.kinds == Term.kinds and name != "thermal_drift"
)
"""Effects of which the contract knows joints and groups, not the robot."""


def document(diagnosis: Diagnosis, corrected: str) -> dict[str, Any]:
    """A diagnosis as JSON values.

    Args:
      diagnosis: what was found.
      corrected: path of the corrected robot.
    """
    robot, noise = diagnosis.robot, diagnosis.noise
    joints = len(robot.joints)
    certificate = diagnosis.nominal.certificate
    position = JointUnits.of(robot, diagnosis.measured.recordings).position
    units = SLIDING if position == "m" else {}
    return {
        "schema": SCHEMA,
        "robot": robot.name,
        "position_unit": position,
        "verdict": diagnosis.verdict,
        "reason": "; ".join(
            filter(None, (diagnosis.reason, _lost(diagnosis), _unjudged(diagnosis)))
        ),
        "converged": certificate.holds,
        "noise_floor": {
            "rms": float(np.sqrt(np.mean(noise.sigma[:joints] ** 2))),
            "source": noise.source,
        },
        "findings": [_finding(f, diagnosis, units) for f in diagnosis.findings],
        "held_out": _held_out(diagnosis.held_out, diagnosis.origins),
        "next_recording": diagnosis.ask.document() if diagnosis.ask else None,
        "corrected_robot": corrected,
        "certificate": {
            "chi2": list(certificate.starts),
            "recovered": certificate.recovered if certificate.agree else None,
        },
        "nominal": {n: float(v) for n, v in diagnosis.nominal.fit.values.items()},
        "timestep": robot.timestep,
        "samples": len(diagnosis.measured.values),
        "simulations": diagnosis.replays,
    }


def _lost(diagnosis: Diagnosis) -> str:
    if not diagnosis.lost:
        return ""
    return f"left out, as nothing found in the others explains them: {', '.join(diagnosis.lost)}"


def _unjudged(diagnosis: Diagnosis) -> str:
    """What was not looked at, where nothing was found in the rest: it may show an effect alone."""
    if diagnosis.verdict != "none" or not diagnosis.unjudged:
        return ""
    told = ", ".join(diagnosis.unjudged)
    return f"not judged, as a joint met its stop: {SHAKEN:g} s after that in {told}"


def _finding(finding: Finding, diagnosis: Diagnosis, units: Mapping[str, str]) -> dict[str, Any]:
    robot = diagnosis.robot
    return {
        "effect": contract_name(finding.effect),
        "place": _place(finding, robot),
        "regime": finding.regime,
        "when": [_window(window, diagnosis.origins) for window in finding.when],
        "parameters": {
            name: {
                "value": p.value,
                "unit": units.get(p.unit, p.unit),
                "ci90": [p.lower, p.upper],
            }
            for name, p in finding.parameters.items()
        },
        "probability": round(finding.probability, 6),
        "equivalents": [
            {
                "effect": contract_name(a.effect),
                "place": _place(a, robot),
                "probability": round(a.probability, 6),
            }
            for a in finding.equivalents
        ],
        "absorbed_by": dict(finding.absorbed_by),
        "law": finding.law,
    }


def _window(window: Window, origins: Mapping[str, tuple[str, float]]) -> dict[str, Any]:
    """A stretch of time, of a part in seconds of the recording that it was cut from."""
    recording, begin = origins.get(window.recording, (window.recording, 0.0))
    return {"recording": recording, "start": begin + window.start, "end": begin + window.end}


def _place(claim: Finding | Alternative, robot: RobotDescription) -> dict[str, Any]:
    """A place by the contract's kinds: what all servos do is told as of all groups."""
    place = claim.place
    if place.kind == "robot" and claim.effect in ALL_SERVOS:
        return {"kind": "group", "names": list(robot.groups)}
    named = {"bus": "bus", "robot": robot.name, "ground": "floor", "sensor": "imu"}
    return {"kind": place.kind, "names": [place.name or named[place.kind]]}


def _held_out(
    errors: HeldOut | None, origins: Mapping[str, tuple[str, float]]
) -> dict[str, Any] | None:
    if errors is None:
        return None
    return {
        "recordings": list(dict.fromkeys(origins.get(r, (r, 0.0))[0] for r in errors.recordings)),
        "rmse_before": errors.before,
        "rmse_after": errors.after,
        "improvement_ci90": list(errors.interval),
        "per_joint": {n: {"before": b, "after": a} for n, (b, a) in errors.per_joint.items()},
        "per_motion": {n: {"before": b, "after": a} for n, (b, a) in errors.per_motion.items()},
    }

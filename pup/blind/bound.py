"""How little a refit can leave, by the nominal model that a diagnosis tells.

What the best refit leaves is a minimum over the nominal parameters: what any of them leave bounds
it from above. The key's own refit may have missed the best; where the parameters of a diagnosis
come nearer to the truth, in the generator's simulation, it is those that count.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pup.blind.absorb import CLEAR, Visibility, labelled, shifted, view
from pup.blind.claims import VERDICTS
from pup.blind.reference import Reference, readings
from pup.blind.refit import Refit
from pup.blind.sensors import Noise
from pup.blind.world import Effect, Engine, Nominal, Plan, World, nominal_names
from pup.errors import InputError
from pup.recording import Recording, load_recordings
from pup.robot import RobotDescription

SAME = 0.1  # relative, to which the truth must be what the key tells of it before a refit
EDGE = 1e-9  # relative, by which a parameter may be past its bounds
VIEWS = ("effect_seen", "all_seen")

Lower = dict[str, dict[str, float]]
"""By view, SNR and absorbed share: what the key tells and what counts instead."""


@dataclass(frozen=True)
class Found:
    """What is simulated of a view.

    Attributes:
      whole: SNR before a refit.
      view: what the parameters of a diagnosis leave.
    """

    whole: float
    view: Visibility


def bounded(
    truth: Mapping[str, Any], case: Path, robot: RobotDescription, nominal: object
) -> tuple[Mapping[str, Any], Lower | None]:
    """Put what a diagnosis's nominal model leaves in the place of what the key's refit leaves.

    Args:
      truth: the case's entry in the key.
      case: its folder in the set.
      robot: of the case.
      nominal: the nominal parameters that the diagnosis tells, of whatever kind.

    Returns:
      The entry with what is the lower, and what was lowered; None where nothing could be compared:
      no such model, or a truth that cannot be simulated anew from its key.
    """
    told = {name: truth[name] for name in VIEWS if (truth.get(name) or {}).get("snr")}
    values = usable(robot, bool(truth.get("ground")), nominal)
    if values is None or not told or "nominal" not in truth:
        return truth, None
    try:
        found = _found(truth, told, _plans(case), robot, values)
    except InputError:  # parameters under which the simulation breaks down tell nothing
        return truth, None
    if not all(_same(told[name], found[name]) for name in told):
        return truth, None
    nearer = {name: _nearer(told[name], found[name].view) for name in told}
    lower = {
        name: {
            **{f"key_{of}": told[name][of] for of in ("snr", "absorbed")},
            **{of: seen[of] for of in ("snr", "absorbed")},
        }
        for name, seen in nearer.items()
        if seen is not told[name]
    }
    return _relabelled({**truth, **nearer}, lower), lower


def usable(robot: RobotDescription, ground: bool, nominal: object) -> dict[str, float] | None:
    """The parameters of a nominal fit; None where one is missing, no number or out of bounds."""
    if not isinstance(nominal, Mapping):
        return None
    search = {spec.name: spec.search for spec in robot.parameters}
    values = {name: nominal.get(name) for name in nominal_names(robot, ground)}
    for name, value in values.items():
        low, high = search[name]
        if not isinstance(value, int | float):
            return None
        if not low * (1 - EDGE) <= value <= high * (1 + EDGE):  # nor is what is no number
            return None
    return {name: float(value) for name, value in values.items() if value is not None}


def _plans(case: Path) -> list[Plan]:
    """What was done in a case, as its recordings tell."""
    kinds = [kind for kind in ("recordings", "test") if (case / kind).is_dir()]
    return [_plan(one, kind == "test") for kind in kinds for one in load_recordings([case / kind])]


def _plan(recording: Recording, test: bool) -> Plan:
    power = recording.extras.get("torque_enabled")
    return Plan(
        recording.id,
        recording.motion,
        recording.support,
        recording.time,
        recording.target,
        enabled=None if power is None else power > 0.5,
        setup=recording.setup,
        repeat_of=recording.repeat_of,
        test=test,
    )


def _found(
    truth: Mapping[str, Any],
    names: Iterable[str],
    plans: list[Plan],
    robot: RobotDescription,
    values: Mapping[str, float],
) -> dict[str, Found]:
    """What nominal parameters leave in each view: of the effects alone, or of all there is."""
    effects, nuisance = (
        tuple(Effect.of(told) for told in truth[kind]) for kind in ("effects", "nuisance")
    )
    engine, seed = Engine(**truth["engine"]), truth.get("physics_seed", 0)
    nominal = Nominal.of(robot, truth["nominal"])
    noise = Noise(**{name: v for name, v in truth["noise"].items() if name != "sigma"})
    origin = Reference.of(World(robot, nominal), plans, truth["nominal"])
    (model,) = origin.tried([values])

    def seen(*some: Effect) -> Any:
        return readings(World(robot, nominal, some, engine, seed), origin.plans)[0]

    full = seen(*effects, *nuisance)
    background = seen(*nuisance) if nuisance and effects else None
    against = {"effect_seen": background, "all_seen": None}
    refits = {n: Refit(origin, shifted(origin, full, against[n]), noise) for n in names}
    return {
        name: Found(
            refit.still(origin.values, origin.stacked()).off,
            view(refit, refit.still(values, model)),
        )
        for name, refit in refits.items()
    }


def _whole(told: Mapping[str, Any]) -> float:
    """SNR before a refit."""
    return float(told["snr"] / (1.0 - told["absorbed"]))


def _same(told: Mapping[str, Any], found: Found) -> bool:
    """Whether a truth simulated anew is what the key tells of; old keys lack what some need."""
    return abs(found.whole - _whole(told)) <= SAME * _whole(told)


def _nearer(told: Mapping[str, Any], found: Visibility) -> Mapping[str, Any]:
    """What is told, or what is found where that is less.

    Readings that were lost are not simulated anew, so it is shares that are compared.
    """
    if found.absorbed <= told["absorbed"]:
        return told
    return {**found.document(), "snr": _whole(told) * (1.0 - found.absorbed)}


def _relabelled(truth: dict[str, Any], lower: Lower) -> dict[str, Any]:
    """An entry of the stratum that a lowered omission belongs to.

    What is not clear to a matched filter is `weak`, whatever it was drawn for.
    """
    stratum = truth["stratum"]
    yardstick = next((name for name in VIEWS if name in truth), "")
    if yardstick not in lower or stratum.startswith("null:") or stratum == "unidentifiable":
        return truth
    seen = truth[yardstick]
    stratum = labelled(stratum, seen, truth["noise"]["sigma"]) if seen["snr"] >= CLEAR else "weak"
    weak = {"answer": {**truth["answer"], "verdicts": list(VERDICTS)}} if stratum == "weak" else {}
    return {**truth, **weak, "stratum": stratum}

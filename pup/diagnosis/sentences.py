"""Each finding as a sentence that a mechanic understands, with its size in the units of a bench."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pup.diagnosis.laws import NAMELESS, WORDS
from pup.diagnosis.result import Diagnosis
from pup.diagnosis.summary import described
from pup.diagnosis.verdict import Finding
from pup.diagnosis.wording import Speech, capital, digits, effect_words, minus, percent
from pup.physics.terms import TERMS, column
from pup.sysid.wording import listed

SLOW, TARDY = 1 / 100, 1 / 5000
"""A goal that is allowed more than 100 rad/s, or 5000 rad/s2, goes as it likes."""
QUARTER = np.pi / 2
AWHILE = 10.0
"""Time that a drift is told for, s."""
MOSTLY = 0.5
"""A law that explains a smaller share of something does not describe it."""


@dataclass(frozen=True)
class Facts:
    """What a sentence is made of.

    Attributes:
      speech: of the robot.
      finding: what it tells of.
      size: the finding's quantities, in the library's units.
      stiffness: of the servo there, N m/rad; NaN where the place has none of its own.
      strength: largest torque of a servo, N m.
    """

    speech: Speech
    finding: Finding
    size: Mapping[str, float]
    stiffness: float
    strength: float

    @property
    def at(self) -> str:
        """The place."""
        return self.speech.place(self.finding.place, self.finding.effect)

    @property
    def s(self) -> str:
        """The ending of a verb whose subject is the place."""
        kind = self.finding.place.kind
        return "" if kind in ("group", "bus", "robot") else "s"

    def along(self) -> str:
        """The components of a vector that matter."""
        unit = next(q.unit for q in TERMS[self.finding.effect].quantities if q.name in self.size)
        largest = max(abs(v) for v in self.size.values())
        told = [
            f"{self.speech.quantity(v, unit)} {'along' if n in 'xyz' else 'in'} {n}"
            for n, v in self.size.items()
            if abs(v) >= 0.2 * largest
        ]
        return listed(told)

    def length(self) -> float:
        """The length of a vector."""
        return float(np.linalg.norm(list(self.size.values())))


@dataclass(frozen=True)
class Item:
    """All findings of one effect, as one line.

    Attributes:
      effect: its name.
      numbers: of the findings among all, from 1.
      name: effect and places, as they stand behind "the simulator lacks".
      text: a sentence.
      doubtful: whether it is less likely there than not, with what it cannot be told from.
    """

    effect: str
    numbers: tuple[int, ...]
    name: str
    text: str
    doubtful: bool


def items(diagnosis: Diagnosis, speech: Speech) -> list[Item]:
    """The findings, with those of one effect at several places as one."""
    together: dict[str, list[tuple[int, Finding]]] = {}
    for number, finding in enumerate(diagnosis.findings, start=1):
        together.setdefault(finding.effect, []).append((number, finding))
    return [_item(diagnosis, speech, effect, told) for effect, told in together.items()]


def _item(
    diagnosis: Diagnosis, speech: Speech, effect: str, told: Sequence[tuple[int, Finding]]
) -> Item:
    name = speech.lack(effect, [finding.place for _, finding in told])
    meaning = WORDS[effect]
    # Some names are as clear as what they mean: gear backlash is backlash.
    text = name if effect_words(effect) in meaning else f"{name}: {meaning}"
    text = f"{capital(text)}."
    if len(told) == 1:
        text = sentence(diagnosis, told[0][1], speech)
    doubtful = not any(finding.believed for _, finding in told)
    return Item(effect, tuple(number for number, _ in told), name, text, doubtful)


def sentence(diagnosis: Diagnosis, finding: Finding, speech: Speech) -> str:
    """What a finding says."""
    if finding.effect == NAMELESS:
        return _nameless(diagnosis, finding, speech)
    told = capital(_TEMPLATES[finding.effect](_facts(diagnosis, finding, speech)))
    uneven = finding.parameters.get("jitter")
    if uneven is not None:
        told += f" From tick to tick that changes by ±{speech.quantity(uneven.value, 's')}."
    return minus(told)


def _nameless(diagnosis: Diagnosis, finding: Finding, speech: Speech) -> str:
    """Where something happens that has no name, and what it acts like if that is known."""
    place = finding.place
    spread = {"robot": "at most joints of the robot", "sensor": "in the readings of the IMU"}
    where = spread.get(place.kind, f"at {speech.place(place)}")
    like = ""
    if finding.law:  # a law may hold and yet be next to nothing
        share = described(diagnosis, finding)
        like = f"; the best law for it explains only {percent(share)} of it"
        if share > MOSTLY:
            like = f"; it acts like the torque {minus(finding.law.removeprefix('tau += '))}"
    if "spread" in finding.parameters:
        apart, flutter = (finding.parameters[n].value for n in ("spread", "flutter"))
        like = (
            f" and does not repeat: a motion done again differs by {speech.quantity(apart, 'rad')}"
            f", {apart / flutter:.0f} times what its readings flutter by"
        )
    if "astray" in finding.parameters:
        times = digits(finding.parameters["astray"].value)
        like = (
            ": the effects that are told of may be patches for it, and leave "
            f"{times} times the noise on motions that were left out"
        )
    return f"{capital(WORDS[NAMELESS])} happens {where}{like}."


def _facts(diagnosis: Diagnosis, finding: Finding, speech: Speech) -> Facts:
    fitted = diagnosis.model.fit.values if diagnosis.model else {}
    size = {}
    for quantity in TERMS[finding.effect].quantities:
        told = finding.parameters.get(quantity.name)
        name = column(finding.effect, quantity.name, finding.place)
        size[quantity.name] = told.value if told else fitted.get(name, quantity.nominal)
    robot, place = diagnosis.robot, finding.place
    groups = {joint.name: joint.group for joint in robot.joints}
    group = groups.get(place.name, place.name)
    known = {p.name: p.nominal for p in robot.parameters} | fitted
    limits = [v for n, v in known.items() if n.startswith("tau_max/")]
    return Facts(
        speech,
        finding,
        size,
        known.get(f"kp/{group}", np.nan),
        float(np.median(limits)) if limits else 1.0,
    )


def _friction(f: Facts) -> str:
    torque = f.size["torque"]
    short = torque / f.stiffness
    stops = f" and can stop it {f.speech.angle(short)} short of its target" if short > 0 else ""
    return (
        f"{f.at} stick{f.s}: dry friction of {f.speech.torque(torque)} works against every "
        f"motion{stops}."
    )


def _stribeck(f: Facts) -> str:
    moving, rest = f.size["torque"], f.size["rest"]
    return (
        f"{f.at} stick{f.s}: dry friction of {f.speech.torque(moving)} in motion and "
        f"{f.speech.torque(moving + rest)} when it starts from rest."
    )


def _rising(f: Facts) -> str:
    torque, rise, time = f.size["torque"], f.size["rise"], f.speech.quantity(f.size["time"], "s")
    return (
        f"{f.at} stick{f.s} more the longer {'they rest' if not f.s else 'it rests'}: dry friction "
        f"of {f.speech.torque(torque)} rises up to {f.speech.torque(torque + rise)}, half of "
        f"the rise within {time}."
    )


def _presliding(f: Facts) -> str:
    return (
        f"{f.at} stick{f.s}: dry friction of {f.speech.torque(f.size['torque'])}, which gives like "
        f"a spring for about {f.speech.angle(f.size['deflection'])} before it slips."
    )


def _drag(f: Facts) -> str:
    speed = 0.1 if f.speech.slides else np.pi
    torque = f.speech.torque(f.size["coefficient"] * speed**2)
    return (
        f"A drag that grows with the square of the speed brakes {f.at}: {torque} at "
        f"{f.speech.speed(speed)}."
    )


def _speed_limit(f: Facts) -> str:
    speed = 0.1 if f.speech.slides else QUARTER
    return (
        f"The faster {f.at} turn{f.s}, the weaker the motor: it loses "
        f"{f.speech.torque(f.size['slope'] * speed)} for every {f.speech.speed(speed)}."
    )


def _goal_limit(f: Facts) -> str:
    top = f.speech.speed(1 / max(f.size["slowness"], 1e-9))
    gained = f.speech.speed(0.01 / max(f.size["sluggishness"], 1e-9))
    told = [f"gains no more than {gained} in 10 ms"] if f.size["sluggishness"] > TARDY else []
    if f.size["slowness"] > SLOW or not told:
        told.insert(0, f"goes no faster than {top}")
    return f"The firmware moves the goal of {f.at} by a profile of its own: it {listed(told)}."


def _sag(f: Facts) -> str:
    lost = 1 - 1 / (1 + f.size["drop"] * f.strength)
    return (
        f"The supply sags under load: when all servos together give {f.speech.torque(f.strength)}, "
        f"as much as one of them can, each loses {percent(lost)} of its strength."
    )


def _drift(f: Facts) -> str:
    lost = f.size["rate"] * f.size["time"] * -float(np.expm1(-AWHILE / f.size["time"]))
    owner, s = ("the servos", "") if f.finding.place.kind == "robot" else (f.at, f.s)
    change = f"{'lose' if lost > 0 else 'gain'}{s} strength"
    if f.size["load"]:
        carried = "it carries" if s else "they carry"
        half = f"{percent(abs(lost) / 2)} in {AWHILE:g} s at half of the torque limit"
        return f"{owner} {change} by what {carried}: {half}."
    return f"With run time {owner} {change}: {percent(abs(lost))} in {AWHILE:g} s."


def _cogging(f: Facts) -> str:
    height = float(np.hypot(f.size["sine"], f.size["cosine"]))
    period = f.speech.angle(2 * np.pi / f.size["teeth"])
    return f"The torque of {f.at} ripples by ±{f.speech.torque(height)}, once every {period}."


def _compliance(f: Facts) -> str:
    unit = f.speech.unit("N m")
    return f"{f.at} give{f.s} by {f.speech.angle(f.size['compliance'])} for every {unit} of load."


def _flex(f: Facts) -> str:
    bend = f.speech.angle(f.size["compliance"])
    unit = f.speech.unit("N m")
    return f"The structure at {f.at} bends by {bend} for every {unit}, unseen by the encoder."


def _integral(f: Facts) -> str:
    error = 0.001 if f.speech.slides else np.radians(1)
    return (
        f"The controller of {f.at} has an integral part: an error of {f.speech.angle(error)} adds "
        f"{f.speech.torque(f.size['gain'] * error)} every second"
        + (", while the torque is off too." if f.size.get("lasting") else ".")
    )


def _asymmetric_gain(f: Facts) -> str:
    share = f.size["share"]
    stiffer, softer = ("positive", "negative") if share > 0 else ("negative", "positive")
    return (
        f"{f.at} pull{f.s} {percent(abs(share))} harder in the {stiffer} direction and as much "
        f"weaker in the {softer} one."
    )


def _asymmetric_friction(f: Facts) -> str:
    torque, viscous = f.size["torque"], f.size["viscous"]
    unit = f.speech.unit("N m s/rad")
    parts = [
        f"{f.speech.torque(abs(torque))} more in the {'positive' if torque > 0 else 'negative'} "
        "direction",
        f"{digits(abs(viscous))} {unit} more drag in the "
        f"{'positive' if viscous > 0 else 'negative'} one",
    ]
    return f"{f.at} rub{f.s} differently in its two directions: {listed(parts)}."


def _spring(f: Facts) -> str:
    bend = 0.01 if f.speech.slides else np.radians(10)
    pull = f.speech.torque(f.size["stiffness"] * bend)
    preload = f.size["preload"]
    constant = f"{f.speech.torque(abs(preload))} in the {'positive' if preload > 0 else 'negative'}"
    return (
        f"Something like a cable pulls {f.at} back: {pull} for every {f.speech.angle(bend)}, and "
        f"{constant} direction all the time."
    )


def _payload(f: Facts) -> str:
    mass = f.size["mass"]
    return (
        f"{f.at} weigh{f.s} {f.speech.quantity(abs(mass), 'kg')} "
        f"{'more' if mass > 0 else 'less'} than in the model."
    )


def _clock(f: Facts) -> str:
    share = f.size["share"]
    return (
        "The clocks of commands and readings run apart: by "
        f"{digits(abs(1000 * share))} ms every second."
    )


def _grip(f: Facts) -> str:
    change = f.size["change"]
    return (
        f"{f.at} grip{f.s} {'better' if change > 0 else 'worse'} than the rest: its friction "
        f"coefficient is {digits(abs(change))} {'higher' if change > 0 else 'lower'}."
    )


_TEMPLATES: dict[str, Callable[[Facts], str]] = {
    "coulomb_friction": _friction,
    "stribeck_friction": _stribeck,
    "rising_static_friction": _rising,
    "presliding_hysteresis": _presliding,
    "load_dependent_friction": lambda f: (
        f"{f.at} lose{f.s} {percent(2 * f.size['share'])} of the load that "
        f"{'it carries' if f.s else 'they carry'} to friction."
    ),
    "gear_efficiency": lambda f: (
        f"The gear of {f.at} loses {percent(f.size['loss'])} of the torque it passes on."
    ),
    "quadratic_damping": _drag,
    "torque_speed_limit": _speed_limit,
    "target_rate_limit": _goal_limit,
    "command_delay": lambda f: (
        f"Commands to {f.at} arrive {f.speech.quantity(f.size['time'], 's')} late."
    ),
    "measurement_delay": lambda f: (
        f"Readings of {f.at} are {f.speech.quantity(f.size['time'], 's')} old."
    ),
    "scan_delay": lambda f: (
        "Servos are read one after the other: from the "
        f"{'first to the last' if f.size['time'] > 0 else 'last to the first'} joint their "
        f"readings grow older, by {f.speech.quantity(abs(f.size['time']), 's')} in all."
    ),
    "actuator_lag": lambda f: (
        f"What drives {f.at} lags {f.speech.quantity(f.size['time'], 's')} behind what the "
        f"controller asks for{', in two stages' if f.size.get('stages', 1.0) > 1.5 else ''}."
    ),
    "voltage_sag": _sag,
    "thermal_drift": _drift,
    "cogging": _cogging,
    "backlash": lambda f: (
        f"{f.at} lose{f.s} {f.speech.angle(2 * f.size['gap'])} at every load reversal: gear "
        "backlash."
    ),
    "dead_band": lambda f: (
        f"The controller of {f.at} ignores errors below {f.speech.angle(f.size['width'])}: a dead "
        "band."
    ),
    "joint_compliance": _compliance,
    "structural_flex": _flex,
    "integral_action": _integral,
    "derivative_kick": lambda f: (
        f"The derivative part of {f.at} acts on the error, not on the speed alone: a command that "
        f"changes kicks the joint ahead with {f.speech.quantity(f.size['gain'], 'N m s/rad')}, "
        f"over {f.speech.quantity(f.size['time'], 's')}."
    ),
    "gain_asymmetry": _asymmetric_gain,
    "friction_asymmetry": _asymmetric_friction,
    "encoder_bias": lambda f: (
        f"The encoder's zero of {f.at} is off by {f.speech.angle(f.size['offset'])}."
    ),
    "com_offset": lambda f: (
        f"The centre of mass of {f.at} is {f.speech.quantity(f.length(), 'm')} away from where the "
        f"model has it: {f.along()}."
    ),
    "encoder_eccentricity": lambda f: (
        f"The encoder of {f.at} is off centre: it reads up to {f.speech.angle(f.length())} wrong, "
        "once a turn."
    ),
    "payload": _payload,
    "armature": lambda f: (
        f"The rotor of {f.at} is heavier than the others': "
        f"{f.speech.quantity(f.size['inertia'], 'kg m2')} more inertia at the joint."
    ),
    "joint_spring": _spring,
    "joint_stop": lambda f: f"{f.at} run{f.s} into something at {f.speech.angle(f.size['angle'])}.",
    "clock_skew": _clock,
    "ground_compliance": lambda f: (
        f"{f.at} give{f.s}: it pushes back {f.speech.quantity(f.size['time'], 's')} later than a "
        "hard floor, as a mat does."
    ),
    "ground_slope": lambda f: f"{f.at} lean{f.s}: {f.along()}.",
    "ground_friction": _grip,
    "contact_restitution": lambda f: (
        f"Contacts with {f.at} bounce: they have {percent(f.size['share'])} less damping than in "
        "the model."
    ),
    "imu_misalignment": lambda f: (
        f"{f.at} is mounted {f.speech.angle(f.length())} askew: {f.along()}."
    ),
    "imu_delay": lambda f: (
        f"The angles of {f.at} are {f.speech.quantity(f.size['time'], 's')} old."
    ),
    "external_force": lambda f: (
        f"Something outside pulls at {f.at} with {f.speech.quantity(f.length(), 'N')}: {f.along()}."
    ),
}

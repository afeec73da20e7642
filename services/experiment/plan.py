"""What an experiment does: which robots, which policies, how many walks."""

import argparse
import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, NoReturn, get_args, get_type_hints

from pup.errors import InputError
from pup.locomotion.settings import Direction
from pup.policy.shape import Method
from pup.robot import Actuator
from pup.robot_toml import Table, read_text
from services.gateway.limits import ETAS, HORIZON, REPEATS, SEEDS, TRIALS
from services.presysid_options import Options as Fits

LIMIT = 2**18  # bytes of a plan
ALL = tuple(Method)
STAGES = (
    *("record", "presysid", "policy", "trials", "prior", "diagnosis", "corrected", "diagnosed"),
    "undiagnosed",
)
"""What can be left out; what a stage needs is done in any case."""
PARTS = ("record", "presysid", "fleet", "train", "trials", "diagnosis")
"""Tables of a plan's file, besides those of its walks."""
FITTED = ("presysid", "fleet")
"""Parts that tell of fits."""
NOT_SAID = ("start", "fitted_to", "seed")
"""Of fits, what is the experiment's to say: which files, what was diagnosed, and what is drawn."""
FITS = Fits(generations=100, subset_generations=50)
MOST = {
    "trials": TRIALS,
    "prior": TRIALS,
    "repeats": REPEATS,
    "horizon": HORIZON,
    "landscape": ETAS,
}
"""Of trials: what the gateway's studies take."""
LEAST = {"generations": 1, "population": 4, "subsets": 1, "subset_generations": 1}
"""Of fits, as for `pup presysid`."""


@dataclass(frozen=True)
class Walk:
    """A direction to walk in.

    Attributes:
      direction: of the walks.
      methods: whose policies walk.
      robots: how many do, the first of the seeds.
    """

    direction: Direction
    methods: tuple[Method, ...] = ALL
    robots: int = 10


@dataclass(frozen=True)
class Recorded:
    """What is recorded of each robot.

    Attributes:
      motions: as of `pup record`; all robots play the same scripts.
      repeats: how often each is played, which tells the noise.
      fitted: types of motion that pre-sysID is given (the paper's); a diagnosis may see more.
    """

    motions: tuple[str, ...] = (
        *("step:0.1", "step:0.3", "step:0.6") * 2,
        *("hold", "triangle", "standup:1.75", "standup:4"),
        *("fall:forward", "fall:backward", "fall:left", "fall:right", "stand"),
    )
    repeats: int = 1
    fitted: tuple[str, ...] = ("step", "standup", "fall")


@dataclass(frozen=True)
class Train:
    """How policies are trained, as it would be written behind `pup train`.

    Attributes:
      fleet: each policy, on the bounds of the fleet.
      further: what is trained on for one robot.
      diagnosed: what is trained on for the fleet with what its diagnoses share.
    """

    fleet: str = ""
    further: str = "--steps 800000"
    diagnosed: str = "--steps 1500000"


class _Refusing(argparse.ArgumentParser):
    def __init__(self, **told: Any) -> None:
        super().__init__(allow_abbrev=False, **told)  # what is not for a plan is known by its name

    def error(self, message: str) -> NoReturn:
        raise InputError(message)

    def print_help(self, file: Any = None) -> None:
        """Nothing: who writes --help into a plan is refused in a line."""

    def exit(self, status: int = 0, message: str | None = None) -> NoReturn:
        raise InputError(message or "is no training")


def training(words: str) -> argparse.Namespace:
    """What words behind `pup train` mean.

    Raises:
      InputError: `pup train` would refuse them, or they are not for a plan to say.
    """
    from services.arguments import parser

    try:
        told = shlex.split(words)
    except ValueError as error:
        raise InputError(f"train: {words[:60]!r} cannot be read ({error})") from error
    kept = ("method", "direction", "start", "seed", "bounds", "out", "robot", "address", "runners")
    if named := [word for word in told if word.lstrip("-").partition("=")[0] in kept]:
        raise InputError(f"train: {named[0]} is the experiment's to say; leave it out")
    try:
        return parser(_Refusing).parse_args(["train", *told, "--out", "."])
    except InputError as error:
        raise InputError(f"train: {error}") from error


def meant(words: str, further: bool) -> dict[str, Any]:
    """All numbers of a training, those included that words leave as they are usual.

    Args:
      words: as `training` takes them.
      further: whether a policy is trained on.
    """
    from services.training_options import training_options

    given = training(words)
    given.start = Path() if further else None
    told = asdict(training_options(given))
    for name in ("method", "direction", "seed", "start", "track"):
        del told[name]
    return dict(json.loads(json.dumps(told)))


@dataclass(frozen=True)
class Trials:
    """How each robot walks.

    Attributes:
      trials: until eta is chosen (paper: 25).
      prior: the same where the search begins with simulated rollouts.
      repeats: walks that tell how far a policy comes (paper: 5).
      horizon: the longest walk, s.
      landscape: etas of the simulated rollouts.
    """

    trials: int = 25
    prior: int = 10
    repeats: int = 5
    horizon: float = 15.0
    landscape: int = 64


@dataclass(frozen=True)
class Diagnosed:
    """What robots are diagnosed from.

    Attributes:
      motions: types of motion that are looked at; none for all.
      rollouts: walks of the first trials that are looked at besides.
      seconds: of each walk, from its start.
      effects: that are looked for at most, one after the other.
      rivals: whether NN-PD and a residual network are judged beside it.
    """

    motions: tuple[str, ...] = ()
    rollouts: int = 0
    seconds: float = 2.0
    effects: int = 8
    rivals: bool = False


@dataclass(frozen=True)
class Plan:
    """An experiment.

    Attributes:
      robot: built-in name or folder; told on the command line, not in the file.
      seeds: of the concealed robots' physics.
      walks: what is walked.
      record: what is recorded.
      presysid: budget of each robot's own fit.
      fleet: that of the fit of all robots' recordings, whose bounds policies are trained on.
      pooled: whether these are the range of the robots' own fits instead, which costs no fit.
      train: how.
      trials: how many.
      diagnosis: from what.
      control: whether the policy of the corrected simulator is held against one that was trained on
        as long in the uncorrected one of the same robot.
      stages: what is done.
      seed: of everything random but the robots.
    """

    robot: str = "darwin_op2"
    seeds: tuple[int, ...] = tuple(range(1000, 1010))
    walks: tuple[Walk, ...] = (
        Walk(Direction.FORWARD),
        Walk(Direction.BACKWARD, (Method.PUP, Method.ROBUST), 4),
        Walk(Direction.SIDEWAYS, (Method.PUP, Method.ROBUST), 4),
    )
    record: Recorded = field(default_factory=Recorded)
    presysid: Fits = field(default_factory=lambda: replace(FITS, compare=False))
    fleet: Fits = field(default_factory=lambda: replace(FITS, subsets=20, fraction=0.02))
    pooled: bool = False
    train: Train = field(default_factory=Train)
    trials: Trials = field(default_factory=Trials)
    diagnosis: Diagnosed = field(default_factory=Diagnosed)
    control: bool = True
    stages: tuple[str, ...] = STAGES
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.seeds or len(set(self.seeds)) < len(self.seeds) or min(self.seeds) < 0:
            raise InputError("seeds: name each concealed robot once, by a whole number from 0")
        if (largest := max(self.seed, *self.seeds)) >= SEEDS:
            raise InputError(f"seed {largest} is too large; seeds must be below {SEEDS}")
        named = [walk.direction for walk in self.walks]
        if len(set(named)) < len(named):
            raise InputError("walk: a direction stands twice; name each once")
        if any(not walk.methods or walk.robots < 1 for walk in self.walks):
            raise InputError("walk: needs a method and a robot at least")
        for name, words in asdict(self.train).items():
            if training(words).pattern and name != "fleet":
                raise InputError(f"train: {name} goes on from a gait; leave --pattern out")
        if unknown := [stage for stage in self.stages if stage not in STAGES]:
            raise InputError(f"stage {unknown[0]!r} is unknown; there are {', '.join(STAGES)}")
        if self.pooled and not (self.presysid.fixed_network and len(self.seeds) > 1):
            raise InputError(
                "pooled: needs fixed_network in presysid, for one network means one scale of rho "
                "and sigma, and two robots"
            )
        if min(self.trials.trials, self.trials.prior, self.trials.repeats) < 1:
            raise InputError("trials: trials, prior and repeats must be 1 or more")
        for name, most in MOST.items():
            if (told := getattr(self.trials, name)) > most:
                raise InputError(f"trials: {name} is {told:g}; it must be {most} at most")
        if min(self.trials.horizon, self.diagnosis.seconds) <= 0:
            raise InputError("trials: horizon, and seconds of diagnosis, must be above 0")
        for name in FITTED:
            _check(name, getattr(self, name))
        if self.diagnosis.effects < 1:
            raise InputError(
                "diagnosis: effects must be 1 or more; to look for none, leave it out of stages"
            )
        if self.trials.landscape < 2 or self.record.repeats < 1 or not self.record.motions:
            raise InputError("a landscape needs 2 etas, recordings a motion and a repeat at least")

    def document(self) -> dict[str, Any]:
        """As JSON values."""
        told = asdict(self)
        for name in FITTED:
            told[name]["seed"] = self.seed
        return told

    def of(self, seeds: Sequence[int] | None, methods: Sequence[str] | None) -> "Plan":
        """The plan for other robots, or for some of its methods alone.

        Where robots are named, all of them walk in every direction.
        """
        plan = self
        if seeds:
            walks = tuple(replace(walk, robots=len(seeds)) for walk in self.walks)
            plan = replace(plan, seeds=tuple(seeds), walks=walks)
        if methods:
            kept = [
                replace(walk, methods=tuple(m for m in walk.methods if m in methods))
                for walk in plan.walks
            ]
            plan = replace(plan, walks=tuple(walk for walk in kept if walk.methods))
        return plan


def _check(name: str, fits: Fits) -> None:
    """Refuse fits that would come to nothing, hours later."""
    for key, least in LEAST.items():
        if getattr(fits, key) < least:
            raise InputError(f"{name}: {key} must be {least} or more")
    if not 0 < fits.fraction <= 1:
        raise InputError(f"{name}: fraction must be above 0, and 1 at most")
    if fits.actuator not in (known := get_args(Actuator)):
        raise InputError(f"{name}: actuator {fits.actuator!r} is none of {', '.join(known)}")
    if fits.folds == 1:
        raise InputError(
            f"{name}: 1 in folds would leave nothing to fit; use 2 or more, or 0 for none"
        )
    try:
        fits.check(())
    except InputError as error:
        raise InputError(f"{name}: {error}") from error


def small() -> Plan:
    """Two robots and the least work: whether everything fits together, in minutes."""
    fits = Fits(generations=2, population=4, subsets=2, subset_generations=1, fixed_network=True)
    least = "--steps 1024 --simulations 16 --length 32 --pattern 0"
    return Plan(
        seeds=(1000, 1001),
        walks=(Walk(Direction.FORWARD, ALL, 2),),
        record=Recorded(("step:0.3", "standup:2"), fitted=("step",)),
        presysid=replace(fits, compare=False),
        fleet=fits,
        train=Train(least, least, least),
        trials=Trials(trials=3, prior=2, repeats=2, horizon=2.0, landscape=4),
        diagnosis=Diagnosed(motions=("step",)),
    )


def read_plan(file: Path) -> Plan:
    """Read a plan from TOML; what it leaves out is as in `Plan`.

    Raises:
      InputError: a key is unknown or a value cannot be.
    """
    table = Table.read(read_text(file, LIMIT), file)
    if table.integer("schema") != 1:
        raise table.mistake("schema", "not 1; this version reads schema = 1 only")
    usual = Plan()
    parts = {name: table.table(name) for name in PARTS}
    for name in FITTED:
        if parts[name].has("seed"):
            raise parts[name].mistake("seed", "is that of the plan; write it above the tables")
    told: dict[str, Any] = {name: _part(part, getattr(usual, name)) for name, part in parts.items()}
    own = _values(table, usual, ("seeds", "pooled", "control", "stages", "seed"))
    if table.has("walk"):
        if not (walks := table.tables("walk")):
            raise table.mistake("walk", "is empty; leave it out for the usual walks")
        seeds = len(own.get("seeds", usual.seeds))
        told["walks"] = tuple(_walk(walk, file, seeds) for walk in walks)
    table.close()
    try:
        return replace(usual, **told, **own)
    except InputError as error:
        raise InputError(f"{file}: {error}") from error


def _walk(table: Table, file: Path, seeds: int) -> Walk:
    try:
        direction = Direction(table.text("direction"))
        methods = tuple(map(Method, table.texts("methods"))) if table.has("methods") else ALL
    except InputError:  # which is a ValueError, and says where
        raise
    except ValueError as error:
        raise InputError(f"{file}: walk: {error}") from error
    robots = table.integer("robots")
    if robots is not None and robots > seeds:
        raise table.mistake("robots", f"{robots}, but seeds are {seeds}; name as many")
    table.close()
    return Walk(direction, methods, min(Walk.robots, seeds) if robots is None else robots)


def _part(table: Table, usual: Any) -> Any:
    # A plan is text that means the same everywhere: it names no files.
    read = _values(table, usual, tuple(f.name for f in fields(usual) if f.name not in NOT_SAID))
    table.close()
    return replace(usual, **read)


def _values(table: Table, usual: Any, names: Sequence[str]) -> dict[str, Any]:
    hints: Mapping[str, Any] = get_type_hints(type(usual))
    return {name: _value(table, name, hints[name]) for name in names if table.has(name)}


def _value(table: Table, key: str, kind: Any) -> Any:
    if kind is bool:
        return table.flag(key)
    if kind is int:
        value = table.integer(key)
        if value is not None and value < 0:
            raise table.mistake(key, f"{value} is below 0")
        return value
    if kind is float:
        return table.number(key)
    if kind == tuple[int, ...]:
        numbers = table.numbers(key)
        if broken := [number for number in numbers if not number.is_integer()]:
            raise table.mistake(key, f"{broken[0]:g} is no whole number")
        return tuple(map(int, numbers))
    return table.texts(key) if kind == tuple[str, ...] else table.text(key)

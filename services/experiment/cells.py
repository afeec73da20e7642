"""The cells of an experiment: runs that stand alone, each told by what it depends on."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pup.errors import InputError
from pup.files import sha256
from pup.policy.bundle import CARD
from pup.policy.shape import Method
from pup.recording_file import visible
from pup.robot import RobotDescription
from services.experiment.plan import Fits, Plan, Walk, meant

FLEET = "presysid-fleet"
DIAGNOSED = "diagnosed"
"""Of a fleet that is simulated with what its diagnoses share: a stage, and how its cells end."""
DIAGNOSED_FLEET = f"{FLEET}-{DIAGNOSED}"
UNDIAGNOSED = "undiagnosed"
"""Their control, a fleet that is simulated as it was: a stage, and how its cells end."""
SEARCHED = (Method.PUP, Method.UP)
"""Methods whose policies are conditioned on something that trials can choose."""


@dataclass(frozen=True)
class Cell:
    """A run.

    Attributes:
      name: unique; that of its folder.
      kind: what is done, a name in `work.KINDS`.
      needs: cells whose results it takes, by the part that each plays.
      told: all else that its result depends on.
      given: where things lie that `told` has the digests of.
      weight: how long it takes, roughly, s; the longest are begun first.
    """

    name: str
    kind: str
    needs: Mapping[str, str] = field(default_factory=dict)
    told: Mapping[str, Any] = field(default_factory=dict)
    given: Mapping[str, str] = field(default_factory=dict)
    weight: float = 1.0


def graph(plan: Plan, ready: Path | None = None, real: Path | None = None) -> dict[str, Cell]:
    """The cells of a plan and those that these need, each after those.

    Args:
      plan: the experiment.
      ready: folder of policies that are trained already, `<direction>/<method>/` each.
      real: folder of recordings of a real robot, to be identified and diagnosed beside.

    Raises:
      InputError: the robot cannot take part, or there is no policy in `ready` for what is walked.
    """
    return _Graph(plan, ready, real).cells()


def chosen(cells: Mapping[str, Cell], names: Iterable[str]) -> dict[str, Cell]:
    """Some cells and those that they need, in the same order."""
    wanted = set(names)
    for name in reversed(list(cells)):
        if name in wanted:
            wanted |= set(cells[name].needs.values())
    return {name: cell for name, cell in cells.items() if name in wanted}


class _Graph:
    def __init__(self, plan: Plan, ready: Path | None, real: Path | None) -> None:
        self.plan, self.ready, self.real = plan, ready, real
        self.robot = RobotDescription.load(plan.robot)
        if self.robot.gait is None or any(j.servo_id is None for j in self.robot.joints):
            raise InputError(f"robot {self.robot.name!r}: an experiment needs a gait and servo ids")
        self._cells: dict[str, Cell] = {}

    def cells(self) -> dict[str, Cell]:
        if self.ready is not None:
            self._check_shelf(self.ready)
        for seed in self.plan.seeds:
            self._record(seed)
        for seed in self.plan.seeds:
            self._presysid(f"presysid-r{seed}", self.plan.presysid, self._recordings([seed]))
        self._fleet()
        for walk in self.plan.walks:
            for method in walk.methods:
                self._policy(walk, method)
                self._trials(walk, method)
        for seed in self.plan.seeds:
            self._diagnosis(seed)
        for walk in self.plan.walks:
            if Method.PUP in walk.methods:
                self._corrected(walk)
        self._diagnosed()
        for walk in self.plan.walks:
            if self.plan.control and Method.PUP in walk.methods:
                self._undiagnosed(walk)
        if self.real is not None:
            self._real(self.real)
        done = (*self.plan.stages, "real")
        wanted = [name for name, cell in self._cells.items() if self._stage(cell) in done]
        cells = chosen(self._cells, wanted)
        self._check_motions(cells)
        self._check_laws(cells)
        return cells

    def _check_laws(self, cells: Mapping[str, Cell]) -> None:
        """Refuse fits of robots that cannot tell the eta of policies trained on the fleet's."""
        own, fleet = self.plan.presysid.actuator, self.plan.fleet.actuator
        if self.plan.pooled or own == fleet:  # pooled, the fleet's are the robots' own
            return
        fits = {f"presysid-r{seed}" for seed in self.plan.seeds}
        for cell in cells.values():
            if cell.kind == "trials" and cell.needs.get("bounds") in fits:
                policy = cells[cell.needs["policy"]]
                if policy.needs.get("bounds") == FLEET:
                    raise InputError(
                        f"presysid: actuator {own!r} is another than {fleet!r} of fleet, on whose "
                        "bounds policies are trained; write the same in both"
                    )

    def _check_motions(self, cells: Mapping[str, Cell]) -> None:
        """Refuse types of motion that nobody plays, or that a cell would look for in vain."""
        from pup.sysid.excitation import possible_kinds, script

        record, looked_at = self.plan.record, self.plan.diagnosis.motions
        try:
            scripts = script(self.robot, record.motions, np.random.default_rng(self.plan.seed))
        except InputError as error:
            raise InputError(f"record: motions: {error}") from error
        played, known = {motion.motion for motion in scripts}, possible_kinds(self.robot)
        places = {"record: fitted": record.fitted, "diagnosis: motions": looked_at}
        for place, motions in places.items():
            if unknown := [motion for motion in motions if motion not in known]:
                raise InputError(f"{place}: {unknown[0]!r} is none of {', '.join(known)}")
        fitted = played.intersection(record.fitted or played)
        self._check_folds(sum(motion.motion in fitted for motion in scripts))
        stages = set(map(self._stage, cells.values()))
        if not fitted and "presysid" in stages:
            raise InputError("record: no motion is of a type in fitted, which pre-sysID is given")
        if looked_at and "diagnosis" in stages and not played.intersection(looked_at):
            raise InputError("diagnosis: no motion of record is of a type in motions")
        if looked_at and "corrected" in stages and not fitted.intersection(looked_at):
            raise InputError(
                "diagnosis: motions shares no type with fitted of record, to which corrected "
                "robots are fitted; add one, or leave corrected and diagnosed out of stages"
            )

    def _check_folds(self, scripts: int) -> None:
        """Refuse more folds than there are recordings, known by the scripts that are fitted."""
        seen = {"presysid": scripts, "fleet": scripts * len(self.plan.seeds)}
        for name, most in seen.items():
            if (folds := getattr(self.plan, name).folds) > most:
                raise InputError(
                    f"{name}: {folds} folds for {most} recordings of the types in fitted; use 2 to "
                    "their number, or 0 for none"
                )

    def _stage(self, cell: Cell) -> str:
        """Which stage a cell belongs to."""
        if cell.name.endswith("-real"):
            return "real"
        for stage in (DIAGNOSED, UNDIAGNOSED):
            if cell.name.endswith(f"-{stage}"):
                return stage
        if "corrected" in cell.name or cell.name.endswith("-own"):
            return "corrected"
        if cell.name.endswith("-prior") or cell.kind == "landscape":
            return "prior"
        return "presysid" if cell.kind == "pooled" else cell.kind

    def _add(self, cell: Cell) -> None:
        self._cells[cell.name] = cell

    def _told(self, **more: Any) -> dict[str, Any]:
        return {"robot": self.robot.digest, "seed": self.plan.seed, **more}

    def _given(self, **more: Any) -> dict[str, str]:
        return {"robot": str(self.robot.folder.absolute()), **more}

    def _recordings(self, seeds: Iterable[int]) -> dict[str, str]:
        return {f"recordings {seed}": f"record-r{seed}" for seed in seeds}

    def _seeds(self, walk: Walk) -> tuple[int, ...]:
        return self.plan.seeds[: walk.robots]

    def _record(self, seed: int) -> None:
        record = self.plan.record
        told = self._told(character=seed, motions=record.motions, repeats=record.repeats)
        weight = 5.0 * len(record.motions) * record.repeats
        self._add(Cell(f"record-r{seed}", "record", {}, told, self._given(), weight))

    def _presysid(self, name: str, fits: Fits, needs: Mapping[str, str]) -> None:
        told = self._fitted(fits)
        weight = 60 + 0.3 * fits.generations * fits.population * len(needs)
        self._add(Cell(name, "presysid", dict(needs), told, self._given(), weight))

    def _fleet(self) -> None:
        """The bounds that policies are trained on."""
        if not self.plan.pooled:
            self._presysid(FLEET, self.plan.fleet, self._recordings(self.plan.seeds))
            return
        needs = {f"fit {seed}": f"presysid-r{seed}" for seed in self.plan.seeds}
        self._add(Cell(FLEET, "pooled", needs, self._told(), self._given(), 1.0))

    def _fitted(self, fits: Fits) -> dict[str, Any]:
        return self._told(fits=self._seeded(fits), motions=self.plan.record.fitted)

    def _seeded(self, fits: Fits) -> dict[str, Any]:
        return replace(fits, seed=self.plan.seed).told()

    def _policy(self, walk: Walk, method: Method) -> None:
        name, train = f"policy-{walk.direction}-{method}", self.plan.train
        if self.ready is not None and (folder := self._shelf(walk, method)) is not None:
            told = self._told(ready=sha256(folder / CARD), method=method, direction=walk.direction)
            given = self._given(policy=str(folder.absolute()))
            self._add(Cell(name, "policy", {}, told, given))
            return
        self._trained(name, walk, method, train.fleet, {"bounds": FLEET})

    def _trained(
        self, name: str, walk: Walk, method: Method, words: str, needs: Mapping[str, str]
    ) -> None:
        """A policy that is trained as words tell, and as it is where they are silent."""
        options = meant(words, further="start" in needs)
        told = self._told(method=method, direction=walk.direction, training=words, options=options)
        weight = 20 + options["steps"] / 5000 + 8 * options["pattern"]
        self._add(Cell(name, "policy", dict(needs), told, self._given(), weight))

    def _check_shelf(self, ready: Path) -> None:
        """Refuse a folder without policies, for then all would be trained, in days."""
        if not ready.is_dir():
            raise InputError(f"--policies {ready}: is no folder; name that of the policies")
        walked = [(walk, method) for walk in self.plan.walks for method in walk.methods]
        if walked and not any(self._shelf(*one) for one in walked):
            walk, method = walked[0]
            raise InputError(
                f"--policies {ready}: holds no policy that walks in this plan, such as "
                f"{walk.direction}/{method}/{CARD}; name their folder, or leave it out to train all"
            )

    def _shelf(self, walk: Walk, method: Method) -> Path | None:
        """A policy that is trained already."""
        assert self.ready is not None
        folder = self.ready / walk.direction / method
        found = [f for f in (folder, folder / "policy") if (f / CARD).is_file()]
        return found[0] if found else None

    def _trials(self, walk: Walk, method: Method) -> None:
        from services.laboratory import period_of

        policy, trials = f"policy-{walk.direction}-{method}", self.plan.trials
        landscape = f"landscape-{walk.direction}-{method}"
        if method in SEARCHED:
            rate = 1 / period_of(self.robot)  # of all walks; distances hang on it
            told = self._told(etas=trials.landscape, horizon=trials.horizon, rate=rate)
            needs = {"policy": policy, "bounds": FLEET}
            self._add(Cell(landscape, "landscape", needs, told, self._given(), 60.0))
        for seed in self._seeds(walk):
            name, fitted = f"trials-r{seed}-{walk.direction}-{method}", f"presysid-r{seed}"
            self._tried(name, seed, method, policy, {"bounds": fitted})
            if method in SEARCHED:
                needs = {"policy": policy, "bounds": fitted, "landscape": landscape}
                self._walked(f"{name}-prior", seed, trials.prior, needs)

    def _tried(
        self, name: str, seed: int, method: Method, policy: str, simulator: Mapping[str, str]
    ) -> None:
        """Walks of a policy; after trials where these can choose what it is conditioned on."""
        searched = method in SEARCHED
        needs = {"policy": policy} | (simulator if searched else {})
        self._walked(name, seed, self.plan.trials.trials if searched else 1, needs)

    def _walked(self, name: str, seed: int, count: int, needs: Mapping[str, str]) -> None:
        trials = self.plan.trials
        told = self._told(
            character=seed, trials=count, repeats=trials.repeats, horizon=trials.horizon
        )
        weight = 30 + (count + 2 * trials.repeats) * trials.horizon / 5
        self._add(Cell(name, "trials", dict(needs), told, self._given(), weight))

    def _diagnosis(self, seed: int) -> None:
        plan, needs = self.plan.diagnosis, self._recordings([seed])
        walked = [w for w in self.plan.walks if seed in self._seeds(w) and Method.PUP in w.methods]
        if plan.rollouts and walked:
            needs["rollouts"] = f"trials-r{seed}-{walked[0].direction}-{Method.PUP}"
        told = self._told(**asdict(plan))
        self._add(Cell(f"diagnosis-r{seed}", "diagnosis", needs, told, self._given(), 300.0))

    def _refit(self, seed: int) -> dict[str, str]:
        """The bounds of a corrected robot, and that robot."""
        refit, robot = f"presysid-r{seed}-corrected", f"diagnosis-r{seed}"
        if refit not in self._cells:
            told = self._fitted(self.plan.presysid.corrected(self.plan.diagnosis.motions))
            needs = self._recordings([seed]) | {"robot": robot}
            weight = self._cells[f"presysid-r{seed}"].weight
            self._add(Cell(refit, "presysid", needs, told, self._given(), weight))
        return {"bounds": refit, "robot": robot}

    def _diagnosed(self) -> None:
        """The fleet's policies trained on where it is simulated with what its robots share."""
        if len(self.plan.seeds) < 2:
            return
        refits = {seed: self._refit(seed) for seed in self.plan.seeds}
        needs = {f"fit {seed}": refit["bounds"] for seed, refit in refits.items()}
        needs |= {f"robot {seed}": refit["robot"] for seed, refit in refits.items()}
        self._add(Cell(DIAGNOSED_FLEET, "pooled", needs, self._told(), self._given(), 1.0))
        words = self.plan.train.diagnosed
        for walk in self.plan.walks:
            for method in walk.methods:
                first = f"policy-{walk.direction}-{method}"
                needs = {"bounds": DIAGNOSED_FLEET, "robot": DIAGNOSED_FLEET, "start": first}
                policy = f"{first}-{DIAGNOSED}"
                self._trained(policy, walk, method, words, needs)
                for seed in self._seeds(walk):
                    name = f"trials-r{seed}-{walk.direction}-{method}-{DIAGNOSED}"
                    self._tried(name, seed, method, policy, refits[seed])

    def _undiagnosed(self, walk: Walk) -> None:
        """The fleet's PUP policy trained on for as long on bounds that know of no diagnosis."""
        method = Method.PUP
        first = f"policy-{walk.direction}-{method}"
        policy, words = f"{first}-{UNDIAGNOSED}", self.plan.train.diagnosed
        self._trained(policy, walk, method, words, {"bounds": FLEET, "start": first})
        for seed in self._seeds(walk):
            name = f"trials-r{seed}-{walk.direction}-{method}-{UNDIAGNOSED}"
            self._tried(name, seed, method, policy, {"bounds": f"presysid-r{seed}"})

    def _corrected(self, walk: Walk) -> None:
        """The fleet's policy trained on for each robot, in its corrected simulator and its own."""
        policy = f"policy-{walk.direction}-{Method.PUP}"
        for seed in self._seeds(walk):
            own, corrected = {"bounds": f"presysid-r{seed}"}, self._refit(seed)
            ways = {"corrected": corrected} | ({"own": own} if self.plan.control else {})
            for way, needs in ways.items():
                self._further(walk, seed, way, needs | {"start": policy})

    def _further(self, walk: Walk, seed: int, way: str, needs: Mapping[str, str]) -> None:
        train, last = self.plan.train, f"r{seed}-{walk.direction}-{way}"
        policy = f"policy-{last}"
        self._trained(policy, walk, Method.PUP, train.further, needs)
        walked = {name: cell for name, cell in needs.items() if name != "start"}
        walked["policy"] = policy
        self._walked(f"trials-{last}", seed, self.plan.trials.trials, walked)

    def _real(self, folder: Path) -> None:
        if not folder.is_dir():
            raise InputError(f"--real {folder}: is no folder; name that of the recordings")
        files = visible(folder, "*.parquet")
        if not files:
            raise InputError(f"{folder}: no *.parquet in this folder; see `pup import`")
        told: dict[str, Any] = {"recordings": {file.name: sha256(file) for file in files}}
        given = self._given(recordings=str(folder.absolute()))
        told["motions"] = ()  # all
        fits = self._seeded(replace(self.plan.fleet, compare=True))
        self._add(Cell("presysid-real", "presysid", {}, self._told(fits=fits, **told), given, 1e5))
        plan = asdict(self.plan.diagnosis) | {"rivals": True, "rollouts": 0} | told
        self._add(Cell("diagnosis-real", "diagnosis", {}, self._told(**plan), given, 1e5))

"""The pre-sysID job: recordings in, `bounds.json` and `report.html` out (paper, section III)."""

import hashlib
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.nominal import FREE as FITTED_BY_DIAGNOSIS
from pup.errors import InputError
from pup.files import read_json
from pup.physics.parameters import NETWORK_NAMES, ParameterSpace, robot_space
from pup.physics.terms import split_column
from pup.recording import Recording
from pup.robot import Actuator, RobotDescription
from pup.sysid.bounds import (
    WIDENING,
    Split,
    contact_splits,
    draw_subsets,
    expanded_range,
    widened,
)
from pup.sysid.fit import FitResult, FitSettings
from pup.sysid.imu import imu_names, with_imu
from pup.sysid.problem import Problem
from pup.sysid.report import write_report
from pup.sysid.result import Bounds, SubsetFit, fitted_to, read_fitted
from pup.sysid.uncertainty import Spread, observable, spread_at
from pup.sysid.wording import untold
from services.presysid_folds import check_folds, held_out, kept_in_folds, pooled_rmse
from services.presysid_options import Options
from workers.fits import Fit, Runner, Status

Array = NDArray[np.float64]
Progress = Callable[[str, Sequence[Status]], None]

NEAR_SIGMA = 0.05
"""First step of a subset's fit around the nominal point, as the authors' code has it, and of a
nominal fit that begins at one made before."""
FAR_SIGMA = 0.25
"""First step of a nominal fit that begins at a description's values."""


def identify(
    robot: RobotDescription,
    recordings: Sequence[Recording],
    options: Options,
    out: Path,
    runner: Runner,
    progress: Progress,
    threads: int,
) -> Bounds:
    """Run pre-sysID and write its files.

    Args:
      robot: the robot.
      recordings: of that robot.
      options: the budget.
      out: folder for `bounds.json`, `report.html` and `checkpoints/`.
      runner: where the fits run.
      progress: told the stage and how far its fits are.
      threads: cores for the replays made in this process.

    Raises:
      InputError: there is nothing to fit, a checkpoint is of another fit, the folder has bounds of
        another torque law, or the start is not one.
    """
    job = _Job(robot, tuple(recordings), options, out, runner, progress, threads)
    return job.run()


class _Job:
    def __init__(
        self,
        robot: RobotDescription,
        recordings: tuple[Recording, ...],
        options: Options,
        out: Path,
        runner: Runner,
        progress: Progress,
        threads: int,
    ) -> None:
        check_folds(recordings, options.folds)
        options.check(recordings)
        _check_place(out / "bounds.json", options.actuator)
        self.robot, self.recordings, self.options = robot, recordings, options
        self.out, self.runner, self.progress, self.threads = out, runner, progress, threads
        compare = options.compare and not options.as_described  # a diagnosis knows one law
        compared: tuple[Actuator, ...] = (robot.actuator, "pd") if compare else ()
        self.actuators = tuple(dict.fromkeys((options.actuator, *compared)))
        self.told = options.told()  # now: the file may change
        self.known = {} if options.start is None else self._begin(options.start)
        self.known_by = None if options.start is None else fitted_to(options.start)

    def _begin(self, start: Path) -> dict[Actuator, ParameterSpace]:
        """The fitted values of another job, by its torque law."""
        if start.resolve().is_relative_to(self.out.resolve()):
            raise InputError(f"{start}: lies in the folder that is written to; copy it elsewhere")
        kind, space = read_fitted(start, self.robot)
        if kind not in self.actuators:
            raise InputError(
                f"{start}: of the {kind} torque law, which is not fitted; use --actuator {kind}"
            )
        ends = zip(space.names, space.nominal, space.lower, space.upper, strict=True)
        for name, value, low, high in ends:
            if not low <= value <= high:
                searched = f"its search range {low:g} to {high:g}"
                raise InputError(f"{start}: parameter {name!r} is {value:g}, outside {searched}")
        return {kind: space}

    def run(self) -> Bounds:
        begin = time.time()
        fitted, held_out = self._nominal()
        full, main = self.full, self.full[self.options.actuator]
        best = main.values(fitted[self.options.actuator].best[None])[0]
        bounded = replace(
            main,
            space=main.space.at(dict(zip(main.space.names, best, strict=True))),
            free=tuple(n for n in _movable(main.space) if n not in NETWORK_NAMES),
        )
        subsets = self._subsets(bounded)
        bounds = self._bounds(bounded, fitted, held_out, subsets, begin)
        bounds = bounds.as_before(self.out / "bounds.json")
        bounds.write(self.out / "bounds.json")
        replays = {a: p.replay(fitted[a].best[None]) for a, p in full.items()}
        labels = {"nn_pd": "NN-PD", "pd": "PD"}
        write_report(
            self.out / "report.html",
            bounds,
            self.robot,
            self.recordings,
            {labels[a]: t for a, t in replays.items()},
            main.loss,
        )
        return bounds

    @cached_property
    def full(self) -> dict[Actuator, Problem]:
        """All recordings, under each torque law."""
        return {actuator: self._problem(actuator) for actuator in self.actuators}

    @cached_property
    def kept(self) -> frozenset[str]:
        """The parameters that a diagnosis has fitted, and could see in what it was given."""
        if not self.options.as_described:
            return frozenset()
        problem = self.full[self.options.actuator]
        motions = self.options.fitted_to
        known = [i for i, r in enumerate(self.recordings) if r.motion in motions]
        seen = _seen(problem.of(known)).free if motions else problem.free
        return frozenset(name for name in seen if name.split("/")[0] in FITTED_BY_DIAGNOSIS)

    def _problem(self, actuator: Actuator) -> Problem:
        """All recordings, with the parameters free that they can see."""
        problem = _seen(self._whole(actuator, self.known.get(actuator)))
        if not problem.free:
            raise InputError("nothing to fit: no parameter changes what the recordings measure")
        problem.check()
        return problem

    def _whole(self, actuator: Actuator, known: ParameterSpace | None = None) -> Problem:
        """All recordings, with every parameter free; at known values or at those described."""
        space = robot_space(self.robot, actuator) if known is None else known
        free = tuple(
            n for n in _movable(space) if not (self.options.fixed_network and n in NETWORK_NAMES)
        )
        if self.options.imu:
            space, described = with_imu(space), robot_space(self.robot, actuator).names
            free += tuple(name for name in imu_names(space) if name not in described)
        return Problem(self.robot, self.recordings, actuator, space, free, self.threads)

    def _nominal(self) -> tuple[dict[Actuator, FitResult], dict[str, float] | None]:
        """The nominal fit of each torque law, and the held-out error if there are folds."""
        full = self.full
        if self.options.as_described:
            return {actuator: self._kept(problem) for actuator, problem in full.items()}, None
        folds = kept_in_folds(self.recordings, self.options.folds)
        nominal = {
            a: self._fit_of_all(f"nominal_{a}", p, near=a in self.known) for a, p in full.items()
        }
        left_out = {
            (a, k): self._fit_of_fold(f"fold{k}of{len(folds)}_{a}", p, kept)
            for a, p in full.items()
            for k, kept in enumerate(folds)
        }
        results = self._fit("nominal fits", [*nominal.values(), *left_out.values()])
        fitted = dict(zip(nominal, results[: len(nominal)], strict=True))
        told = zip(left_out.items(), results[len(nominal) :], strict=True)
        if not folds:
            return fitted, None
        unseen = {key: (fit.problem, result) for (key, fit), result in told}
        return fitted, held_out(self.recordings, folds, unseen, self.options.actuator)

    def _kept(self, problem: Problem) -> FitResult:
        """The values that a diagnosis has fitted as they are, and a fit of the others."""
        others = tuple(name for name in problem.free if name not in self.kept)
        if not others:
            return _described(problem)
        part = replace(problem, free=others)
        start = _described_at(part)
        o = self.options
        settings = FitSettings(start, NEAR_SIGMA, o.population, o.generations, o.seed)
        # Kept values are part of what is fitted beside: once these are others, it is another fit.
        fit, place = Fit("others", part, settings), f"others-{_short(part.digest)}"
        (found,) = self._fit("what was not diagnosed", [fit], place)
        best = _described_at(problem)
        best[[problem.free.index(name) for name in others]] = found.best
        return replace(found, best=best)

    def _fit_of_all(self, name: str, problem: Problem, near: bool) -> Fit:
        """A fit from the nominal values, which are fitted ones or far from these."""
        o = self.options
        start, sigma = _described_at(problem), NEAR_SIGMA if near else FAR_SIGMA
        return Fit(name, problem, FitSettings(start, sigma, o.population, o.generations, o.seed))

    def _fit_of_fold(self, name: str, problem: Problem, kept: Sequence[int]) -> Fit:
        """A fit of some recordings, from values that were fitted to none of the others.

        What it cannot see stays where it begins, and a short search ends near there.
        """
        left = {r.digest for i, r in enumerate(self.recordings) if i not in kept}
        near = problem.actuator in self.known
        if near and (self.known_by is None or not left.isdisjoint(self.known_by)):
            problem, near = self._whole(problem.actuator), False
        return self._fit_of_all(name, _seen(problem.of(kept)), near)

    def _subsets(self, bounded: Problem) -> tuple[SubsetFit, ...]:
        """Algorithm 1's fits, each over the bounded parameters that its recordings can see."""
        o = self.options
        drawn = draw_subsets(len(self.recordings), o.subsets, o.fraction, o.seed)
        fits = []
        for i, subset in enumerate(drawn):
            problem = _seen(bounded.of(subset))
            at = _described_at(problem)
            settings = FitSettings(
                at, NEAR_SIGMA, o.population, o.subset_generations, o.seed + 1 + i, anchor=at
            )
            fits.append(Fit(f"subset{i}", problem, settings))
        # They start from the nominal fit: another one, after more generations, makes them others.
        place = f"subsets-{_short(bounded.digest, o.fraction)}"
        results = self._fit("subset fits", fits, place)
        return tuple(
            _subset_fit(fit.problem, result, bounded.free)
            for fit, result in zip(fits, results, strict=True)
        )

    def _fit(self, stage: str, fits: list[Fit], place: str = "") -> list[FitResult]:
        """Make fits; where nothing can be seen, values stay what they are."""
        checkpoints = self.out / "checkpoints" / place
        checkpoints.mkdir(parents=True, exist_ok=True)
        seeing = [fit for fit in fits if fit.problem.free]
        made = iter(self.runner.run(seeing, checkpoints, lambda s: self.progress(stage, s)))
        return [next(made) if f.problem.free else _described(f.problem) for f in fits]

    def _bounds(
        self,
        bounded: Problem,
        fitted: dict[Actuator, FitResult],
        held_out: dict[str, float] | None,
        subsets: tuple[SubsetFit, ...],
        begin: float,
    ) -> Bounds:
        space = bounded.free_space
        values = np.array([s.values for s in subsets])
        spread = self._spread(bounded)
        known, together = spread.confidence(0.9), spread.together(0.95)
        lower, upper = expanded_range(np.vstack([values, space.nominal]), space)
        few = (~np.isnan(values)).sum(axis=0) < 2  # no range: the interval alone tells of these
        # An interval is of a minimum, which kept values are not: it does not widen their range.
        most = 0.0 if self.options.as_described else WIDENING
        interval, share = (together.lower, together.upper), np.where(few, 1.0, most)
        lower, upper = widened(lower, upper, interval, space, share)
        lower = np.where(spread.unseen, space.lower, lower)
        upper = np.where(spread.unseen, space.upper, upper)
        actuator = self.options.actuator
        main, nominal = self.full[actuator], fitted[actuator]
        phi = [n for n in bounded.space.names if n in NETWORK_NAMES]
        return Bounds(
            robot=self.robot.name,
            actuator=actuator,
            space=space,
            nominal=space.nominal,
            lower=lower,
            upper=upper,
            ci90=np.stack([known.lower, known.upper], axis=1),
            identified=known.identified,
            correlation=known.correlation,
            weights=bounded.space.select(phi).nominal,
            imu=bounded.space.select(self._imu_told(bounded.space)),
            train=_measured(main, nominal),
            held_out=held_out,
            subsets=subsets,
            splits=self._splits(values, space, subsets),
            histories={a: fitted[a].history for a in self.full},
            omitted=(*main.loss.omitted(), *untold(space, few & ~spread.unseen, self.kept)),
            provenance=self._provenance(time.time() - begin),
        )

    def _spread(self, bounded: Problem) -> Spread:
        """What the recordings tell of the fitted values; of kept ones the diagnosis has told."""
        fitted = tuple(name for name in bounded.free if name not in self.kept)
        part = replace(bounded, free=(*fitted, *self._imu()))
        spread = spread_at(part, _described_at(part), self._uncertainty)
        return spread.among(bounded.free_space)

    def _imu(self) -> tuple[str, ...]:
        """What was fitted of the IMU."""
        seen = self.full[self.options.actuator]
        return tuple(name for name in seen.free if name in imu_names(seen.space))

    def _imu_told(self, space: ParameterSpace) -> tuple[str, ...]:
        """What is told of the IMU: what was fitted here, or acts as a start has it."""
        names, fitted = robot_space(self.robot, self.options.actuator).names, self._imu()
        acting = {name for name, v in zip(space.names, space.nominal, strict=True) if v != 0}
        known = acting.difference(names).union(fitted)
        return tuple(name for name in imu_names(space) if name in known)

    def _uncertainty(self, share: float) -> None:
        self.progress("uncertainty", [Status("replays", round(100 * share), 100, np.inf)])

    def _splits(
        self, values: Array, space: ParameterSpace, subsets: tuple[SubsetFit, ...]
    ) -> tuple[Split, ...]:
        """Parameters that take other values where subsets contain contact."""
        index = {r.id: i for i, r in enumerate(self.recordings)}
        members = [[index[i] for i in s.recordings] for s in subsets]
        ground = [r.support == "ground" for r in self.recordings]
        return tuple(contact_splits(values, space, members, ground, self.options.seed))

    def _provenance(self, seconds: float) -> dict[str, Any]:
        packages = ("pup", "mujoco", "nevergrad", "numpy")
        return {
            "options": self.told,
            "robot_digest": self.robot.digest,
            "recordings": {r.id: r.digest for r in self.recordings},
            "versions": {p: version(p) for p in packages} | {"python": platform.python_version()},
            "seconds": round(seconds, 1),
        }


def _check_place(file: Path, actuator: Actuator) -> None:
    """Refuse to put bounds of one torque law in the place of another's, which took as long."""
    try:
        kind = read_json(file)["actuator"]["kind"]
    except (InputError, LookupError, TypeError):  # there is none, or it is something else
        return
    if kind != actuator:
        raise InputError(
            f"{file}: of the {kind} torque law; use another --out for that of {actuator}, or move "
            "it away"
        )


def _movable(space: ParameterSpace) -> list[str]:
    """The parameters of the nominal model; the description's terms stay as they are."""
    return [name for name in space.names if split_column(name) is None]


def _described_at(problem: Problem) -> Array:
    """The nominal values of the free parameters, on their unit cube."""
    return problem.free_space.normalise(problem.free_space.nominal)


def _seen(problem: Problem) -> Problem:
    """The same with those of its parameters free that its recordings can see."""
    start = _described_at(problem)
    return replace(problem, free=observable(problem, start))


def _described(problem: Problem) -> FitResult:
    """The nominal values, as a fit would tell them that finds no better ones."""
    start = _described_at(problem)
    return FitResult(start, float(problem.losses(start[None])[0]), np.empty(0))


def _short(*parts: object) -> str:
    """A few digits that identify the parts."""
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:12]


def _subset_fit(problem: Problem, fit: FitResult, names: Sequence[str]) -> SubsetFit:
    """A subset's fit of the bounded parameters; NaN for those its recordings cannot see."""
    fitted = problem.values(fit.best[None])[0]
    values = [fitted[problem.space.names.index(n)] if n in problem.free else np.nan for n in names]
    return SubsetFit(
        tuple(r.id for r in problem.recordings),
        any(r.support == "ground" for r in problem.recordings),
        float(problem.losses(fit.best[None])[0]),
        np.array(values),
    )


def _measured(problem: Problem, fit: FitResult) -> dict[str, float]:
    """Loss and RMSE (rad) over all recordings, where the fit begins and where it ends."""
    before = _described_at(problem)
    replayed = problem.replay(np.stack([before, fit.best]))
    losses = problem.loss.total(problem.loss.terms(replayed))
    errors = [pooled_rmse(e) for e in problem.loss.rmse(replayed)]
    return {
        "loss": float(losses[1]),
        "rmse": errors[1],
        "loss_before": float(losses[0]),
        "rmse_before": errors[0],
    }

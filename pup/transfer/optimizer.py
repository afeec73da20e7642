"""Which eta to try next, and which to keep (paper, section V).

The middle of the box and a few uniform trials, or simulated rollouts in their place, then each
trial where noisy expected improvement on the Gaussian process is largest, as long as it is worth a
walk; at the end the tried eta with the largest posterior mean, so that one lucky walk does not
decide. An eta whose trial gave no result, because it overloads the robot, say, is not told to the
process; the next one is sought away from it. Everything is a function of the data, the number of
the trial and the seed: whoever is stopped and asks again is told the same.
"""

import hashlib
import math
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from botorch.acquisition.logei import qLogNoisyExpectedImprovement
from botorch.optim import optimize_acqf
from botorch.sampling import SobolQMCNormalSampler
from numpy.typing import NDArray
from scipy.stats import qmc

from pup.errors import InputError
from pup.transfer.surrogate import Landscapes, Simulated, Surrogate, Told, landscapes, surrogate_of
from pup.transfer.trial import Eta, Purpose

Array = NDArray[np.float64]

CANDIDATES = 512
"""Etas of a low-discrepancy sequence whose acquisition is looked at."""
NEARBY = 128
"""Etas around the best ones so far."""
STARTS = 4
"""Best of them, from which the acquisition is climbed."""
CONFIRMED = 0.12
"""Share of all walks, the last ones, that are of the best eta so far: 3 of 25. On the edge of a
fall one walks far once and falls the next time, which one walk of each does not tell."""
FEWEST = 4
"""Walks before which no search is over: distances that are alike may be so by chance."""
OFFERED = 2
"""Trials without a result after which an initial point, or the best, is left out: one may be an
accident."""
SAMPLES = 64
"""Draws of the process that expected improvement is averaged over."""


@dataclass(frozen=True, eq=False)
class Search:
    """What is searched, and what is known of it.

    Attributes:
      lower: of the box of eta.
      upper: likewise.
      initial: trials before the search, uniform but for the first.
      seed: of everything random.
      eta: of the walks so far, shape (n, n_eta).
      distance: of them, m, shape (n,).
      simulated: rollouts to start from, or None.
      feasible: which walks were, shape (n,); None for all. The others are never chosen.
      trials: walks that there will be; None where that is not known.
      fruitless: etas of the trials that gave no result.
      avoided: of them, those since the last walk.
    """

    lower: Eta
    upper: Eta
    initial: int
    seed: int
    eta: Array
    distance: Array
    simulated: Simulated | None = None
    feasible: NDArray[np.bool_] | None = None
    trials: int | None = None
    fruitless: tuple[Eta, ...] = ()
    avoided: tuple[Eta, ...] = ()

    def __post_init__(self) -> None:
        if self.eta.shape != (len(self.distance), len(self.lower)):
            raise InputError(f"etas of shape {self.eta.shape} for {len(self.distance)} distances")
        if not (np.isfinite(self.eta).all() and np.isfinite(self.distance).all()):
            raise InputError("etas and distances must be finite")
        if self.simulated and self.simulated.eta.shape[1] != len(self.lower):
            raise InputError("simulated rollouts have another number of etas than the study")

    @property
    def digest(self) -> str:
        """SHA-256 of the walks and of what gave none: which data a decision was made on."""
        without = np.array([*self.fruitless, *self.avoided], dtype=float)
        data = (self.eta, self.distance, without)
        return hashlib.sha256(b"".join(x.tobytes() for x in data)).hexdigest()

    @property
    def told(self) -> Told:
        """The walks, on the unit cube."""
        return Told(self.unit(self.eta), self.distance)

    @property
    def prior(self) -> Landscapes | None:
        """The simulated rollouts as landscapes on the unit cube."""
        if self.simulated is None:
            return None
        return landscapes(self.simulated, np.array(self.lower), np.array(self.upper))

    @property
    def confirming(self) -> bool:
        """Whether the walks that are left shall make sure of the best."""
        if self.trials is None or (self.feasible is not None and not self.feasible.any()):
            return False
        return len(self.distance) >= self.trials - int(CONFIRMED * self.trials)

    def best(self, surrogate: Surrogate) -> Array:
        """Of the feasible etas tried, the one with the largest posterior mean, on the unit cube.

        Raises:
          InputError: there is none.
        """
        tried = self.told.eta
        if self.feasible is not None:
            tried = tried[self.feasible]
        if not len(tried):
            raise InputError("no eta was feasible, so nothing can be chosen")
        return np.asarray(tried[np.argmax(surrogate.predict(tried)[0])])

    def walkable(self, unit: Array) -> bool:
        """Whether an eta of the unit cube gives results by now, or has not failed often enough."""
        return int(_same(unit[None], self.unit(self.avoided)).sum()) < OFFERED

    def real(self, unit: Array) -> Array:
        """Etas of the box from those of the unit cube."""
        low, high = np.array(self.lower), np.array(self.upper)
        return np.asarray(np.clip(low + unit * (high - low), low, high))

    def unit(self, eta: Array | tuple[Eta, ...]) -> Array:
        """Etas of the unit cube from those of the box, shape (n, n_eta)."""
        low, high = np.array(self.lower), np.array(self.upper)
        return np.asarray((np.reshape(eta, (-1, len(low))) - low) / (high - low))


@dataclass(frozen=True)
class Decision:
    """An eta and why.

    Attributes:
      eta: decided on.
      purpose: of the trial; that of a choice is to repeat it.
      why: how it was found, in words.
      walks: number of walks it was decided on.
      digest: SHA-256 of them.
      mean: expected distance, m; None without a process.
      deviation: of the expectation, m.
      gain: expected over the best eta tried, m; None where it did not decide.
      best: expected distance of that one, m; likewise.
      hyperparameters: of the process.
      seconds: that it took.
    """

    eta: Eta
    purpose: Purpose
    why: str
    walks: int
    digest: str
    mean: float | None = None
    deviation: float | None = None
    gain: float | None = None
    best: float | None = None
    hyperparameters: dict[str, Any] | None = None
    seconds: float = 0.0

    def is_worth(self, least: float) -> bool:
        """Whether a walk is expected to gain enough; always while nothing walks forward.

        So it is while there are few walks: what they tell of the rest is not known to be right.

        Args:
          least: gain as a share of the best eta's distance.
        """
        if self.gain is None or self.best is None or self.walks < FEWEST:
            return True
        return self.gain >= least * self.best


def suggest(search: Search, number: int) -> Decision:
    """The eta of the next trial.

    Args:
      search: what is known.
      number: of the trial in its study, from 1; another one draws other numbers.
    """
    began = time.perf_counter()
    if search.simulated is None and len(search.distance) < search.initial:
        place, unit = _next_initial(search)
        uniform = f"uniform, before {search.initial} walks"
        return Decision(
            tuple(search.real(unit[None])[0].tolist()),
            Purpose.INITIAL,
            uniform if place else "the middle of the box",
            len(search.distance),
            search.digest,
            seconds=time.perf_counter() - began,
        )
    surrogate = surrogate_of(search.told, search.prior)
    rng = np.random.default_rng((search.seed, number))
    if search.confirming and search.walkable(unit := search.best(surrogate)):
        why = "the best so far, once more before one is kept"
        return _decision(search, surrogate, unit, Purpose.SEARCH, why, began)
    if len(search.distance) or search.avoided:
        unit, gain, best = _improve(surrogate, search, rng)
        away = ", away from what gave no result" if search.avoided else ""
        why = f"largest noisy expected improvement{away}"
        decision = _decision(search, surrogate, unit, Purpose.SEARCH, why, began)
        return replace(decision, gain=gain, best=best)
    candidates = _candidates(len(search.lower), rng)
    unit = candidates[np.argmax(surrogate.predict(candidates)[0])]
    return _decision(search, surrogate, unit, Purpose.SEARCH, "best in simulation", began)


def choose(search: Search, because: str = "") -> Decision:
    """The eta to keep: of those tried, the one with the largest posterior mean.

    Args:
      search: what is known.
      because: why the search ends, in words, where it does not end with its last trial.
    """
    began = time.perf_counter()
    if not len(search.distance):
        raise InputError("nothing was walked yet, so nothing can be chosen")
    surrogate = surrogate_of(search.told, search.prior)
    unit = search.best(surrogate)
    why = "; ".join(filter(None, (because, "largest posterior mean of the etas tried")))
    return _decision(search, surrogate, unit, Purpose.REPEAT, why, began)


@dataclass(frozen=True)
class Slice:
    """The process along one entry of eta, the others as in the best.

    Attributes:
      entry: of eta, from 0.
      eta: its values.
      mean: m.
      deviation: m.
    """

    entry: int
    eta: tuple[float, ...]
    mean: tuple[float, ...]
    deviation: tuple[float, ...]


def slices(search: Search, points: int = 41) -> tuple[Slice, ...]:
    """The process through the eta that would be chosen now, a slice for each entry."""
    surrogate = surrogate_of(search.told, search.prior)
    best = search.best(surrogate)
    drawn = []
    for entry in range(len(search.lower)):
        line = np.tile(best, (points, 1))
        line[:, entry] = np.linspace(0, 1, points)
        mean, deviation = surrogate.predict(line)
        real = search.real(line)[:, entry]
        drawn.append(
            Slice(entry, tuple(real.tolist()), tuple(mean.tolist()), tuple(deviation.tolist()))
        )
    return tuple(drawn)


def _decision(
    search: Search,
    surrogate: Surrogate,
    unit: Array,
    purpose: Purpose,
    why: str,
    began: float,
) -> Decision:
    mean, deviation = surrogate.predict(unit[None])
    return Decision(
        tuple(search.real(unit[None])[0].tolist()),
        purpose,
        why,
        len(search.distance),
        search.digest,
        float(mean[0]),
        float(deviation[0]),
        hyperparameters=surrogate.hyperparameters,
        seconds=time.perf_counter() - began,
    )


def _next_initial(search: Search) -> tuple[int, Array]:
    """The first initial point that no walk was told of, and its place, from 0.

    It goes by walks, not by numbers of trials, so that one whose trial gave no result is offered
    again; after `OFFERED` such trials it is left out.
    """
    told, fruitless = search.told.eta, search.unit(search.fruitless)
    points = _initials(len(search.lower), search.seed, len(told) + len(fruitless) + 1)
    walked = _same(points, told).any(axis=1)
    place = int(np.argmin(walked | (_same(points, fruitless).sum(axis=1) >= OFFERED)))
    return place, points[place]


def _initials(n_eta: int, seed: int, count: int) -> Array:
    """The middle, then a scrambled Sobol sequence: uniform, and far from each other."""
    sobol = qmc.Sobol(n_eta, rng=np.random.default_rng(seed))
    drawn = sobol.random_base2(count.bit_length())
    return np.vstack([np.full(n_eta, 0.5), drawn])[:count]


def _same(points: Array, others: Array) -> NDArray[np.bool_]:
    """Which points of the unit cube are which of others, shape (n_points, n_others)."""
    return np.asarray((np.abs(points[:, None] - others[None]) < 1e-9).all(axis=-1))


def _candidates(n_eta: int, rng: np.random.Generator) -> Array:
    return np.asarray(qmc.Sobol(n_eta, rng=rng).random(CANDIDATES))


def _improve(
    surrogate: Surrogate, search: Search, rng: np.random.Generator
) -> tuple[Array, float | None, float | None]:
    """Where noisy expected improvement is largest, over what is avoided too.

    Etas to avoid are as if walked, with distances not known yet: whatever is near them improves
    on them by little. A walk is worth what it gains over those that were made.

    Returns:
      The eta on the unit cube, the improvement over the best eta walked, and what that one is
      expected to walk, m; None where there is none.
    """
    known = search.told.eta
    baseline = np.vstack([known, search.unit(search.avoided)])
    n_eta = known.shape[1]
    torch.manual_seed(int(rng.integers(2**31)))
    drawn = int(rng.integers(2**31))
    acquisition = _acquisition(surrogate, baseline, drawn)
    means, _ = surrogate.predict(baseline)
    best = baseline[np.argsort(-means)[:3]]
    around = best[rng.integers(len(best), size=NEARBY)] + rng.normal(0, 0.1, (NEARBY, n_eta))
    tried = np.vstack([_candidates(n_eta, rng), np.clip(around, 0, 1)])
    with torch.no_grad():
        values = acquisition(torch.as_tensor(tried).unsqueeze(1)).numpy()
    starts = torch.as_tensor(tried[np.argsort(-values)[:STARTS]]).unsqueeze(1)
    bounds = torch.tensor([[0.0] * n_eta, [1.0] * n_eta], dtype=torch.double)
    found, value = optimize_acqf(
        acquisition,
        bounds,
        q=1,
        num_restarts=STARTS,
        batch_initial_conditions=starts,
        options={"maxiter": 25},
    )
    unit = found[0].clamp(0, 1).numpy()
    if not len(known):
        return unit, None, None
    if search.avoided:
        value = _acquisition(surrogate, known, drawn)(found).detach()
    gain = surrogate.scale * math.exp(float(value))
    return unit, gain, float(surrogate.predict(known)[0].max())


def _acquisition(surrogate: Surrogate, baseline: Array, seed: int) -> qLogNoisyExpectedImprovement:
    return qLogNoisyExpectedImprovement(
        surrogate.model,
        torch.as_tensor(baseline),
        sampler=SobolQMCNormalSampler(torch.Size([SAMPLES]), seed=seed),
        prune_baseline=False,
    )

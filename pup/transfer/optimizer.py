"""Which eta to try next, and which to keep (paper, section V).

The middle of the box and a few uniform trials, or simulated rollouts in their place, then each
trial where noisy expected improvement on the Gaussian process is largest, as long as it is worth a
walk; at the end the tried eta with the largest posterior mean, so that one lucky walk does not
decide. Everything is a function of the data, the number of the trial and the seed: whoever is
stopped and asks again is told the same.
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

    def __post_init__(self) -> None:
        if self.eta.shape != (len(self.distance), len(self.lower)):
            raise InputError(f"etas of shape {self.eta.shape} for {len(self.distance)} distances")
        if not (np.isfinite(self.eta).all() and np.isfinite(self.distance).all()):
            raise InputError("etas and distances must be finite")
        if self.simulated and self.simulated.eta.shape[1] != len(self.lower):
            raise InputError("simulated rollouts have another number of etas than the study")

    @property
    def digest(self) -> str:
        """SHA-256 of the walks: which data a decision was made on."""
        return hashlib.sha256(self.eta.tobytes() + self.distance.tobytes()).hexdigest()

    @property
    def told(self) -> Told:
        """The walks, on the unit cube."""
        return Told(self._unit(self.eta), self.distance)

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

    def real(self, unit: Array) -> Array:
        """Etas of the box from those of the unit cube."""
        low, high = np.array(self.lower), np.array(self.upper)
        return np.asarray(np.clip(low + unit * (high - low), low, high))

    def _unit(self, eta: Array) -> Array:
        low, high = np.array(self.lower), np.array(self.upper)
        return np.asarray((eta - low) / (high - low))


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
        eta = search.real(_initial(len(search.lower), search.seed, number)[None])[0]
        return Decision(
            tuple(eta.tolist()),
            Purpose.INITIAL,
            "the middle of the box" if number == 1 else f"uniform, before {search.initial} walks",
            len(search.distance),
            search.digest,
            seconds=time.perf_counter() - began,
        )
    surrogate = surrogate_of(search.told, search.prior)
    rng = np.random.default_rng((search.seed, number))
    if search.confirming:
        unit = search.best(surrogate)
        why = "the best so far, once more before one is kept"
        return _decision(search, surrogate, unit, Purpose.SEARCH, why, began)
    if len(search.distance):
        unit, gain = _improve(surrogate, search.told, rng)
        best = float(surrogate.predict(search.told.eta)[0].max())
        why = "largest noisy expected improvement"
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


def _initial(n_eta: int, seed: int, number: int) -> Array:
    """The middle, then a scrambled Sobol sequence: uniform, and far from each other."""
    if number == 1:
        return np.full(n_eta, 0.5)
    drawn = qmc.Sobol(n_eta, rng=np.random.default_rng(seed)).random_base2(number.bit_length())
    return np.asarray(drawn[number - 2])


def _candidates(n_eta: int, rng: np.random.Generator) -> Array:
    return np.asarray(qmc.Sobol(n_eta, rng=rng).random(CANDIDATES))


def _improve(surrogate: Surrogate, told: Told, rng: np.random.Generator) -> tuple[Array, float]:
    """Where the logarithm of noisy expected improvement is largest; the improvement there, m."""
    n_eta = told.eta.shape[1]
    torch.manual_seed(int(rng.integers(2**31)))
    acquisition = qLogNoisyExpectedImprovement(
        surrogate.model,
        torch.as_tensor(told.eta),
        sampler=SobolQMCNormalSampler(torch.Size([SAMPLES]), seed=int(rng.integers(2**31))),
        prune_baseline=False,
    )
    means, _ = surrogate.predict(told.eta)
    best = told.eta[np.argsort(-means)[:3]]
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
    return found[0].clamp(0, 1).numpy(), surrogate.scale * math.exp(float(value))

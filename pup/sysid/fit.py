"""One CMA-ES fit: ask, evaluate, tell, with a checkpoint after every generation."""

import hashlib
import io
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import nevergrad as ng
import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.files import write_atomic

Array = NDArray[np.float64]

W_REG = 0.05
"""Weight of the pull towards the nominal parameters, on the unit cube (paper, section III-A)."""

# Pycma restarts itself from the first point when it thinks it is done, and forgets what it found:
# it is told never to be done, and the best is tracked here.
_NEVER_DONE = {
    "tolfun": 0,
    "tolfunhist": 0,
    "tolx": 0,
    "tolstagnation": 0,
    "tolflatfitness": 10**9,
    "maxiter": 10**9,
    "tolconditioncov": 0,
    "tolupsigma": 1e30,
    "tolfacupx": 1e30,
}


@dataclass(frozen=True)
class FitSettings:
    """How CMA-ES searches the unit cube.

    Attributes:
      start: first mean, shape (n_parameters,), on the unit cube.
      sigma: first step size on the unit cube: 0.25 from scratch, 0.05 around a known optimum.
      population: candidates per generation.
      generations: how many.
      seed: of the search.
      anchor: where the regulariser pulls to, or None for no regulariser.
    """

    start: Array
    sigma: float = 0.25
    population: int = 16
    generations: int = 500
    seed: int = 0
    anchor: Array | None = None

    @property
    def digest(self) -> str:
        """Identifies the search, whatever its number of generations."""
        parts = (self.start, self.sigma, self.population, self.seed, self.anchor)
        return hashlib.sha256(repr([np.asarray(p).tolist() for p in parts]).encode()).hexdigest()


@dataclass(frozen=True)
class FitResult:
    """What a fit found.

    Attributes:
      best: the best candidate, on the unit cube.
      loss: its objective: the loss and the regulariser.
      history: best objective so far after each generation.
    """

    best: Array
    loss: float
    history: Array


class CmaFit:
    """CMA-ES by nevergrad with its own record of the best.

    The state is a function of the settings and of the losses told so far, so a checkpoint holds
    the losses alone: resuming tells them again, which costs milliseconds a generation, needs no
    pickle and continues to the last bit.

    Args:
      settings: the search.
      problem: identifies what is minimised; a checkpoint of another problem is refused.
    """

    def __init__(self, settings: FitSettings, problem: str = "") -> None:
        self.settings = settings
        self.identity = f"{settings.digest} {problem}"
        dimension = len(settings.start)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # steps wide for the box are what is asked for
            start = np.clip(settings.start, 1e-6, 1 - 1e-6)
            array = ng.p.Array(init=start).set_mutation(sigma=0.1)
            array.set_bounds(0.0, 1.0, method="bouncing")
        array.random_state.seed(settings.seed)
        # Nevergrad multiplies its scale by 0.15, below 18 dimensions by 0.3.
        scale = settings.sigma / (0.1 * (0.3 if dimension < 18 else 0.15))
        make = ng.optimizers.ParametrizedCMA(
            scale=scale, popsize=settings.population, inopts=_NEVER_DONE
        )
        self._optimizer = make(array, budget=10**9, num_workers=settings.population)
        self._asked: list[ng.p.Array] = []
        self._best = settings.start
        self._loss = np.inf
        self._history: list[float] = []
        self._told: list[Array] = []

    @property
    def generation(self) -> int:
        """Generations told so far."""
        return len(self._told)

    @property
    def result(self) -> FitResult:
        """The best so far."""
        return FitResult(self._best, self._loss, np.array(self._history))

    def ask(self) -> Array:
        """The next generation, shape (population, n_parameters), on the unit cube."""
        self._asked = [self._optimizer.ask() for _ in range(self.settings.population)]
        return np.array([candidate.value for candidate in self._asked])

    def tell(self, losses: Array) -> None:
        """Report the losses of the generation asked last, shape (population,)."""
        values = np.array([candidate.value for candidate in self._asked])
        objective = losses
        if self.settings.anchor is not None:
            objective = losses + W_REG * ((values - self.settings.anchor) ** 2).sum(axis=1)
        for candidate, value in zip(self._asked, objective, strict=True):
            self._optimizer.tell(candidate, float(value))
        best = int(np.argmin(objective))
        if objective[best] < self._loss:
            self._loss, self._best = float(objective[best]), values[best]
        self._history.append(self._loss)
        self._told.append(np.array(losses))

    def save(self, path: Path) -> None:
        """Write the checkpoint atomically."""
        buffer = io.BytesIO()
        np.savez(buffer, schema=1, fit=self.identity, losses=np.array(self._told))
        write_atomic(path, buffer.getvalue())

    def resume(self, path: Path) -> None:
        """Take up a checkpoint; one of another search, or a torn file, is refused.

        Raises:
          InputError: the file is not a checkpoint of this search.
        """
        try:
            with np.load(path, allow_pickle=False) as saved:
                identity, losses = str(saved["fit"]), saved["losses"]
        except (OSError, ValueError, KeyError, BadZipFile) as error:
            raise InputError(
                f"{path}: not a checkpoint of a fit; delete it to start again"
            ) from error
        if identity != self.identity:
            raise InputError(
                f"{path}: checkpoint of a fit with other recordings or settings; "
                "use another --out or delete it"
            )
        for generation in losses[: self.settings.generations]:
            self.ask()
            self.tell(generation)


def run_fit(
    settings: FitSettings,
    evaluate: Callable[[Array], Array],
    checkpoint: Path | None = None,
    progress: Callable[[FitResult], None] | None = None,
    problem: str = "",
) -> FitResult:
    """Run a fit to its last generation, from its checkpoint where there is one.

    Args:
      settings: the search.
      evaluate: losses (population,) of candidates (population, n_parameters) on the unit cube.
      checkpoint: file written after every generation.
      progress: called after every generation.
      problem: identifies what is evaluated, see CmaFit.
    """
    fit = CmaFit(settings, problem)
    if checkpoint is not None and checkpoint.exists():
        fit.resume(checkpoint)
    while fit.generation < settings.generations:
        fit.tell(evaluate(fit.ask()))
        if checkpoint is not None:
            fit.save(checkpoint)
        if progress is not None:
            progress(fit.result)
    return fit.result

"""One CMA-ES fit: ask, evaluate, tell, with a checkpoint after every generation."""

import hashlib
import io
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nevergrad as ng
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pup.errors import InputError
from pup.files import write_atomic

Array = NDArray[np.float64]

SEARCH = 1
"""Raised with every change of how a fit searches or is polished, the constants of both included,
which makes old checkpoints another's."""
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
        parts = (SEARCH, self.start, self.sigma, self.population, self.seed, self.anchor)
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
        spare = max(
            0, 2 - len(settings.start)
        )  # CMA-ES wants two dimensions: one that does nothing
        dimension = len(settings.start) + spare
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # steps wide for the box are what is asked for
            start = np.clip(np.append(settings.start, np.full(spare, 0.5)), 1e-6, 1 - 1e-6)
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
        self.polished: Array | None = None
        self.longer = False  # whether its checkpoint holds more generations than are asked for

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
        return self._values()

    def tell(self, losses: Array) -> None:
        """Report the losses of the generation asked last, shape (population,)."""
        values = self._values()
        objective = self._objective(values, losses)
        for candidate, value in zip(self._asked, objective, strict=True):
            self._optimizer.tell(candidate, float(value))
        best = int(np.argmin(objective))
        if objective[best] < self._loss:
            self._loss, self._best = float(objective[best]), values[best]
        self._history.append(self._loss)
        self._told.append(np.array(losses))

    def consider(self, value: Array, loss: float) -> None:
        """Take a point outside the search into account: its result is never worse than this."""
        objective = self._objective(value[None], np.array([loss]))[0]
        if objective < self._loss:
            self._loss, self._best = float(objective), value

    def _values(self) -> Array:
        """The generation asked last, shape (population, n_parameters)."""
        return np.array([c.value[: len(self.settings.start)] for c in self._asked])

    def _objective(self, values: Array, losses: Array) -> Array:
        """The loss and the regulariser."""
        if self.settings.anchor is None:
            return losses
        pull = ((values - self.settings.anchor) ** 2).sum(axis=1)
        return np.asarray(losses + W_REG * pull)

    def save(self, path: Path) -> None:
        """Write the checkpoint atomically."""
        buffer = io.BytesIO()
        arrays: dict[str, Any] = {"losses": np.array(self._told)}
        if self.polished is not None:
            arrays["polished"] = self.polished
        np.savez(buffer, schema=1, fit=self.identity, **arrays)
        write_atomic(path, buffer.getvalue())

    def resume(self, path: Path) -> None:
        """Take up a checkpoint; one of another search, or a torn file, is refused.

        Raises:
          InputError: the file is not a checkpoint of this search.
          OSError: it cannot be read now.
        """
        content = io.BytesIO(path.read_bytes())
        try:
            with np.load(content, allow_pickle=False) as saved:
                identity, losses = str(saved["fit"]), saved["losses"]
                polished = saved.get("polished")
        except Exception as error:  # NumPy's reader raises what a torn file happens to hit
            raise InputError(
                f"{path}: not a checkpoint of a fit; delete it to start again"
            ) from error
        if identity != self.identity:
            raise InputError(
                f"{path}: checkpoint of a fit with other recordings or settings, or by the physics "
                "of another pup; use another --out or delete it"
            )
        for generation in losses[: self.settings.generations]:
            self.ask()
            self.tell(generation)
        self.longer = len(losses) > self.settings.generations
        if len(losses) == self.settings.generations:
            self.polished = polished


def run_fit(
    settings: FitSettings,
    evaluate: Callable[[Array], Array],
    checkpoint: Path | None = None,
    progress: Callable[[FitResult], None] | None = None,
    problem: str = "",
    polish: Callable[[Array], Array] | None = None,
) -> FitResult:
    """Run a fit to its last generation, from its checkpoint where there is one.

    Args:
      settings: the search.
      evaluate: losses (population,) of candidates (population, n_parameters) on the unit cube.
      checkpoint: file written after every generation.
      progress: called after every generation.
      problem: identifies what is evaluated, see CmaFit.
      polish: improves the best point of the search, on the unit cube, at its end.
    """
    with threadpool_limits(limits=1):  # the sums of BLAS depend on its threads, the fit must not
        fit = CmaFit(settings, problem)
        if checkpoint is not None and checkpoint.exists():
            fit.resume(checkpoint)
        while fit.generation < settings.generations:
            fit.tell(evaluate(fit.ask()))
            if checkpoint is not None:
                fit.save(checkpoint)
            if progress is not None:
                progress(fit.result)
        # The first mean itself is never a candidate; a short search may not have found its like.
        fit.consider(settings.start, float(evaluate(settings.start[None])[0]))
        if polish is not None:
            if fit.polished is None:
                fit.polished = polish(fit.result.best)
                if checkpoint is not None and not fit.longer:
                    fit.save(checkpoint)
            fit.consider(fit.polished, float(evaluate(fit.polished[None])[0]))
        return fit.result

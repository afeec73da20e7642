"""The Gaussian process of distance over eta, by GPyTorch and BoTorch.

Distances are scaled to mean 0 and deviation 1, etas to the unit cube; a Matern 5/2 kernel with a
length for each dimension, and noise, are fitted by their posterior's maximum. Simulated rollouts,
where given, are the prior: their mean over mu is the process's mean, and the ways in which the
landscapes of different mu differ from it are added to its covariance, so that a few walks tell
which of them the robot resembles.
"""

import hashlib
import warnings
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from botorch.exceptions.errors import ModelFittingError
from botorch.exceptions.warnings import BotorchWarning
from botorch.fit import fit_gpytorch_mll
from botorch.models import SingleTaskGP
from gpytorch.constraints import GreaterThan
from gpytorch.kernels import Kernel, MaternKernel, ScaleKernel
from gpytorch.likelihoods import GaussianLikelihood
from gpytorch.means import ConstantMean, Mean
from gpytorch.mlls import ExactMarginalLogLikelihood
from gpytorch.priors import GammaPrior, LogNormalPrior
from numpy.typing import NDArray

from pup.errors import InputError

Array = NDArray[np.float64]

SIMULATED_LIMIT = 2**16  # rollouts
MODES = 6
"""Ways in which simulated landscapes may differ from their mean."""
DOUBTED = 4
"""Walks from which on simulated landscapes must explain them better than none do."""
SPREAD_FLOOR = 1e-3
"""Least deviation of distances that they are scaled by, m."""
LENGTHS = {False: (0.4, 0.9), True: (0.0, 0.7)}
"""Mean and deviation of the logarithm of the kernel's lengths, by whether there is a prior: without
one it may have to tell of all the box from a slope in a corner of it."""
SMOOTH = 0.35
"""Length of the kernel that joins simulated etas, on the unit cube."""


@dataclass(frozen=True, eq=False)
class Simulated:
    """Rollouts of the policy in simulation, a landscape over eta for each mu.

    Attributes:
      eta: shape (n_points, n_eta).
      distance: m, shape (n_mu, n_points).
    """

    eta: Array
    distance: Array

    def __post_init__(self) -> None:
        if self.eta.ndim != 2 or self.distance.ndim != 2:
            raise InputError("simulated rollouts need tables of eta and of distance")
        if self.distance.shape[1] != len(self.eta) or not self.distance.size:
            raise InputError(
                f"simulated rollouts have {self.distance.shape[1]} distances for each mu, but "
                f"{len(self.eta)} etas"
            )
        if self.distance.size > SIMULATED_LIMIT:
            raise InputError(f"more than {SIMULATED_LIMIT} simulated rollouts")
        if not (np.isfinite(self.eta).all() and np.isfinite(self.distance).all()):
            raise InputError("simulated rollouts must be finite")

    @property
    def digest(self) -> str:
        """SHA-256 of the numbers."""
        return hashlib.sha256(self.eta.tobytes() + self.distance.tobytes()).hexdigest()


@dataclass(frozen=True, eq=False)
class Told:
    """Walks on the robot.

    Attributes:
      eta: on the unit cube, shape (n, n_eta).
      distance: m, shape (n,).
    """

    eta: Array
    distance: Array


@dataclass(frozen=True, eq=False)
class Landscapes:
    """Simulated landscapes as functions on the unit cube, by kernel interpolation.

    Attributes:
      points: shape (n_points, n_eta).
      mean: weights of the mean over mu, shape (n_points,).
      centre: m, added to it.
      modes: weights of the ways to differ, each times its deviation, shape (n_points, n_modes).
    """

    points: Array
    mean: Array
    centre: float
    modes: Array

    @classmethod
    def of(cls, points: Array, distance: Array) -> "Landscapes":
        """Smooth landscapes.

        Args:
          points: etas on the unit cube, shape (n_points, n_eta).
          distance: m, shape (n_mu, n_points).
        """
        gram = _smooth(points, points)
        noise = _noise(gram, distance)
        average, centre = distance.mean(axis=0), float(distance.mean())
        n_mu = len(distance)
        mean = np.linalg.solve(gram + noise / n_mu * np.eye(len(points)), average - centre)
        smoothed = np.linalg.solve(gram + noise * np.eye(len(points)), (distance - average).T)
        left, size, _ = np.linalg.svd(gram @ smoothed, full_matrices=False)
        kept = min(MODES, n_mu - 1)
        shapes = left[:, :kept] * size[:kept] / np.sqrt(max(1, n_mu - 1))
        modes = np.linalg.solve(gram + 1e-6 * np.eye(len(points)), shapes)
        return cls(points, mean, centre, modes)

    @property
    def spread(self) -> float:
        """Deviation over etas and mu, m."""
        mean, modes = self.at(self.points)
        return float(np.sqrt(mean.var() + (modes**2).sum(axis=1).mean()))

    def at(self, eta: Array) -> tuple[Array, Array]:
        """Mean, shape (n,), and modes, shape (n, n_modes), m."""
        near = _smooth(eta, self.points)
        return self.centre + near @ self.mean, near @ self.modes


def _smooth(a: Array, b: Array) -> Array:
    squared = ((a[:, None] - b[None]) ** 2).sum(axis=-1)
    return np.asarray(np.exp(-squared / (2 * SMOOTH**2)))


def _noise(gram: Array, distance: Array) -> float:
    """Noise of one rollout over the landscapes' variance, by the likelihood over all mu."""
    values, vectors = np.linalg.eigh(gram)
    turned = (distance - distance.mean()) @ vectors
    ratios = np.geomspace(1e-3, 10.0, 25)

    def misfit(ratio: float) -> float:
        spread = np.maximum(values, 0) + ratio
        scale = (turned**2 / spread).mean()
        return float(np.log(spread).mean() + np.log(max(scale, 1e-300)))

    return float(min(ratios, key=misfit))


@lru_cache(maxsize=8)
def _landscapes(_: str, points: bytes, n_eta: int, distance: bytes, n_mu: int) -> Landscapes:
    table = np.frombuffer(points).reshape(-1, n_eta)
    return Landscapes.of(table, np.frombuffer(distance).reshape(n_mu, -1))


def landscapes(simulated: Simulated, lower: Array, upper: Array) -> Landscapes:
    """The landscapes of simulated rollouts; made once for the same ones."""
    points = np.ascontiguousarray((simulated.eta - lower) / (upper - lower))
    distance = np.ascontiguousarray(simulated.distance)
    return _landscapes(
        simulated.digest, points.tobytes(), points.shape[1], distance.tobytes(), len(distance)
    )


class _Fixed(Mean):
    """The simulated mean in scaled distances, and what the robot adds to it everywhere."""

    def __init__(self, prior: Landscapes, centre: float, scale: float) -> None:
        super().__init__()
        self.prior, self.centre, self.scale = prior, centre, scale
        self.offset = ConstantMean()

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        flat = x.reshape(-1, x.shape[-1])
        told = (_features(self.prior, flat)[..., 0] - self.centre) / self.scale
        return told.reshape(x.shape[:-1]) + self.offset(x)


class _Modes(Kernel):
    """Covariance of landscapes that differ from their mean by the simulated modes."""

    def __init__(self, prior: Landscapes, scale: float) -> None:
        super().__init__()
        self.prior, self.scale = prior, scale

    def forward(
        self, x1: torch.Tensor, x2: torch.Tensor, diag: bool = False, **_: Any
    ) -> torch.Tensor:
        a, b = (_features(self.prior, x)[..., 1:] / self.scale for x in (x1, x2))
        return (a * b).sum(dim=-1) if diag else a @ b.transpose(-1, -2)


def _features(prior: Landscapes, x: torch.Tensor) -> torch.Tensor:
    """Mean and modes, shape (..., 1 + n_modes), in torch, so that they have gradients."""
    points = torch.tensor(prior.points)
    squared = ((x.unsqueeze(-2) - points) ** 2).sum(dim=-1)
    near = torch.exp(-squared / (2 * SMOOTH**2))
    weights = torch.as_tensor(np.column_stack([prior.mean, prior.modes]))
    return (
        near @ weights
        + torch.nn.functional.one_hot(torch.tensor(0), weights.shape[1]) * prior.centre
    )


class Surrogate:
    """A fitted process.

    Args:
      told: walks on the robot; may be none where there is a prior.
      prior: simulated landscapes, or None.
    """

    def __init__(self, told: Told, prior: Landscapes | None = None) -> None:
        self.simulated = prior is not None
        if prior is None:
            self.centre, spread = float(told.distance.mean()), _spread(told.distance)
        else:
            self.centre, spread = prior.centre, prior.spread
        self.scale = max(spread, SPREAD_FLOOR)
        self.model = _model(told, prior, self.centre, self.scale)
        if len(told.distance) >= 2:
            _fit(self.model)
        self.model.eval()

    def evidence(self) -> float:
        """Logarithm of the probability density of the walks' distances, in m."""
        inputs, targets = self.model.train_inputs, self.model.train_targets
        with torch.no_grad():
            expected = self.model.likelihood(self.model.forward(*inputs))
            return float(expected.log_prob(targets)) - len(targets) * float(np.log(self.scale))

    def predict(self, eta: Array) -> tuple[Array, Array]:
        """Mean and deviation of the distance without noise, m, each of shape (n,)."""
        with torch.no_grad():
            posterior = self.model.posterior(torch.as_tensor(eta))
            mean = posterior.mean.squeeze(-1).numpy()
            deviation = posterior.variance.clamp_min(0).sqrt().squeeze(-1).numpy()
        return self.centre + self.scale * mean, self.scale * deviation

    @property
    def hyperparameters(self) -> dict[str, Any]:
        """Lengths on the unit cube, deviations of signal and noise, m; whether there is a prior."""
        kernel = self.model.covar_module
        matern = kernel.kernels[0] if hasattr(kernel, "kernels") else kernel
        return {
            "lengths": matern.base_kernel.lengthscale.detach().reshape(-1).tolist(),
            "simulated": self.simulated,
            "signal": self.scale * float(matern.outputscale.detach().sqrt()),
            "noise": self.scale * float(self.model.likelihood.noise.detach().sqrt()),
        }


def _spread(distance: Array) -> float:
    """Deviation of distances, m; of a single one, of which nothing is known, its own size."""
    return float(distance.std() if len(distance) > 1 else np.abs(distance).max())


def surrogate_of(told: Told, prior: Landscapes | None) -> Surrogate:
    """The process of some walks; without the simulated prior where they speak against it."""
    fitted = Surrogate(told, prior)
    if prior is None or len(told.distance) < DOUBTED:
        return fitted
    alone = Surrogate(told)
    return alone if alone.evidence() > fitted.evidence() else fitted


def _model(told: Told, prior: Landscapes | None, centre: float, scale: float) -> SingleTaskGP:
    matern = ScaleKernel(
        MaternKernel(
            nu=2.5,
            ard_num_dims=told.eta.shape[1],
            lengthscale_prior=LogNormalPrior(*LENGTHS[prior is not None]),
            lengthscale_constraint=GreaterThan(0.025),
        ),
        outputscale_prior=LogNormalPrior(0.0, 1.0) if prior is None else GammaPrior(2.0, 6.0),
    )
    matern.base_kernel.lengthscale = 1.0
    matern.outputscale = 1.0 if prior is None else 0.3
    likelihood = GaussianLikelihood(
        noise_prior=LogNormalPrior(-3.0, 1.0), noise_constraint=GreaterThan(1e-4)
    )
    likelihood.noise = 0.05
    model = SingleTaskGP(
        torch.as_tensor(told.eta),
        torch.as_tensor((told.distance - centre) / scale).unsqueeze(-1),
        likelihood=likelihood,
        covar_module=matern if prior is None else matern + _Modes(prior, scale),
        mean_module=ConstantMean() if prior is None else _Fixed(prior, centre, scale),
        outcome_transform=None,
    )
    return model.double()


def _fit(model: SingleTaskGP) -> None:
    """Find the most likely hyperparameters; those that it began with stay where it fails."""
    with warnings.catch_warnings(), suppress(ModelFittingError):  # BoTorch has put them back then
        warnings.simplefilter("ignore", BotorchWarning)
        warnings.simplefilter("ignore", RuntimeWarning)
        fit_gpytorch_mll(
            ExactMarginalLogLikelihood(model.likelihood, model),
            optimizer_kwargs={"options": {"maxiter": 60}},
        )

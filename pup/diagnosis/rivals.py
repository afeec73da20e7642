"""A diagnosis beside its rivals: the paper's NN-PD and a black box, on the same data.

Naming what is missing should be worth more than a servo model with a network in it, and more than
a network that learns the errors. All are fitted to the same recordings but for one type of motion,
and judged by that type, in the same folds and on the same readings as the diagnosis itself.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.coordinates import Coordinate, nominal_coordinate
from pup.diagnosis.fit import Fit
from pup.diagnosis.fitting import fit_together
from pup.diagnosis.held_out import HeldOut, held_out
from pup.diagnosis.replays import Replays
from pup.diagnosis.residuals import LOST, Measured, Noise
from pup.diagnosis.result import Diagnosis
from pup.diagnosis.selection import Selector
from pup.physics.parameters import NETWORK_NAMES, ParameterSpace
from pup.robot import NetworkOptions

Array = NDArray[np.float64]

NOMINAL, NN_PD, NETWORK, DIAGNOSED = "nominal", "nn_pd", "residual_network", "diagnosed"
OUTPUTS = NETWORK_NAMES[15:]
"""Weights and biases of the network's last layer."""
ITERATIONS, SLACK = 24, 1e-4
"""Steps of NN-PD's fit, at most, and relative gain of chi-squared at which it may end."""
BEGINNINGS = (Fit.damping, 1.0, 10.0, 100.0)
"""Dampings that NN-PD's fit begins with, the first that leads anywhere. Its weights' box may bend a
first step that is damped little until it promises nothing, which looks like an end."""
LEAST = 0.1
"""Smallest scale of the active damping at the start: at none, a logarithm would stay there."""


@dataclass(frozen=True)
class Errors:
    """Root mean square errors of the joints on motions left out, rad.

    Attributes:
      overall: of all readings.
      per_motion: by type of motion.
      per_joint: by joint.
    """

    overall: float
    per_motion: Mapping[str, float]
    per_joint: Mapping[str, float]


@dataclass(frozen=True)
class Rivals:
    """A diagnosis and its rivals on motions left out of their fits.

    Attributes:
      errors: by model: `nominal`, `nn_pd` (where the robot describes one), `residual_network` and
        `diagnosed`.
      better: 90 % interval of how much smaller the diagnosed model's error is than each other's, as
        a share of the other's, over motions.
      nn_pd_fit: error of NN-PD on what it was fitted to, before and after, rad; None without one.
    """

    errors: Mapping[str, Errors]
    better: Mapping[str, tuple[float, float]]
    nn_pd_fit: tuple[float, float] | None

    def document(self) -> dict[str, Any]:
        """As JSON values."""
        fit = self.nn_pd_fit
        return {
            "models": {
                name: {
                    "rmse": e.overall,
                    "per_motion": dict(e.per_motion),
                    "per_joint": dict(e.per_joint),
                }
                for name, e in self.errors.items()
            },
            "diagnosed_better_ci90": {name: list(ends) for name, ends in self.better.items()},
            "nn_pd_fit": {"rmse_before": fit[0], "rmse_after": fit[1]} if fit else None,
        }


def compare(
    found: Diagnosis, replays_with: Callable[[str], Replays], seed: int = 0
) -> Rivals | None:
    """Fit the rivals of a diagnosis and judge all by motions left out; needs PyTorch.

    Args:
      found: the diagnosis.
      replays_with: makes what simulates its recordings with an actuator, `pd` or `nn_pd`.
      seed: of everything random.

    Returns:
      The comparison; None where the diagnosis could not tell anything.
    """
    if found.model is None:
        return None
    from pup.diagnosis.residual_network import mend  # PyTorch is for those who ask for it

    judge = Selector(replays_with("pd"), found.noise, (), 0.0, found.nominal.fit)
    nominal = judge.nominal
    predicted, fit = {NOMINAL: nominal.predicted}, None
    if found.robot.network is not None:
        predicted[NN_PD], fit = fit_nn_pd(found, replays_with("nn_pd"))
    predicted[NETWORK] = mend(found.measured, nominal.predicted, judge.folds, seed)
    told = {
        name: held_out(found.measured, replace(nominal, predicted=values), found.model, seed)
        for name, values in predicted.items()
    }
    errors = {name: _errors(held, 0) for name, held in told.items()}
    return Rivals(
        errors | {DIAGNOSED: _errors(told[NOMINAL], 1)},
        {name: held.interval for name, held in told.items()},
        fit,
    )


def fit_nn_pd(found: Diagnosis, replays: Replays) -> tuple[Array, tuple[float, float]]:
    """Fit the paper's NN-PD to all recordings, then without each fold, and predict that.

    A fit without a fold starts where the whole fit ends, as those of the diagnosis do, so what it
    predicts is rather too good than too bad.

    Args:
      found: its nominal fit tells the start, its noise weighs the samples.
      replays: simulates with NN-PD.

    Returns:
      Predictions of each sample without its fold, shape (n_samples,), rad, and the joints' root
      mean square error on what was fitted, before and after, rad.
    """
    coordinates, start = _start(found, replays.space)
    fit = _fitted(coordinates, start, replays, found.noise)
    before, after = replays([fit.row(start), fit.row()])
    predicted = Selector(replays, found.noise, (), 0.0, fit).nominal.predicted
    return predicted, (_rms(found.measured, before), _rms(found.measured, after))


def _fitted(
    coordinates: tuple[Coordinate, ...], start: Array, replays: Replays, noise: Noise
) -> Fit:
    fit = Fit(coordinates, start, slack=SLACK)
    for damping in BEGINNINGS:
        fit.done, fit.stuck, fit.damping = False, 0, damping
        fit_together([fit], replays, noise, ITERATIONS)
        if fit.moved:
            break
    return fit


def _start(found: Diagnosis, space: ParameterSpace) -> tuple[tuple[Coordinate, ...], Array]:
    """What NN-PD's fit moves and where it starts: at the gains and limit of the nominal fit.

    The network begins with constant gains, as its last layer is 0; what is hidden in it begins as
    the robot describes it. Its weights stay in the paper's range of ±1.
    """
    fitted, robot = found.nominal.fit.values, found.robot
    options = robot.network or NetworkOptions()
    start = dict(zip(space.names, space.nominal, strict=True)) | dict.fromkeys(OUTPUTS, 0.0)
    for group in robot.groups:
        damping = fitted[f"kd/{group}"] - options.passive_damping
        start[f"rho/{group}"] = fitted[f"kp/{group}"] / (options.kp_scale / 2)
        start[f"sigma/{group}"] = max(damping / (options.kd_scale / 2), LEAST)
    limits = [fitted[f"tau_max/{group}"] for group in robot.groups]
    start["torque_limit"] = float(np.median(limits))
    scales = ("rho", "sigma", "torque_limit")
    names = [n for n in space.names if n.split("/")[0] in scales and "@" not in n]
    if "ground_friction" in fitted:
        names.append("ground_friction")
        start["ground_friction"] = fitted["ground_friction"]
    coordinates = (
        *(nominal_coordinate(space, name) for name in names),
        *(Coordinate(name, 1.0, *_range(space, name)) for name in NETWORK_NAMES),
    )
    return coordinates, np.array([c.coordinate(start[c.name]) for c in coordinates])


def _range(space: ParameterSpace, name: str) -> tuple[float, float]:
    i = space.names.index(name)
    return float(space.lower[i]), float(space.upper[i])


def _rms(measured: Measured, simulated: Array) -> float:
    errors = np.where(np.isnan(simulated), LOST, measured.values - simulated)
    joints = measured.channel < len(measured.robot.joints)
    return float(np.sqrt(np.mean(errors[joints] ** 2)))


def _errors(held: HeldOut, which: int) -> Errors:
    """The errors before (0) or after (1)."""
    return Errors(
        (held.before, held.after)[which],
        {name: pair[which] for name, pair in held.per_motion.items()},
        {name: pair[which] for name, pair in held.per_joint.items()},
    )

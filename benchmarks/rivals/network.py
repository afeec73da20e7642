"""The black-box rival: a network that tells the missing torque, in the simulation's loop.

It learns the torque that inverse dynamics misses from a joint's position, speed and error to its
command. In simulation it acts as a term like any other; how much of it acts is fitted there
together with the nominal parameters, so that it need not do harm. It has no name for anything.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from benchmarks.rivals.case import SEED, Case, Named, Verdict
from benchmarks.rivals.torques import Seen, seen
from pup.diagnosis.coordinates import Coordinate
from pup.diagnosis.fit import Fit
from pup.diagnosis.fitting import fit_together
from pup.diagnosis.folds import folds
from pup.diagnosis.laws import NAMELESS
from pup.diagnosis.residuals import LOST
from pup.diagnosis.starts import ROUGHLY
from pup.files import write_atomic
from pup.physics.terms import BEYOND, Place, column
from pup.physics.terms.base import Flow, Outcome, Quantity, Term

Array = NDArray[np.float64]

EFFECT = "residual_network"
SHARE = column(EFFECT, "share", Place("robot"))
"""Column of a candidate: how much of the network's torque acts."""
START, MOST = 0.5, 2.0
BLOCK = 0.5
"""Data kept for validation come in blocks of as many seconds."""
FILE = "network.npz"


@dataclass(frozen=True, eq=False)
class Network:
    """Two layers of tanh units, shared by all joints.

    Attributes:
      middle: of the inputs: position, speed, error, and which joint it is; shape (3 + n_joints,).
      spread: of the inputs.
      layers: weights (outputs, inputs) and biases, in turn.
    """

    middle: Array
    spread: Array
    layers: tuple[Array, ...]

    def torque(self, position: Array, velocity: Array, error: Array) -> Array:
        """What is missing, N m; arrays of shape (n, n_joints)."""
        n, joints = position.shape
        which = np.broadcast_to(np.eye(joints), (n, joints, joints))
        seen = np.concatenate([np.stack([position, velocity, error], axis=2), which], axis=2)
        value = (seen - self.middle) / self.spread
        for weight, bias in zip(self.layers[:-2:2], self.layers[1:-2:2], strict=True):
            value = np.tanh(value @ weight.T + bias)
        return np.asarray((value @ self.layers[-2].T + self.layers[-1])[..., 0])

    def save(self, file: Path) -> None:
        """Write it to a file."""
        arrays = {f"layer{i}": layer for i, layer in enumerate(self.layers)}
        buffer = BytesIO()
        np.savez(buffer, middle=self.middle, spread=self.spread, **arrays)
        write_atomic(file, buffer.getvalue())

    @classmethod
    def load(cls, file: Path) -> "Network":
        """Read it from a file."""
        with np.load(file) as told:
            layers = tuple(told[f"layer{i}"] for i in range(len(told.files) - 2))
            return cls(told["middle"], told["spread"], layers)


class ResidualTorque(Term):
    """A network's torque, added to what reaches the link."""

    effect = EFFECT
    kinds = ("robot",)
    quantities = (Quantity("share", "1", 1.0, MOST),)
    source = "fitted to a case"
    state = ("_error",)
    network: ClassVar[Network]

    def prepare(self) -> None:
        """See Term."""
        self._error = np.zeros_like(self.scene.inertia)

    def settle(self, outcome: Outcome) -> None:
        """See Term."""
        self._error[: len(outcome.error)] = outcome.error

    def flow(self, flow: Flow) -> None:
        """See Term."""
        n = len(flow.torque)
        told = self.network.torque(flow.position, flow.velocity, self._error[:n])
        flow.torque += self.values["share"][:n] * told


@contextmanager
def in_the_loop(network: Network) -> Iterator[None]:
    """Simulations know the term, with this network, as long as this lasts."""
    BEYOND[EFFECT] = type("ResidualTorque", (ResidualTorque,), {"network": network})
    try:
        yield
    finally:
        del BEYOND[EFFECT]


def black_box(case: Case) -> tuple[Verdict, Network]:
    """Train networks without each type of motion, and one on all.

    There is something missing where what they predict of motions left out is surely better than
    what the nominal model does.
    """
    every, measured = seen(case), case.measured
    predicted = measured.values.copy()
    for number, fold in enumerate(folds(case.replays)):
        inside = measured.only(fold)
        rest = [s for i, s in enumerate(every) if i not in fold]
        with in_the_loop(trained(rest, number)):
            fit = _fitted(case, np.where(inside, 0.0, 1.0))
            simulated = case.replays([fit.row()], fold)[0]
        predicted[inside] = np.where(np.isnan(simulated), LOST, simulated)
    network = trained(every, len(every))
    with in_the_loop(network):
        fit = _fitted(case, np.ones(len(measured.values)))
    better = case.judged(replace(case.before, predicted=predicted)).interval[0] > 0
    named = (Named(NAMELESS, Place("robot"), 1.0),) if better else ()
    return Verdict(better, named, fit=fit, predicted=predicted), network


def trained(every: Sequence[Seen], number: int) -> Network:
    """A network trained on some recordings.

    Args:
      every: the recordings.
      number: of the network, for its seed.
    """
    # The trainer of `pup diagnose --rivals`, whose network tells positions: the same torch code.
    from pup.diagnosis.residual_network import _reproducible, _trained

    joints = every[0].position.shape[1]
    inputs = np.concatenate([_inputs(s, joint) for s in every for joint in range(joints)])
    wanted = np.concatenate([s.missing[s.usable, j] for s in every for j in range(joints)])
    blocks = np.concatenate(
        [
            1000 * i + (s.time[s.usable] / BLOCK).astype(np.int64)
            for i, s in enumerate(every)
            for _ in range(joints)
        ]
    )
    middle, spread = inputs.mean(axis=0), inputs.std(axis=0) + 1e-9
    size = float(wanted.std()) + 1e-12
    with _reproducible():
        rng = np.random.default_rng((SEED, number))
        learnt = _trained((inputs - middle) / spread, wanted / size, blocks, rng)
    *layers, weight, bias = (np.asarray(p.detach().numpy(), float) for p in learnt.parameters())
    return Network(middle, spread, (*layers, weight * size, bias * size))


def _inputs(s: Seen, joint: int) -> Array:
    which = np.eye(s.position.shape[1])[joint]
    own = np.stack([s.position[:, joint], s.velocity[:, joint], s.error[:, joint]], axis=1)
    return np.hstack([own, np.broadcast_to(which, (len(own), len(which)))])[s.usable]


def _fitted(case: Case, weight: Array) -> Fit:
    """How much of the network acts, and the nominal parameters beside it."""
    nominal = case.nominal.fit
    fit = Fit(
        (*nominal.coordinates, Coordinate(SHARE, 1.0, 0.0, MOST)),
        np.r_[nominal.at, START],
        weight=weight,
        thorough=False,
        slack=ROUGHLY,
    )
    fit_together([fit], case.replays, case.noise, iterations=8)
    return fit

"""A black box on a simulation's errors: a small network that adds what it has seen missing.

This is what a residual or delta-action model comes to where only positions are read: from what the
nominal simulation knows at a reading, and knew shortly before, a network shared by all joints tells
measured minus simulated position. It is a rival of a diagnosis, not a part of it.

PyTorch is imported here and nowhere else in `pup.diagnosis`.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pup.diagnosis.residuals import Measured

Array = NDArray[np.float64]

LAGS = 3
"""Readings before the present one that the network sees too."""
HIDDEN = 64
"""Units in each of two layers."""
MEMBERS = 3
"""Networks whose mean predicts: on so few data one alone depends on its seed."""
STEPS, BATCH, RATE, DECAY = 3000, 256, 3e-3, 1e-2
"""Of the training, at most; samples in each; AdamW's rate and weight decay."""
EVERY, PATIENCE = 25, 20
"""Steps between two looks at the validation share, and looks without a gain that end it."""
SHARE, BLOCK = 0.2, 0.5
"""Share of the data kept for validation, in blocks of as many seconds: neighbours are alike."""


def mend(measured: Measured, predicted: Array, folds: Sequence[Sequence[int]], seed: int) -> Array:
    """Predictions of motions left out, mended by networks that have not seen them.

    Args:
      measured: the samples.
      predicted: what a simulation that was fitted without a sample's fold predicts, shape
        (n_samples,), rad.
      folds: the recordings that are left out together.
      seed: of the weights, the batches and the validation share.

    Returns:
      The predictions, same shape; those of the torso's tilts as they were.
    """
    joints = np.flatnonzero(measured.channel < len(measured.robot.joints))
    known = features(measured, predicted)
    missing = (measured.values - predicted)[joints]
    blocks = measured.recording * 100_000 + (measured.time / BLOCK).astype(np.int64)
    mended = predicted.copy()
    with _reproducible():
        for number, fold in enumerate(folds):
            left_out = measured.only(fold)[joints]
            seen = ~left_out
            middle, spread = known[seen].mean(axis=0), known[seen].std(axis=0) + 1e-9
            inputs, size = (known - middle) / spread, float(missing[seen].std()) + 1e-12
            for member in range(MEMBERS):
                rng = np.random.default_rng((seed, number, member))
                network = _trained(inputs[seen], missing[seen] / size, blocks[joints][seen], rng)
                mended[joints[left_out]] += size * _told(network, inputs[left_out]) / MEMBERS
    return mended


def features(measured: Measured, predicted: Array) -> Array:
    """What a simulation knows at the joints' samples, shape (n_joint_samples, n_features).

    Position and, now and at some readings before, error to the target, velocity and the target's
    velocity; then which joint it is.

    Args:
      measured: the samples; those of joints are used.
      predicted: simulated, shape (n_samples,), rad.
    """
    count = len(measured.robot.joints)
    joints = np.flatnonzero(measured.channel < count)
    target = np.concatenate(
        [r.target[:, [r.joints.index(n) for n in measured.robot.joint_names]].ravel()
         for r in measured.recordings]
    )[measured.index[joints]]  # fmt: skip
    position, time, channel = predicted[joints], measured.time[joints], measured.channel[joints]
    breaks = (np.diff(measured.recording[joints]) != 0) | (np.diff(channel) != 0)
    starts = np.r_[0, np.flatnonzero(breaks) + 1]
    runs = np.split(np.arange(len(joints)), starts[1:])
    now = np.column_stack(
        [target - position, *(_velocity(values, time, runs) for values in (position, target))]
    )
    first = np.repeat(starts, [len(run) for run in runs])
    before = [np.maximum(np.arange(len(joints)) - lag, first) for lag in range(LAGS + 1)]
    return np.hstack([position[:, None], *(now[at] for at in before), np.eye(count)[channel]])


def _velocity(values: Array, time: Array, runs: Sequence[NDArray[np.int64]]) -> Array:
    """Rates of change within runs of readings, rad/s; 0 where there is but one."""
    rates = np.zeros(len(values))
    for run in runs:
        if len(run) > 1:
            rates[run] = np.gradient(values[run], time[run])
    return rates


def _trained(
    inputs: Array, wanted: Array, blocks: NDArray[np.int64], rng: np.random.Generator
) -> Any:
    """A network as it was when it did best on the blocks it was not trained on."""
    every = np.unique(blocks)
    if len(every) < 2:  # nothing to train on beside what it is checked on
        return _network(inputs.shape[1])
    kept = np.isin(blocks, rng.choice(every, max(1, round(SHARE * len(every))), replace=False))
    seen, aim, check, truth = (
        torch.tensor(part, dtype=torch.float32)
        for part in (inputs[~kept], wanted[~kept, None], inputs[kept], wanted[kept, None])
    )
    torch.manual_seed(int(rng.integers(2**31)))
    network = _network(inputs.shape[1])
    optimizer = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=DECAY)
    loss = torch.nn.functional.mse_loss
    best, at, state = np.inf, 0, {}
    for step in range(STEPS):
        if step % EVERY == 0:
            with torch.no_grad():
                cost = float(loss(network(check), truth))
            if cost < best:
                best, at = cost, step
                state = {name: value.clone() for name, value in network.state_dict().items()}
            elif step - at >= PATIENCE * EVERY:
                break
        batch = torch.randint(len(seen), (BATCH,))
        optimizer.zero_grad()
        loss(network(seen[batch]), aim[batch]).backward()
        optimizer.step()
    network.load_state_dict(state)
    return network


def _network(inputs: int) -> Any:
    """A network that tells nothing yet: where no step is a gain, the simulation stands."""
    last = torch.nn.Linear(HIDDEN, 1)
    torch.nn.init.zeros_(last.weight)
    torch.nn.init.zeros_(last.bias)
    layers = torch.nn.Linear(inputs, HIDDEN), torch.nn.Linear(HIDDEN, HIDDEN)
    return torch.nn.Sequential(layers[0], torch.nn.Tanh(), layers[1], torch.nn.Tanh(), last)


def _told(network: Any, inputs: Array) -> Array:
    with torch.no_grad():
        told = network(torch.tensor(inputs, dtype=torch.float32))[:, 0]
    return np.asarray(told.numpy(), dtype=float)


@contextmanager
def _reproducible() -> Iterator[None]:
    """One thread, as sums depend on their number, and the caller's generator left alone."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.random.fork_rng(devices=[]):
            yield
    finally:
        torch.set_num_threads(threads)

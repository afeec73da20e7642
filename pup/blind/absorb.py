"""How much of an effect a refit of the nominal parameters leaves."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pup.blind.reference import Reference
from pup.blind.refit import Fit, Refit
from pup.blind.sensors import Noise, Seen
from pup.blind.world import Array, Plan

LOUD = 2.0  # sigma, from which a reading counts as off
FAINT = 4.0  # least SNR at which an effect counts as there
MATERIAL = 0.3  # of sigma, the held-out gain from which an omission matters
CLEAR = 10.0  # SNR from which an effect below the noise is detectable without doubt
HIDDEN = 0.5  # share absorbed from which an effect counts as masked


@dataclass(frozen=True)
class Visibility:
    """What an effect does to the readings, training motions unless told otherwise.

    Attributes:
      raw: rms over the readings of the channel that shows most, a joint, roll or pitch, before a
        refit; rad, of roll and pitch as many standard deviations of their noise in a joint's.
      left: the same after a refit.
      snr: matched-filter signal to noise of all readings after a refit.
      absorbed: share of that signal, before a refit, that it hides.
      held_out: as `left`, on the training or the test motions, whichever show more, in units of
        sigma: the engine may leave out any of the former, the scorer keeps the latter.
      held_out_all: the same over all channels.
      tested: rms over all joints of what a refit leaves of the test motions, rad; None where there
        are none.
      absorbed_by: relative change of each nominal parameter.
      when: spans of the recordings in which a refit leaves more than noise.
    """

    raw: float
    left: float
    snr: float
    absorbed: float
    held_out: float
    held_out_all: float
    tested: float | None
    absorbed_by: Mapping[str, float]
    when: Sequence[Mapping[str, Any]]

    @property
    def gain(self) -> float:
        """What a complete model wins on held-out motions in that channel, in units of sigma."""
        return float(np.hypot(1.0, self.held_out) - 1.0)

    def document(self) -> dict[str, Any]:
        """As in the key."""
        return {
            "raw_rms_rad": self.raw,
            "after_refit_rms_rad": self.left,
            "after_refit_test_rms_rad": self.tested,
            "snr": self.snr,
            "absorbed": self.absorbed,
            "held_out_gain_sigma": self.gain,
            "held_out_gain_sigma_all_joints": float(np.hypot(1.0, self.held_out_all) - 1.0),
            "material": bool(self.gain > MATERIAL),
            "absorbed_by": dict(self.absorbed_by),
            "when": list(self.when),
        }


def visibility(
    reference: Reference,
    seen: Mapping[str, Seen],
    noise: Noise,
    against: Mapping[str, Seen] | None = None,
    rounds: int = 0,
) -> Visibility:
    """Compare readings with the nominal ones, or with others.

    Args:
      reference: the nominal readings.
      seen: readings of the same plans.
      noise: of the sensors.
      against: what to compare with instead.
      rounds: of a refit by simulation; 0 is linear theory alone.
    """
    refit = Refit(reference, shifted(reference, seen, against), noise)
    return view(refit, refit.best(rounds))


def view(refit: Refit, fit: Fit) -> Visibility:
    """What a fit leaves, compared with what there was before a refit."""
    origin, sigma = refit.origin, refit.noise.sigma
    before = refit.still(origin.values, origin.stacked())
    joints = len(origin.world.robot.joints)
    apart = [_rms(refit, refit.missed(fit, origin.train), origin.train)]
    tested = None
    if origin.test:
        apart.append(_rms(refit, refit.missed(fit, origin.test), origin.test))
        tested = _root_mean_square(apart[-1][:joints]) * sigma
    return Visibility(
        raw=float(_rms(refit, refit.missed(before, origin.train), origin.train).max()) * sigma,
        left=float(apart[0].max()) * sigma,
        snr=fit.left,
        absorbed=1.0 - fit.left / before.off if before.off else 0.0,
        held_out=max(float(rms.max()) for rms in apart),
        held_out_all=max(map(_root_mean_square, apart)),
        tested=tested,
        absorbed_by={
            name: float(fit.values[name] / value * (1 + step) - 1)
            for (name, value), step in zip(origin.values.items(), fit.steps[0], strict=True)
        },
        when=_spans(refit, fit),
    )


def shifted(
    reference: Reference, seen: Mapping[str, Seen], against: Mapping[str, Seen] | None = None
) -> dict[str, Array]:
    """The nominal readings plus what is to be explained: readings less the nominal, or others."""
    base = against or reference.seen
    return {
        name: nominal + seen[name].stacked() - base[name].stacked()
        for name, nominal in reference.stacked().items()
    }


def _spans(refit: Refit, fit: Fit) -> list[dict[str, Any]]:
    """Where in the training motions a reading is off by more than noise."""
    spans = []
    for plan in refit.origin.train:
        off = np.abs(refit.missed(fit, [plan])).reshape(len(plan.time), -1).max(axis=1) > LOUD
        edges = np.flatnonzero(np.diff(np.concatenate([[0], off * 1, [0]])))
        ends = np.append(plan.time, plan.time[-1])
        spans += [
            {"recording": plan.id, "start": float(ends[a]), "end": float(ends[b])}
            for a, b in zip(edges[::2], edges[1::2], strict=True)
        ]
    return spans


def _root_mean_square(rms: Array) -> float:
    """Root mean square over channels of as many readings each."""
    return float(np.sqrt(np.mean(rms**2)))


def _rms(refit: Refit, values: Array, plans: Sequence[Plan]) -> Array:
    """Root mean square per channel of a value for each reading of some plans, (n_channels,)."""
    columns = np.concatenate([refit.origin.weights(plan, refit.noise)[1] for plan in plans])
    return np.sqrt(np.bincount(columns, values**2) / np.bincount(columns))


def labelled(stratum: str, seen: Mapping[str, Any], sigma: float) -> str:
    """The stratum a single omission belongs to by what it turned out to do, as in the key."""
    if stratum not in ("single", "below_noise", "weak", "masked"):
        return stratum
    if seen["snr"] < CLEAR:
        return "weak"
    if seen["absorbed"] >= HIDDEN and stratum in ("masked", "single"):
        return "masked"
    return "below_noise" if seen["after_refit_rms_rad"] < sigma else "single"

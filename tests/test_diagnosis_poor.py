"""Recordings with a fault of their own are known by it, and sound ones are not suspected."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from pup.diagnosis.poor import why_poor
from pup.diagnosis.residuals import Measured
from pup.recording import Recording
from pup.recording_cuts import beginning, thinned
from pup.robot import RobotDescription

LEG = RobotDescription.load("darwin_leg")
LSB = 2 * np.pi / 4096
KNEE, PITCH = (LEG.joint_names.index(name) for name in ("l_knee", "l_ank_pitch"))


def leg(seed: int = 0, noise: float = 0.001) -> list[Recording]:
    """Three motions of a leg whose joints follow their commands within 60 ms, read to 12 bits."""
    rng = np.random.default_rng(seed)
    runs = []
    for motion in ("step", "multisine", "hold"):
        time = np.arange(0, 6, 0.03)
        levels = rng.uniform(-0.4, 0.4, (12, len(LEG.joints)))
        target = levels[(time / 0.5).astype(int)]
        if motion == "multisine":
            tone = rng.uniform(0.5, 2.0, len(LEG.joints))
            target = 0.4 * np.sin(np.outer(time, 2 * np.pi * tone))
        position = np.zeros_like(target)
        for i in range(1, len(time)):
            position[i] = position[i - 1] + 0.4 * (target[i - 1] - position[i - 1])
        read = np.round((position + noise * rng.normal(size=position.shape)) / LSB) * LSB
        names = LEG.joint_names
        runs.append(
            Recording(motion, LEG.name, motion, "suspended", "hardware", names, time, target, read)
        )
    return runs


def exchanged(runs: Sequence[Recording]) -> list[Recording]:
    order = list(range(len(LEG.joints)))
    order[KNEE], order[PITCH] = PITCH, KNEE
    return [replace(r, position=r.position[:, order]) for r in runs]


def changed(
    runs: Sequence[Recording], joint: int, change: Callable[[np.ndarray], np.ndarray]
) -> list[Recording]:
    out = []
    for run in runs:
        position = run.position.copy()
        position[:, joint] = change(position[:, joint])
        out.append(replace(run, position=position))
    return out


@pytest.mark.parametrize("seed", range(5))
def test_sound_recordings_are_not_suspected(seed: int) -> None:
    assert why_poor(Measured.of(LEG, leg(seed))) is None


def test_late_servos_that_follow_one_another_are_not_exchanged() -> None:
    """In a gait one joint's commands are another's a moment later, and a servo's lag is one too."""
    late = 4
    runs = []
    for run in leg(noise=0.0):
        target = np.stack([np.roll(run.target[:, 0], -late * j) for j in range(len(LEG.joints))], 1)
        position = np.concatenate([np.repeat(target[:1], late, axis=0), target[:-late]])
        runs.append(replace(run, target=target, position=position))
    assert np.abs(runs[0].position[8:, 1] - runs[0].target[8:, 0]).max() < 1e-9
    assert why_poor(Measured.of(LEG, runs)) is None


def test_a_noiseless_encoder_at_rest_is_not_clipped() -> None:
    """Steps end where they end, again and again at one reading; so they do in the middle."""
    assert why_poor(Measured.of(LEG, leg(noise=0.0))) is None


@pytest.mark.parametrize(
    ("spoil", "why", "cure"),
    [
        (lambda runs: runs[:1], "second motion", ""),
        (lambda runs: [runs[0], beginning(runs[1], 0.0)], "only step has readings", ""),
        (lambda runs: [thinned(r, 7) for r in runs], "0.21 s apart", "20 Hz"),
        (lambda runs: changed(runs, KNEE, lambda q: 0 * q + q[0]), "l_knee hardly moves", "mended"),
        (lambda runs: changed(runs, PITCH, lambda q: q.clip(-0.15, 0.15)), "l_ank_pitch stop",
         "whole range"),
        (exchanged, "l_knee follow the commands of l_ank_pitch", "servo ids"),
        (lambda runs: [replace(r, position=0 * r.position) for r in runs],
         "hardly moves though it is asked to", "mended"),
        (lambda runs: [replace(r, target=0 * r.target + i, position=0 * r.position + i)
                       for i, r in enumerate(runs)],
         "no joint moves", ""),
        (lambda runs: [replace(r, time=r.time[:3], target=r.target[:3], position=r.position[:3])
                       for r in runs], "too few", ""),
    ],
)  # fmt: skip
def test_what_is_wrong_with_recordings_and_how_to_mend_it_is_said(
    spoil: Callable[[Sequence[Recording]], Sequence[Recording]], why: str, cure: str
) -> None:
    poor = why_poor(Measured.of(LEG, spoil(leg())))
    assert poor is not None
    assert why in poor.reason
    assert cure in poor.cure and bool(cure) == bool(poor.cure)


def test_of_a_joint_that_slides_it_is_said_in_metres() -> None:
    axis, time = RobotDescription.load("emps"), np.arange(0, 3, 0.03)
    still = np.zeros((len(time), 1))
    run = Recording("still", "emps", "hold", "bench", "hardware", ("axis",), time, still, still)
    poor = why_poor(Measured.of(axis, [run, replace(run, id="again")]))
    assert poor is not None and poor.reason == "no joint moves by more than 0.0029 m"

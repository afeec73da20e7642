"""What the minimum of a sum of norms tells of its parameters, against many draws of the noise."""

from pathlib import Path

import numpy as np
import pytest
from biped import biped
from numpy.typing import NDArray
from recordings import make
from scipy.optimize import minimize

from pup.physics.parameters import ParameterSpace, robot_space
from pup.recording import Recording
from pup.robot import RobotDescription
from pup.sysid import ripples
from pup.sysid.problem import Problem
from pup.sysid.ripples import LOOKS, SCALES, Shares, Surface, surface
from pup.sysid.slopes import Slopes, Told, slopes, told_at
from pup.sysid.uncertainty import _shares, by_motion, over_ripples

Array = NDArray[np.float64]
TICKS = (slice(0, 60), slice(60, 100))
BLOCKS = np.concatenate([np.arange(0, 300, 3), np.arange(300, 500, 2)])
"""A hundred ticks of three joints, then as many of two angles."""
WEIGHT = np.repeat([1.0, 10.0], [300, 200])
SPREAD = np.repeat([0.01, 0.004], [300, 200])


def told(error: Array, jacobian: Array) -> Told:
    return Told(WEIGHT * error, WEIGHT[:, None] * jacobian, BLOCKS, TICKS, 1.0)


def minimum(measured: Array, jacobian: Array) -> Array:
    """Of the sum of weighted norms, for a model that is linear in two parameters."""

    def loss(x: Array) -> float:
        error = WEIGHT * (measured - jacobian @ x)
        return float(np.sqrt(np.add.reduceat(error**2, BLOCKS)).sum())

    return np.asarray(minimize(loss, np.zeros(2), method="Nelder-Mead").x)


def test_intervals_are_as_wide_as_the_estimates_scatter() -> None:
    """Tilt, weighed by ten, spoils an estimate that the joints know well: the interval says so."""
    rng = np.random.default_rng(0)
    jacobian = rng.normal(size=(500, 2))
    jacobian[300:] *= 0.1
    found = np.array([minimum(SPREAD * rng.normal(size=500), jacobian) for _ in range(150)])
    error = SPREAD * rng.normal(size=500)
    expected = np.sqrt(np.diag(np.linalg.inv(slopes(told(error, jacobian), []).information)))
    np.testing.assert_allclose(found.std(axis=0), expected, rtol=0.2)


def test_a_start_that_is_read_with_noise_widens_them() -> None:
    """A reading moves all of its own recording's errors at once, and no other's."""
    rng = np.random.default_rng(1)
    jacobian = np.ones((500, 1))
    error = SPREAD * rng.normal(size=500)
    first = np.repeat(np.isin(np.arange(100), np.arange(60)), 3)
    start = 0.02 * np.concatenate([first, np.zeros(200)])
    alone, together = (
        1 / float(slopes(told(error, jacobian), given).information[0, 0]) for given in ([], [start])
    )
    # A norm of d numbers of spread s pulls with its weight times E|e| / (d s^2).
    pull = WEIGHT / SPREAD * np.repeat([np.sqrt(8 / np.pi) / 3, np.sqrt(np.pi / 2) / 2], [300, 200])
    share = float((pull[:300] * first).sum() / pull.sum())
    np.testing.assert_allclose(together - alone, (0.02 * share) ** 2, rtol=0.25)


def test_rows_of_commands_alone_make_no_interval_narrower() -> None:
    """Readings are as alike as they were, though no two of them stand in neighbouring rows."""
    robot = RobotDescription.load("servo_bench")
    rng = np.random.default_rng(4)
    time = np.arange(200) / 50
    target = np.repeat(rng.uniform(-0.5, 0.5, 10), 20)[:, None]
    read = 0.9 * target + 0.02 * np.sin(3 * time)[:, None]
    told = {"robot": robot.name, "joints": robot.joint_names}
    plain = make(time=time, target=target, position=read, **told)
    twice = np.arange(400) / 100
    gaps = np.full((400, 1), np.nan)
    gaps[::2] = read
    between = make(time=twice, target=np.repeat(target, 2, axis=0), position=gaps, **told)
    space = robot_space(robot, "pd")

    def memory(recording: Recording) -> float:
        problem = Problem(robot, (recording,), "pd", space, ("kp/servo", "kd/servo"))
        return told_at(problem, np.array([0.5, 0.5]))[0].memory

    assert memory(plain) > 5
    assert memory(between) == pytest.approx(memory(plain), rel=0.02)


SHARP = np.array([[40.0, 10.0, 0.0], [10.0, 20.0, 0.0], [0.0, 0.0, 0.0]])
"""Curvature of a loss that its third parameter does nothing to."""
SCATTER = 0.02
"""Of the recordings' minima, in each direction."""
NOTHING = Slopes(np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3)))


AGAIN = 0.1
"""Share of that scatter by which a motion's minimum moves when it is done again."""


def rippled(
    rng: np.random.Generator, recordings: int = 10, repeats: int = 1
) -> tuple[Shares, Array]:
    """Losses of recordings, and the best of 300 points, where a fit would end.

    Each motion has its own minimum, scattered about the middle, and each recording of it ripples of
    a hundredth. Recordings of one motion stand side by side.
    """
    count = recordings * repeats
    minima = 0.5 + SCATTER * rng.normal(size=(recordings, 3)).repeat(repeats, axis=0)
    if repeats > 1:
        minima += AGAIN * SCATTER * rng.normal(size=(count, 3))
    wave = rng.normal(size=(count, 2)) * 400
    phase = rng.uniform(0, 2 * np.pi, count)

    def shares(units: Array) -> Array:
        off = units[:, None] - minima
        ripple = 0.01 * np.sin((units[:, None, :2] * wave).sum(axis=2) + phase)
        return np.asarray(1 + np.einsum("nri,ij,nrj->nr", off, SHARP, off) / 2 + ripple)

    tried = 0.5 + 0.05 * rng.normal(size=(300, 3))
    return shares, tried[np.argmin(shares(tried).mean(axis=1))]


def intervals(recordings: int, draws: int, noise: Array, repeats: int = 1) -> tuple[Array, Array]:
    """How often 90 % intervals hold the truth, and their median width, for three parameters."""
    motions = [str(i) for i in range(recordings) for _ in range(repeats)]
    rng = np.random.default_rng(2)
    space = ParameterSpace(("a", "b", "c"), ("1",) * 3, np.full(3, 0.5), np.zeros(3), np.ones(3))
    inside, wide = [], []
    for _ in range(draws):
        told_by, unit = rippled(rng, recordings, repeats)

        def shares(units: Array, told_by: Shares = told_by) -> Array:
            return by_motion(told_by(units), motions)

        start = np.diag([1e-6, 1e-6, 1 / 12])  # a ripple's slopes claim a thousandth
        ground = surface(shares, unit, start, NOTHING.curvature, 0.03)
        told = over_ripples(space, unit, NOTHING, ground, noise).confidence(0.9)
        inside.append((told.lower <= 0.5) & (told.upper >= 0.5))
        wide.append(told.upper - told.lower)
    return np.mean(inside, axis=0), np.median(wide, axis=0)


def test_ripples_hide_no_parameter_and_sharpen_none() -> None:
    """Nine intervals in ten hold the truth, and what the loss does not depend on stays unknown."""
    held, width = intervals(10, 60, NOTHING.scatter)
    assert (held[:2] > 0.8).all()
    assert (held[:2] < 0.99).all()
    assert (width[:2] < 0.08).all()
    assert width[2] > 0.85


def test_motions_done_again_are_no_further_motions() -> None:
    """Three motions of five recordings each know little more than three recordings do."""
    held, width = intervals(3, 60, NOTHING.scatter, repeats=5)
    assert (held[:2] > 0.8).all()
    assert width[2] > 0.85


def test_the_shares_of_motions_have_the_mean_of_the_recordings() -> None:
    shares = np.array([[1.0, 2.0, 4.0, 8.0], [3.0, 0.0, 0.0, 1.0]])
    told = by_motion(shares, ["b", "a", "b", "b"])
    np.testing.assert_allclose(told, [[6.5, 1.0], [2.0, 0.0]])
    np.testing.assert_allclose(told.mean(axis=1), shares.mean(axis=1))
    assert np.array_equal(by_motion(shares, "abcd"), shares)


def test_repeats_on_the_ground_are_counted_with_what_they_repeat(tmp_path: Path) -> None:
    """What a motion adds is what its recordings add, and all of them add equation 1."""
    robot = biped(tmp_path)
    told = {"robot": "biped", "support": "ground", "motion": "stand", "joints": robot.joint_names}
    told |= {"time": np.arange(8) / 30, "target": np.full((8, 2), 0.1)}
    runs = tuple(
        make(id=name, repeat_of=before, position=np.full((8, 2), 0.01 * at), **told)
        for at, (name, before) in enumerate((("a", None), ("b", "a"), ("c", None)))
    )
    space = robot_space(robot, "pd")
    problem = Problem(robot, runs, "pd", space, ("kp/hip", "ground_friction"))
    units = np.array([[0.3, 0.5], [0.7, 0.2], [0.5, 0.9]])
    shares = _shares(problem, np.full(3, True), lambda _: None)(units)
    assert shares.shape == (3, 2)
    np.testing.assert_allclose(shares.mean(axis=1), problem.losses(units), rtol=1e-12)


def test_the_widest_scale_is_found_by_looking_at_few() -> None:
    """The same as of all twelve, at which equation 1 rises by no more than it should."""
    rng = np.random.default_rng(5)
    found = []
    for sharpness in 10.0 ** np.arange(-6, 3):
        shares, unit = rippled(rng)
        asked: list[int] = []

        def counted(units: Array, asked: list[int] = asked, shares: Shares = shares) -> Array:
            asked.append(len(units))
            return shares(units)

        start = np.diag([sharpness, sharpness, 1 / 12])
        looked = NOTHING.curvature, 0.03
        width = ripples._scaled(counted, unit, start, *looked, np.random.default_rng(0))
        drawn = np.random.default_rng(0).normal(size=(LOOKS, 3))
        widths = [ripples._bounded(scale**2 * start) for scale in SCALES]
        places = [np.clip(unit + drawn @ np.linalg.cholesky(w).T, 0, 1) for w in widths]
        risen = [(shares(p) - shares(unit[None])).mean() for p in places]
        known = next((i for i, rise in enumerate(risen) if rise <= 0.03), len(SCALES) - 1)
        assert np.array_equal(width, widths[known])
        assert sum(asked) <= 1 + 4 * LOOKS
        found.append(known)
    assert len(set(found)) > 4


def test_a_single_recording_is_as_uncertain_as_its_readings_make_it() -> None:
    """It has no others to differ from, and that is no certainty."""
    held, width = intervals(1, 60, SCATTER**2 * SHARP @ SHARP)
    assert (held[:2] > 0.7).all()
    assert (held[:2] < 0.99).all()
    assert width[2] > 0.85


def test_a_minimum_beyond_a_wall_lies_at_it() -> None:
    """The interval begins there and has a width, and the others go where the wall leaves them."""
    space = ParameterSpace(("a", "b", "c"), ("1",) * 3, np.full(3, 0.5), np.zeros(3), np.ones(3))
    curvature, unit = SHARP + np.diag([0.0, 0.0, 1.0]), np.array([0.0, 0.5, 0.5])
    beyond = Surface(
        slopes=(unit - np.array([-0.3, 0.6, 0.5])) @ curvature + 0.1 * np.vstack([SHARP, -SHARP]),
        slope_error=1e-6 * np.eye(3),
        curvature=curvature,
        at_least=curvature,
        draws=np.eye(3),
    )
    told = over_ripples(space, unit, NOTHING, beyond, NOTHING.scatter)
    assert told.centre == pytest.approx([0.0, 0.45, 0.5])
    interval = told.confidence(0.9)
    assert interval.lower[0] == 0
    assert interval.upper[0] > 0.01

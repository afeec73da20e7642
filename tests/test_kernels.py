"""What the compiled loops of a sub-step promise beyond what replays show."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pup.physics import kernels
from pup.physics.implicit import implicit_share
from pup.physics.terms.kernels import rub as rub_joints

NOWHERE = {"NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator"}
STEP = np.full((9, 1), 0.002)


def some(seed: int, joints: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.1, 2.0, (9, joints))


def test_damping_alone_ends_where_its_exponential_does() -> None:
    velocity, inertia = some(0), 1e-3 * some(1)
    torque, damping, brake, viscous = np.zeros((9, 3)), some(2), np.zeros((9, 3)), some(3)
    total, other = damping + viscous, np.zeros((9, 3))
    kernels.split(
        torque, damping, brake, viscous, velocity, other, other, other, other, inertia, STEP
    )
    implicit = damping + viscous
    after = (inertia * velocity + STEP * (torque - brake)) / (inertia + STEP * implicit)
    np.testing.assert_allclose(after, velocity * np.exp(-total * STEP / inertia), rtol=1e-6)


@pytest.mark.parametrize("known", ["free", "held"])
def test_a_share_that_is_known_is_the_one_that_would_be_computed(known: str) -> None:
    velocity, inertia, own, viscous = some(0), 1e-3 * some(1), some(2), some(3)
    none, total = np.full((9, 3), np.nan), own + viscous
    share = implicit_share(total, inertia, STEP)
    tables = (total, share, none, none) if known == "free" else (none, none, total, share)
    told = []
    for shares in ((none,) * 4, tables):
        four = np.ones((9, 3)), own.copy(), np.empty((9, 3)), viscous.copy()
        kernels.split(*four, velocity, *shares, inertia, STEP)
        told.append(np.stack(four))
    np.testing.assert_array_equal(*told)


@pytest.mark.parametrize("joints", [1, 5, 20])
def test_a_simulation_knows_neither_its_neighbours_nor_those_that_have_ended(joints: int) -> None:
    velocity, bend = np.sin(9 * some(0, joints)), some(5, joints) - 1
    fixed = some(6, joints), 1e-3 * some(7, joints), 1e-2 * some(8, joints)

    def rub(rows: slice, active: int) -> tuple[np.ndarray, ...]:
        bent = bend[rows].copy()
        torque, damping = np.zeros((2, active, joints))
        now = velocity[rows][:active]
        all_of_them = (a[rows] for a in fixed)
        rub_joints(torque, damping, bent, now, 1.1 * now, *all_of_them, STEP[rows])
        np.testing.assert_array_equal(bent[active:], bend[rows][active:])
        return torque, damping, bent[:active]

    together = rub(slice(None), 7)
    for row in range(7):
        for one, many in zip(rub(slice(row, row + 1), 1), together, strict=True):
            np.testing.assert_array_equal(one[0], many[row])


def test_before_anything_has_acted_a_limit_is_met_by_the_velocity_that_is() -> None:
    velocity, share, inertia = np.array([[-1.0, 3.0]]), np.ones((1, 2)), np.ones((1, 2))
    torque, damping, most = np.array([[0.6, 0.6]]), np.full((1, 2), 0.5), np.ones((1, 2))
    nothing, zero = np.full((1, 2), np.nan), np.zeros((1, 2))
    kernels.limit(torque, damping, velocity, most, -most, zero, zero, nothing, zero, share, inertia)
    np.testing.assert_array_equal(torque, [[1.0, 0.6]])  # 1.1 is clipped, -0.9 is not
    np.testing.assert_array_equal(damping, [[0.0, 0.5]])


@pytest.mark.parametrize("width", [1, 2])
@pytest.mark.parametrize("rate", [0.0081, 0.0007])
def test_a_command_holds_from_its_time_on(rate: float, width: int) -> None:
    """Slower or faster than sub-steps; of what held before the last one counts the mean."""
    rng = np.random.default_rng(0)
    ticks = np.arange(5) * rate
    times = np.stack([np.append(ticks, np.inf), np.append(1.3 * ticks, np.inf)])
    commands = rng.uniform(size=(12, 2))
    cells = np.arange(21) * 0.002
    newest = np.stack([np.searchsorted(row, cells, "right") - 1 for row in times])
    end = rng.uniform(-0.01, 6 * rate, (2, 4 * width))
    end[0, 0] = times[0, 2]
    now, before, share = (np.empty((2, 8)) for _ in range(3))
    kernels.look_up(now, before, share, end - 0.002, end, commands, times, newest, 0.002)
    fine = (np.arange(2000) + 0.5) * 1e-6
    for i, row in enumerate(times):
        for k, at in enumerate(np.repeat(end[i], 2 // width)):
            held = np.maximum(np.searchsorted(row, [at, *(at - fine)], "right") - 1, 0)
            told = commands[6 * i + held, k % 2]
            assert now[i, k] == told[0]
            mean = share[i, k] * now[i, k] + (1 - share[i, k]) * before[i, k]
            assert mean == pytest.approx(told[1:].mean(), abs=1e-3)
            assert share[i, k] == pytest.approx((held[1:] == held[0]).mean(), abs=1e-3)


def test_where_nothing_can_be_written_it_is_compiled_all_the_same(tmp_path: Path) -> None:
    told = "import pup.physics.kernels as k; print(k.implicit_share(1.0, 1.0, 1.0))"
    nowhere = tmp_path / "file"
    nowhere.touch()  # a cache folder that can be made by nobody, not even by root
    done = subprocess.run(
        [sys.executable, "-c", told],
        env=os.environ | NOWHERE | {"NUMBA_CACHE_DIR": str(nowhere)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) == pytest.approx(1 / (1 - np.exp(-1)) - 1)

"""The compiled loop of robots of one joint does what sub-step after sub-step does."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from terms import BENCH, SERVO, Array, steps, with_terms
from test_simulator import recording

from pup.physics.kernels import assembled, digest
from pup.physics.loop import PARTS, Loop
from pup.physics.mujoco_batch import KEPT, MujocoSimulator
from pup.physics.parameters import Candidates, ParameterSpace
from pup.physics.terms import TERMS, Place, column
from pup.recording import Recording

EFFECTS = [e for e in TERMS if e in PARTS] + ["backlash", "joint_compliance", "measurement_delay"]


def place_of(effect: str) -> Place:
    kind = next(k for k in ("joint", "bus", "robot") if k in TERMS[effect].kinds)
    return Place.parse(f"{kind}:servo" if kind == "joint" else kind)


def a_row(rng: np.random.Generator, effects: Sequence[str]) -> dict[str, float]:
    """Effects of a size from a tenth to twice the usual, their shapes as any of the grid."""
    row = dict(SERVO)
    for effect in effects:
        for quantity in TERMS[effect].quantities:
            sign = rng.choice([-1.0, 1.0]) if quantity.signed else 1.0
            size = sign * quantity.typical * rng.uniform(0.1, 2.0)
            value = rng.choice(quantity.grid) if quantity.shape else size
            within = quantity.name == "angle"  # of a stop, where the joint gets to
            value = rng.uniform(-0.2, 0.4) if within else value
            row[column(effect, quantity.name, place_of(effect))] = float(value)
    return row


def recordings(rng: np.random.Generator) -> list[Recording]:
    """Of different lengths, one whose torque is off for a while, with ticks at odd times."""
    told = [steps(BENCH, np.array([m]), s, "bench") for m, s in ((0.3, 1.1), (-0.9, 0.7))]
    time = np.cumsum(rng.uniform(0.02, 0.04, 30)) - 0.02
    enabled = np.ones(30)
    enabled[12:18] = 0.0
    target = np.cumsum(rng.normal(0, 0.1, 30))
    off = {"torque_enabled": enabled}
    return [*told, recording(BENCH, time - time[0], target, 0.1, id="off", extras=off)]


def both(
    monkeypatch: pytest.MonkeyPatch,
    runs: Sequence[Recording],
    candidates: Candidates,
    lead: float = 0.0,
) -> tuple[Array, Array]:
    """Positions by the loop, and without."""
    loops = []
    known = Loop.of
    simulator = MujocoSimulator(BENCH, runs, "pd", lead=lead)

    def seen(*args: Any) -> Loop | None:
        loops.append(known(*args))
        return loops[-1]

    with monkeypatch.context() as patched:
        patched.setattr(Loop, "of", seen)
        fast = simulator.replay(candidates).position[:, :, 0]
        assert loops
        assert None not in loops
    with monkeypatch.context() as patched:
        patched.setattr(Loop, "of", lambda *_: None)
        slow = simulator.replay(candidates).position[:, :, 0]
    return fast, slow


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 100_000))
def test_it_does_what_servos_do(seed: int) -> None:
    rng = np.random.default_rng(seed)
    chosen = rng.choice(EFFECTS, size=rng.integers(0, 5), replace=False)
    rows = [a_row(rng, chosen[: rng.integers(0, len(chosen) + 1)]) for _ in range(3)]
    with pytest.MonkeyPatch.context() as monkeypatch:
        given = with_terms(BENCH, rows)
        fast, slow = both(monkeypatch, recordings(rng), given, lead=rng.choice([0.0, 0.3]))
    assert np.ptp(slow) > 0.1
    np.testing.assert_allclose(fast, slow, rtol=0, atol=1e-9)


@pytest.mark.parametrize("effect", EFFECTS)
def test_each_effect_acts_in_it_and_as_ever(effect: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    runs, rows = recordings(rng), [dict(SERVO), a_row(rng, [effect])]
    fast, slow = both(monkeypatch, runs, with_terms(BENCH, rows))
    assert np.abs(slow[1] - slow[0]).max() > 1e-5
    np.testing.assert_allclose(fast, slow, rtol=0, atol=1e-9)


def test_what_leaves_its_range_is_moved_by_mujoco_and_goes_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A servo that is told to go beyond its joint's limit is pressed against it and comes back."""
    time = np.arange(0, 3, 0.02)
    limit = BENCH.joints[0].upper
    target = np.where(time < 1.5, limit + 0.5, limit - 0.6)
    reached = []
    move = Loop.move

    def counted(self: Loop, first: int) -> int:
        reached.append(move(self, first))
        return reached[-1]

    monkeypatch.setattr(Loop, "move", counted)
    run = recording(BENCH, time, target, limit - 0.3)
    given = with_terms(BENCH, [SERVO, SERVO | {"kp/servo": 3.0}])
    fast, slow = both(monkeypatch, [run], given)
    assert len(reached) > 10
    assert (slow.max(axis=1) > limit).all()
    np.testing.assert_allclose(fast, slow, rtol=0, atol=1e-7)  # as in test_one_joint


def test_a_simulation_that_breaks_down_is_told_from_there_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A gain that makes a servo run away, beside one that does not."""
    time = np.arange(0, 2, 0.02)
    run = recording(BENCH, time, 0.5 * np.sin(3 * time), 0.0)
    wild = SERVO | {column("joint_spring", "stiffness", Place.parse("joint:servo")): -1e9}
    fast, slow = both(monkeypatch, [run], with_terms(BENCH, [SERVO, wild]))
    assert np.isnan(slow[1]).any()
    assert not np.isnan(slow[0]).any()
    np.testing.assert_array_equal(np.isnan(fast), np.isnan(slow))
    np.testing.assert_allclose(fast[0], slow[0], rtol=0, atol=1e-9)


def test_commands_late_by_the_nominal_delay_too(monkeypatch: pytest.MonkeyPatch) -> None:
    known = with_terms(BENCH, [a_row(np.random.default_rng(1), ["clock_skew", "command_delay"])])
    zero, most = np.zeros(1), np.full(1, 0.1)
    space = known.space.plus(ParameterSpace(("command_delay",), ("s",), zero, -most, most))
    rows = np.repeat(space.at({}).nominal[None], 3, axis=0)
    rows[:, : len(known.space)] = known.values
    rows[:, -1] = (0.0, 0.017, -0.008)
    runs = recordings(np.random.default_rng(5))
    fast, slow = both(monkeypatch, runs, space.candidates(rows))
    assert (np.abs(slow[1:] - slow[0]).max(axis=1) > 1e-3).all()
    np.testing.assert_allclose(fast, slow, rtol=0, atol=1e-9)


def test_torque_that_is_off_is_off(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the other comparisons hold on to: recordings hold times without torque."""
    runs = recordings(np.random.default_rng(5))
    on = [*runs[:-1], replace(runs[-1], extras={})]
    given = with_terms(BENCH, [SERVO])
    without, within = (both(monkeypatch, some, given)[0] for some in (runs, on))
    assert np.abs(without - within).max() > 0.05


def test_long_recordings_are_replayed_a_few_candidates_at_a_time() -> None:
    time = np.arange(0, 60, 0.03)
    run = recording(BENCH, time, 0.3 * np.sin(time), 0.0)
    simulator = MujocoSimulator(BENCH, [run], "pd")
    (group,) = simulator.groups
    parts = simulator._parts(group, 512)
    assert max(p.stop - p.start for p in parts) * len(group.running) <= KEPT


def test_what_is_kept_is_known_by_its_sources(tmp_path: Path) -> None:
    def named() -> str:
        def double(x: float) -> float:
            return 2 * x

        assert assembled(double, "f8(f8)", digest(str(tmp_path / "laws.py")))(2.0) == 4.0
        return double.__qualname__

    (tmp_path / "laws.py").write_text("A = 1")
    first, again = named(), named()
    (tmp_path / "laws.py").write_text("A = 2")
    assert first == again != named()

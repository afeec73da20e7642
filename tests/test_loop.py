"""The compiled loop of robots of one joint does what sub-step after sub-step does."""

from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from terms import BENCH, SERVO, Array, Row, play, steps
from test_simulator import recording

from pup.physics.kernels import assembled
from pup.physics.loop import PARTS, Loop
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
    target = np.cumsum(rng.normal(0, 0.1, 30))
    target[12:18] = np.nan
    told.append(recording(BENCH, time - time[0], target, 0.1, id="off"))
    return [r if i else told[0] for i, r in enumerate(told)]


def both(
    monkeypatch: pytest.MonkeyPatch, runs: Sequence[Recording], rows: Sequence[Row]
) -> tuple[Array, Array]:
    """Positions by the loop, and without."""
    loops = []
    known = Loop.of

    def seen(*args: object) -> Loop | None:
        loops.append(known(*args))  # type: ignore[arg-type]
        return loops[-1]

    with monkeypatch.context() as patched:
        patched.setattr(Loop, "of", seen)
        fast = play(BENCH, runs, rows).position[:, :, 0]
        assert loops
        assert None not in loops
    with monkeypatch.context() as patched:
        patched.setattr(Loop, "of", lambda *_: None)
        slow = play(BENCH, runs, rows).position[:, :, 0]
    return fast, slow


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 100_000))
def test_it_does_what_servos_do(seed: int) -> None:
    rng = np.random.default_rng(seed)
    chosen = rng.choice(EFFECTS, size=rng.integers(0, 5), replace=False)
    rows = [a_row(rng, chosen[: rng.integers(0, len(chosen) + 1)]) for _ in range(3)]
    with pytest.MonkeyPatch.context() as monkeypatch:
        fast, slow = both(monkeypatch, recordings(rng), rows)
    assert np.ptp(slow) > 0.1
    np.testing.assert_allclose(fast, slow, rtol=0, atol=1e-9)


@pytest.mark.parametrize("effect", EFFECTS)
def test_each_effect_acts_in_it_and_as_ever(effect: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    runs, rows = recordings(rng), [dict(SERVO), a_row(rng, [effect])]
    fast, slow = both(monkeypatch, runs, rows)
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
    fast, slow = both(monkeypatch, [run], [SERVO, SERVO | {"kp/servo": 3.0}])
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
    fast, slow = both(monkeypatch, [run], [SERVO, wild])
    assert np.isnan(slow[1]).any()
    assert not np.isnan(slow[0]).any()
    np.testing.assert_array_equal(np.isnan(fast), np.isnan(slow))
    np.testing.assert_allclose(fast[0], slow[0], rtol=0, atol=1e-9)


def test_it_is_kept_by_a_name_that_tells_of_its_kernels(tmp_path: Path) -> None:
    module = ModuleType("laws")
    module.__file__ = str(tmp_path / "laws.py")

    def named() -> str:
        def double(x: float) -> float:
            return 2 * x

        assert assembled("f8(f8)", [module])(double)(2.0) == 4.0
        return double.__qualname__

    (tmp_path / "laws.py").write_text("A = 1")
    first, again = named(), named()
    (tmp_path / "laws.py").write_text("A = 2")
    assert first == again != named()

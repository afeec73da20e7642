"""The diagnosis of a bench servo: what is concealed is named, what is not is not."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pup.diagnosis import retracing
from pup.diagnosis.coordinates import Coordinate
from pup.diagnosis.engine import diagnose
from pup.diagnosis.evidence import Projector, Trace, scores, threshold
from pup.diagnosis.fit import ENOUGH, Fit
from pup.diagnosis.fitting import fit_together
from pup.diagnosis.hypotheses import Hypothesis, hypotheses
from pup.diagnosis.noise import noise_floor, quanta, quiet_noise
from pup.diagnosis.replays import Batch, Bench, Replays, threads
from pup.diagnosis.residuals import Measured, Noise, steady_start
from pup.diagnosis.result import Diagnosis
from pup.diagnosis.store import Store
from pup.diagnosis.tracing import traces
from pup.physics.parameters import robot_space
from tests.diagnosis_cases import BENCH, recordings

SERVO = "joint:servo"


def found(missing: Mapping[str, float], seed: int = 3, effects: int = 8) -> Diagnosis:
    return diagnose(
        BENCH,
        recordings(missing, seed),
        lambda measured: threads(Bench(measured), 1),
        1,
        lambda stage, share: None,
        effects=effects,
    )


@pytest.mark.parametrize(
    ("missing", "effect", "quantity"),
    [
        ({f"coulomb_friction/torque@{SERVO}": 0.03}, "coulomb_friction", "torque"),
        ({f"backlash/gap@{SERVO}": 0.008, f"backlash/behind@{SERVO}": 1.0}, "backlash", "gap"),
        ({f"torque_speed_limit/slope@{SERVO}": 0.03}, "torque_speed_limit", "slope"),
        ({f"cogging/sine@{SERVO}": 0.012, f"cogging/teeth@{SERVO}": 42.0}, "cogging", "sine"),
        # Of friction that brakes one way only, that of the other way is no opposite.
        ({f"friction_asymmetry/torque@{SERVO}": -0.05}, "friction_asymmetry", "torque"),
    ],
)
def test_a_concealed_effect_is_named_and_measured(
    missing: Mapping[str, float], effect: str, quantity: str
) -> None:
    told = found(missing, effects=1)
    assert told.verdict == "mismatch"
    first = told.findings[0]
    assert first.effect == effect
    assert first.place.name == "servo"
    assert first.probability > 0.5
    size = missing[f"{effect}/{quantity}@{SERVO}"]
    assert first.parameters[quantity].value == pytest.approx(size, rel=0.15)
    assert told.held_out is not None
    assert told.held_out.after < told.held_out.before
    assert told.held_out.after == pytest.approx(0.00205, rel=0.1)  # the noise, quantised


@pytest.mark.slow
def test_what_a_large_effect_hides_is_found_beside_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each round looks around its own model: what else is missing does other things there.

    Of very many hypotheses the hopeless are not simulated again.
    """
    monkeypatch.setattr(retracing, "LEADING", 30)
    monkeypatch.setattr(retracing, "MOST", 30)
    missing = {
        f"torque_speed_limit/slope@{SERVO}": 0.03,
        f"derivative_kick/gain@{SERVO}": 0.3,
        f"derivative_kick/time@{SERVO}": 0.015,
    }
    told = found(missing)
    assert {finding.effect for finding in told.findings} == {
        "torque_speed_limit",
        "derivative_kick",
    }
    first, second = told.rounds[:2]
    around = {score.trace.hypothesis: score.trace for score in first.ranking}
    again = next(
        s.trace for s in second.ranking if s.trace.hypothesis.effect == second.chosen.effect
    )
    before = around[again.hypothesis]
    assert np.linalg.norm(again.whole - before.whole) > 0.1 * np.linalg.norm(before.whole)
    kept = [s for s in second.ranking if s.trace.hypothesis in around]
    old = sum(s.trace.whole is around[s.trace.hypothesis].whole for s in kept)
    assert 0 < old < len(kept) - 20


def test_nothing_is_found_where_nothing_is_missing() -> None:
    told = found({}, seed=4)
    assert told.verdict == "none"
    assert not told.findings
    assert told.nominal.certificate.holds


def test_what_is_small_and_predicts_little_is_no_mismatch() -> None:
    """Every robot has a little of everything; it shows, but nothing material is missing."""
    told = found({f"command_delay/time@{SERVO}": 0.0006})
    assert told.verdict == "none"
    assert "not material" in told.reason
    assert not told.findings
    assert told.model is not None and not told.model.hypotheses


def test_what_cannot_be_told_apart_is_told_together() -> None:
    """Late commands and late readings are the same thing to a servo that starts at rest."""
    told = found({f"command_delay/time@{SERVO}": 0.012})
    named = {told.findings[0].effect, *(e.effect for e in told.findings[0].equivalents)}
    assert {"command_delay", "measurement_delay"} <= named


def test_poor_data_tell_nothing() -> None:
    runs = recordings({f"coulomb_friction/torque@{SERVO}": 0.03})
    still = tuple(replace(r, target=0 * r.target, position=0 * r.position) for r in runs)
    for poor, why in ((runs[:1], "second motion"), (still, "no joint moves")):
        told = diagnose(BENCH, poor, lambda m: threads(Bench(m), 1), 1, lambda stage, share: None)
        assert told.verdict == "undetermined"
        assert why in told.reason
        assert not told.findings
        assert told.ask is not None
        assert told.ask.motion not in {r.motion for r in poor}


class TestNoise:
    def test_repeats_tell_the_noise_of_each_reading(self) -> None:
        measured = Measured.of(BENCH, recordings({}, noise=0.003))
        rng = np.random.default_rng(0)
        errors = 0.003 * rng.normal(size=len(measured.values))
        noise = noise_floor(measured, errors)
        assert noise.source == "repeats"
        assert noise.sigma[0] == pytest.approx(0.003, rel=0.1)
        assert noise.rho[0] < 0.2

    def test_without_repeats_it_is_assumed_from_what_flickers(self) -> None:
        runs = [replace(r, repeat_of=None) for r in recordings({}) if r.id != "step_1"]
        measured = Measured.of(BENCH, runs)
        rng = np.random.default_rng(0)
        slow = 0.02 * np.sin(measured.time)
        errors = slow + 0.003 * rng.normal(size=len(measured.values))
        noise = noise_floor(measured, errors)
        assert noise.source == "assumed"
        assert noise.sigma[0] == pytest.approx(0.003, rel=0.3)

    def test_what_a_good_model_leaves_tells_it_but_for_its_bursts(self) -> None:
        """Noise with a memory, and a fifth of the time something that the model lacks."""
        measured = Measured.of(BENCH, recordings({}))
        rng = np.random.default_rng(2)
        own = 0.002 * rng.normal(size=len(measured.values))
        errors = own.copy()
        for i in range(1, len(own)):
            errors[i] = 0.5 * errors[i - 1] + np.sqrt(0.75) * own[i]
        errors += np.where(measured.time % 2.5 < 0.5, 0.02, 0.0)
        noise = quiet_noise(measured, errors)
        assert noise.sigma[0] == pytest.approx(0.002, rel=0.1)
        assert noise.rho[0] == pytest.approx(0.5, abs=0.12)

    def test_whitening_undoes_correlation(self) -> None:
        measured = Measured.of(BENCH, recordings({}))
        rng = np.random.default_rng(1)
        n = len(measured.values)
        errors = np.zeros(n)
        for i in range(n):
            own = 0.002 * rng.normal()
            first = i == 0 or measured.recording[i] != measured.recording[i - 1]
            errors[i] = own if first else 0.6 * errors[i - 1] + 0.8 * own
        noise = Noise(np.full(3, 0.002), np.full(3, 0.6), "assumed")
        white = measured.whiten(errors, noise)
        assert np.std(white) == pytest.approx(1, rel=0.1)
        assert abs(np.corrcoef(white[1:], white[:-1])[0, 1]) < 0.1

    def test_a_start_is_averaged_over_its_rest(self) -> None:
        run = recordings({}, noise=0.003)[0]
        steadied = steady_start(run, 0.012)
        rest = int(np.flatnonzero(run.target[:, 0] != run.target[0, 0])[0])
        assert steadied.position[0, 0] == pytest.approx(run.position[:rest, 0].mean())
        assert np.array_equal(steadied.position[1:], run.position[1:])


class Linear:
    """Replays of a model whose samples are linear in its parameters."""

    def __init__(self, matrix: np.ndarray, data: np.ndarray) -> None:
        self.space, self.matrix, self.asked = robot_space(BENCH, "pd"), matrix, 0
        self.measured = Measured.of(BENCH, recordings({}))
        n = len(self.measured.values)
        self.matrix = np.resize(matrix, (n, matrix.shape[1]))
        self.measured = replace(self.measured, values=self.matrix @ data)

    def __call__(self, rows: list[dict[str, float]]) -> np.ndarray:
        self.asked += len(rows)
        return np.array([self.matrix @ [row["a"], row["b"]] for row in rows])

    def together(
        self, asked: list[tuple[list[dict[str, float]], list[int]]], coarse: bool = False
    ) -> list[np.ndarray]:
        return [self(rows) for rows, _ in asked]


def test_fits_stay_in_their_boxes_and_find_the_corner() -> None:
    rng = np.random.default_rng(5)
    replays = Linear(rng.normal(size=(200, 2)), np.array([0.5, 3.0]))
    free = (Coordinate("a", 1.0, 0.0, 1.0), Coordinate("b", 1.0, 0.0, 2.0))
    noise = Noise(np.ones(3), np.zeros(3), "assumed")
    fit = Fit(free, np.array([0.9, 0.1]))
    fit_together([fit], replays, noise)  # type: ignore[arg-type]  # it has all that a fit asks for
    assert fit.done
    assert fit.at[1] == pytest.approx(2.0)
    left = replays.measured.values - 2.0 * replays.matrix[:, 1]
    best = float(left @ replays.matrix[:, 0] / (replays.matrix[:, 0] @ replays.matrix[:, 0]))
    missed = fit.at[0] - np.clip(best, 0, 1)
    assert np.linalg.norm(replays.matrix[:, 0] * missed) ** 2 < ENOUGH


def as_described(replays: Replays) -> Fit:
    """The robot as it is described, free to move by a factor of e."""
    free = tuple(
        Coordinate(n, None, np.log(v) - 1, np.log(v) + 1)
        for n, v in zip(replays.space.names, replays.space.nominal, strict=True)
    )
    return Fit(free, np.log(replays.space.nominal))


def test_the_threshold_is_reached_by_chance_as_often_as_it_says() -> None:
    """Pure noise, projected as errors are, exceeds it in one case of twenty."""
    measured = Measured.of(BENCH, recordings({}))
    replays = Replays(measured, robot_space(BENCH, "pd"), threads(Bench(measured), 1), 1)
    rng = np.random.default_rng(2)
    noise = Noise(np.full(3, 0.002), np.zeros(3), "assumed")
    fit = as_described(replays)
    fit_together([fit], replays, noise, iterations=1)
    told = traces(hypotheses(measured), fit, replays, noise)
    enough = threshold(told, rng, 0.05)
    assert fit.jacobian is not None
    project = Projector(fit.jacobian)
    exceeded = 0
    for _ in range(300):
        draw = project(rng.normal(size=(len(measured.values), 1)))[:, 0]
        exceeded += scores(told, draw)[0].surprise > enough
    assert 4 <= exceeded <= 32


def test_an_effect_is_simulated_again_for_its_best_form_in_all_its_forms(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of ripples of fourteen numbers of teeth few look like the errors, and most like nothing."""
    measured = Measured.of(BENCH, recordings({f"cogging/sine@{SERVO}": 0.02}))
    replays = Replays(measured, robot_space(BENCH, "pd"), threads(Bench(measured), 1), 1)
    noise = Noise(np.full(3, 0.002), np.zeros(3), "assumed")
    fit = as_described(replays)
    fit_together([fit], replays, noise, iterations=8)
    tried = ("cogging", "backlash", "joint_spring", "encoder_eccentricity")
    known = [h for h in hypotheses(measured) if h.effect in tried]
    found = traces(known, fit, replays, noise)
    monkeypatch.setattr(retracing, "LEADING", 1)
    monkeypatch.setattr(retracing, "MOST", 1)
    retracer = retracing.Retracer(replays, noise, found, fit)
    monkeypatch.setattr(retracing, "traces", lambda leading, *more: asked.extend(leading) or [])
    asked: list[Hypothesis] = []
    kept = retracer.anew(fit, known)
    assert fit.jacobian is not None and fit.residual is not None
    project = Projector(fit.jacobian)
    ranking = scores(found, project(fit.residual[:, None])[:, 0])
    assert ranking[0].trace.hypothesis.effect == "cogging"
    last = {score.trace.hypothesis.effect: rank for rank, score in enumerate(ranking)}
    assert min(last, key=lambda effect: last[effect]) != "cogging", (
        "its worst form is among the last"
    )
    assert asked == [h for h in known if h.effect == "cogging"]
    assert {t.hypothesis.effect for t in kept} == set(tried) - {"cogging"}


def test_where_an_effect_changes_all_others_they_are_all_simulated_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What looked like the errors before is a guide as long as it does what it did."""
    measured = Measured.of(BENCH, recordings({}))
    replays = Replays(measured, robot_space(BENCH, "pd"), threads(Bench(measured), 1), 1)
    noise = Noise(np.full(3, 0.002), np.zeros(3), "assumed")
    fit = as_described(replays)
    fit_together([fit], replays, noise, iterations=8)
    tried = ("backlash", "joint_spring", "coulomb_friction", "encoder_bias", "gain_asymmetry")
    known = [h for h in hypotheses(measured) if h.effect in tried]
    found = traces(known, fit, replays, noise)
    monkeypatch.setattr(retracing, "LEADING", 2)
    counted: list[int] = []
    simulate = retracing.traces

    def counting(some: Sequence[Hypothesis], *more: Any) -> list[Trace]:
        counted.append(len(some))
        return simulate(some, *more)

    monkeypatch.setattr(retracing, "traces", counting)
    retracer = retracing.Retracer(replays, noise, found, fit)
    assert len(retracer.anew(fit, known)) == len(found)
    assert len(counted) == 1
    assert counted[0] < len(known)
    rng = np.random.default_rng(0)
    retracer.found = tuple(replace(t, whole=rng.normal(size=t.whole.shape)) for t in found)
    counted.clear()
    anew = {t.hypothesis: t for t in retracer.anew(fit, known)}
    assert sum(counted) == len(known)
    for trace in found:
        assert anew[trace.hypothesis].whole == pytest.approx(trace.whole)


def test_what_was_replayed_is_not_replayed_again(tmp_path: Path) -> None:
    measured = Measured.of(BENCH, recordings({}))
    asked = []

    def runner(batches: Sequence[Batch]) -> list[np.ndarray]:
        asked.append(len(batches))
        return threads(Bench(measured), 1)(batches)

    store = Store(tmp_path / "kept", "digest")
    rows = [{"kp/servo": 3.0 + 0.1 * i} for i in range(4)]
    first, second = (
        Replays(measured, robot_space(BENCH, "pd"), store.around(runner), 1)(rows) for _ in range(2)
    )
    assert np.array_equal(first, second)
    assert asked == [1, 0]
    other = Store(tmp_path / "kept", "another").around(runner)
    Replays(measured, robot_space(BENCH, "pd"), other, 1)(rows)
    assert asked[-1] == 1
    store.clear()
    assert not (tmp_path / "kept").exists()


def test_a_coarse_encoder_at_rest_is_not_believed_to_be_exact() -> None:
    """What always tells the same value is known to a step of it, not exactly."""
    step = 2 * np.pi / 4096
    runs = tuple(
        replace(r, position=np.round(r.position / step) * step, repeat_of=None)
        for r in recordings({}, noise=0.0)
    )
    measured = Measured.of(BENCH, runs)
    assert quanta(measured)[0] == pytest.approx(step, rel=1e-2)
    floor = noise_floor(measured, np.zeros_like(measured.values))
    assert floor.sigma[0] >= 0.99 * step / np.sqrt(12)
    fine = Measured.of(BENCH, recordings({}, noise=0.002))
    smooth = replace(
        fine, values=fine.values + np.random.default_rng(0).normal(0, 0.002, len(fine.values))
    )
    assert quanta(smooth)[0] == 0.0

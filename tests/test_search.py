"""What is searched, and in which order: parts of one recording, motions that get lost."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pup.diagnosis.coordinates import nominal_coordinate, term_coordinate
from pup.diagnosis.document import document
from pup.diagnosis.engine import diagnose
from pup.diagnosis.fit import Fit
from pup.diagnosis.fitting import fit_together
from pup.diagnosis.looks import followed, followed_well, in_the_air
from pup.diagnosis.noise import assumed_noise
from pup.diagnosis.nominal import Certificate, Nominal, certified, fit_nominal, free_names
from pup.diagnosis.pieces import SHORTEST, STILL, origins, pieces
from pup.diagnosis.replays import Bench, Replays, threads
from pup.diagnosis.residuals import Measured
from pup.diagnosis.search import carried, search
from pup.physics.parameters import robot_space
from pup.physics.terms import CLASS_OF
from pup.physics.terms.scale import Scale
from pup.recording import Recording
from tests.blind_sets import ENOUGH, FRICTION, shortened
from tests.diagnosis_cases import BENCH, recordings


def moves(rests: list[float], period: float = 0.02) -> Recording:
    """A servo that moves for a second, to and fro, and rests as long as is given, and so on."""
    parts = [np.zeros(round(0.5 / period))]
    for number, rest in enumerate(rests):
        ramp = np.linspace(0.0, 1.0, round(1 / period))
        start, end = number % 2, (number + 1) % 2
        parts += [start + (end - start) * ramp, np.full(round(rest / period), float(end))]
    target = np.concatenate(parts)[:, None]
    return replace(
        recordings({})[0],
        id="long",
        time=3.0 + period * np.arange(len(target)),
        target=target,
        position=target + 1e-4,
    )


class TestPieces:
    @settings(max_examples=25)
    @given(st.lists(st.floats(0.1, 3.0), min_size=6, max_size=30))
    def test_nothing_is_lost_and_parts_start_at_rest(self, rests: list[float]) -> None:
        whole = moves(rests)
        parts = pieces([whole])
        assert np.array_equal(np.concatenate([p.position for p in parts]), whole.position)
        for part in parts[1:]:
            assert part.time[-1] >= SHORTEST - 0.1
            first = part.target[part.time <= 0.04]
            assert np.ptp(first) < 0.05

    def test_parts_are_cut_where_it_rests(self) -> None:
        whole = moves([1.5] * 4)
        parts = pieces([whole])
        assert len(parts) == 4
        assert [p.motion for p in parts] == [whole.motion] * 4
        for part in parts:
            resting = np.ptp(part.target[part.time[-1] - part.time < STILL])
            assert resting == 0

    @pytest.mark.parametrize("step", [0.0, 0.0015])
    def test_a_joint_that_is_held_still_does_not_hinder_it(self, step: float) -> None:
        """Its readings flicker all the time, and by a step where its encoder is coarse."""
        whole = moves([1.5] * 4)
        rng = np.random.default_rng(0)
        both = [np.hstack([v, np.zeros_like(v)]) for v in (whole.target, whole.position)]
        read = both[1] + 0.0008 * rng.normal(size=both[1].shape)
        read = np.round(read / step) * step if step else read
        two = replace(whole, joints=("a", "b"), target=both[0], position=read)
        assert len(pieces([two])) == 4

    def test_parts_know_where_in_the_recording_they_begin(self) -> None:
        whole = moves([1.5] * 4)
        parts = pieces([whole])
        told = origins([whole], parts)
        elapsed = whole.time - whole.time[0]
        for part in parts:
            name, begin = told[part.id]
            assert name == whole.id
            rows = (elapsed >= begin) & (elapsed <= begin + part.time[-1])
            assert np.array_equal(whole.position[rows], part.position)
        assert origins([whole, whole], [whole, whole]) == {}

    def test_what_never_rests_or_is_short_stays_whole(self) -> None:
        (short,) = pieces([moves([1.5])])
        assert short.id == "long"
        whole = moves([0.1] * 20)
        wave = 0.5 * np.sin(5 * whole.time)[:, None]
        (restless,) = pieces([replace(whole, target=wave, position=wave)])
        assert restless.id == "long"

    def test_several_recordings_stay_as_they_are(self) -> None:
        two = [moves([1.5] * 4), moves([1.0] * 6)]
        assert pieces(two) == two


@pytest.fixture(scope="module")
def runs() -> tuple[Recording, ...]:
    return recordings({})


def kept(runs: tuple[Recording, ...]) -> list[int]:
    """The recordings that the bench's nominal model follows."""
    measured = Measured.of(BENCH, runs)
    replays = Replays(measured, robot_space(BENCH, "pd"), threads(Bench(measured), 1), 1)
    space = replays.space
    coordinates = tuple(nominal_coordinate(space, name) for name in space.names)
    fit = Fit(
        coordinates,
        np.array([c.coordinate(x) for c, x in zip(coordinates, space.nominal, strict=True)]),
    )
    nominal = Nominal(fit, assumed_noise(measured), Certificate((1.0, 1.0), True, 0.0))
    return followed(nominal, replays)


def test_where_all_are_followed_none_is_left_for_later(runs: tuple[Recording, ...]) -> None:
    assert kept(runs) == []


def test_a_motion_that_gets_lost_comes_second(runs: tuple[Recording, ...]) -> None:
    astray = replace(runs[-1], position=runs[-1].position + 1.0)
    assert kept((*runs[:-1], astray)) == [0, 1, 2, 3]


def test_where_too_few_are_left_all_are_taken(runs: tuple[Recording, ...]) -> None:
    lost = [replace(run, position=run.position + 1.0) for run in runs[2:]]
    assert kept((*runs[:2], *lost)) == []


def test_what_is_followed_best_is_looked_at_where_all_of_it_leads_nowhere(
    runs: tuple[Recording, ...],
) -> None:
    def well(*off: float) -> list[int]:
        measured = Measured.of(BENCH, runs)
        replays = Replays(measured, robot_space(BENCH, "pd"), threads(Bench(measured), 1), 1)
        fit = Fit((), np.empty(0), residual=np.array(off)[measured.recording])
        return followed_well(
            Nominal(fit, assumed_noise(measured), Certificate((1.0, 1.0), True, 0.0)), replays
        )

    assert well(3, 4, 5, 2, 30) == [0, 1, 2, 3]
    assert well(3, 4, 5, 2, 5) == []
    assert well(0.1, 0.2, 1.5, 0.3, 1.9) == []  # noise is not far from noise
    assert well(3, 30, 3, 30, 30) == [0, 2]


def test_a_motion_that_nothing_explains_is_left_out_and_told() -> None:
    """Somebody held the arm: what is missing in the others is found, and is of them alone."""
    runs = recordings(FRICTION)
    chirp = next(i for i, run in enumerate(runs) if run.motion == "chirp")
    held = replace(runs[chirp], position=-runs[chirp].position)
    told = diagnose(
        BENCH,
        [*runs[:chirp], held, *runs[chirp + 1 :]],
        lambda measured: threads(Bench(measured), 1),
        1,
        lambda stage, share: None,
    )
    assert told.verdict == "mismatch"
    assert CLASS_OF[told.findings[0].effect] == CLASS_OF["coulomb_friction"]
    assert told.lost == (held.id,)
    assert held.id not in {r.id for r in told.measured.recordings}
    assert held.id in document(told, "corrected")["reason"]


def test_where_contact_leads_astray_what_is_in_the_air_comes_first(
    runs: tuple[Recording, ...],
) -> None:
    def aloft(grounded: set[int]) -> list[int]:
        supports = ["ground" if i in grounded else run.support for i, run in enumerate(runs)]
        told = [replace(r, support=s) for r, s in zip(runs, supports, strict=True)]
        measured = Measured.of(BENCH, runs)
        return in_the_air(replace(measured, recordings=tuple(told)))

    assert aloft({1, 3}) == [i for i in range(len(runs)) if i not in (1, 3)]
    assert aloft(set()) == []
    assert aloft(set(range(len(runs)))) == []
    assert aloft(set(range(1, len(runs)))) == []  # one motion tells little


def test_where_nothing_more_is_looked_for_a_first_look_is_not_scored_again() -> None:
    """With all motions its model is fitted, and its traces stand for those of all."""
    measured = Measured.of(BENCH, [shortened(run, ENOUGH) for run in recordings(FRICTION)])
    replays = Replays(measured, robot_space(BENCH, "pd"), threads(Bench(measured), 1), 1)
    rng = np.random.default_rng(0)
    nominal = certified(fit_nominal(replays, assumed_noise(measured), rng), replays, rng)
    some = replays.narrowed([0, 1, 2, 3])
    fitted = certified(fit_nominal(some, assumed_noise(some.measured), rng), some, rng)
    first = search(some, fitted, rng, lambda stage, share: None, most=1)
    assert first is not None and first.model.hypotheses[0].effect == "coulomb_friction"
    spent = []
    for most in (1, 8):
        begun = replays.simulated
        done = search(replays, nominal, rng, lambda stage, share: None, first, most)
        assert done is not None and done.model.hypotheses[0].effect == "coulomb_friction"
        assert {len(trace.whole) for trace in done.found} == {len(measured.values)}
        assert done.enough == pytest.approx(first.enough, rel=0.3)
        spent.append(replays.simulated - begun)
    assert spent[0] < spent[1] / 2


def test_what_a_first_look_found_is_not_lost_on_the_way_to_all_motions() -> None:
    """A late loop with little damping swings, and from a little off its fit gets out of step."""
    late = "command_delay/time@joint:servo"
    truth = {late: 0.008, "kd/servo": 0.03}
    measured = Measured.of(BENCH, recordings(truth))
    space = robot_space(BENCH, "pd")
    replays = Replays(measured, space, threads(Bench(measured), 1), 1)
    noise, values = assumed_noise(measured), dict(zip(space.names, space.nominal, strict=True))
    own = tuple(nominal_coordinate(space, name) for name in free_names(space, ground=False))
    free = (*own, term_coordinate(late, Scale.of(BENCH)))
    there = np.array([c.coordinate(float((values | truth)[c.name])) for c in free])
    nominal = Fit(own, there[:-1].copy())
    fit_together([nominal], replays, noise)
    told = Nominal(nominal, noise, Certificate((nominal.chi2,), True, 0.0))
    starts, lost = np.random.default_rng(0).normal(size=(6, len(there))), 0
    for start in starts[[0, 2, 5]]:
        known = Fit(free, there + 0.25 * start)
        once = known.fresh()
        fit_together([once], replays, noise)
        lost += once.chi2 > 100 * len(measured.values)
        found = carried(known, replays, told)
        assert found.names == tuple(c.name for c in free)
        assert found.values[late] == pytest.approx(0.008, rel=0.1)
        assert found.chi2 < 1.1 * len(measured.values)
    assert lost == 2


def test_what_makes_a_loop_swing_is_found_though_no_slope_tells_of_it() -> None:
    """A lag with little damping: where nominal parameters went, and as described, none shows it."""
    late = "actuator_lag/time@joint:servo"
    truth = {late: 0.014, "actuator_lag/stages@joint:servo": 2.0, "kd/servo": 0.05}
    runs = [shortened(recordings(truth)[i], 80) for i in (0, 2, 3)]
    measured = Measured.of(BENCH, runs)
    replays = Replays(measured, robot_space(BENCH, "pd"), threads(Bench(measured), 1), 1)
    rng, samples = np.random.default_rng(0), len(measured.values)
    nominal = certified(fit_nominal(replays, assumed_noise(measured), rng), replays, rng)
    assert nominal.fit.chi2 > 20 * samples
    found = search(replays, nominal, rng, lambda stage, share: None, most=1)
    assert found is not None and [h.effect for h in found.model.hypotheses] == ["actuator_lag"]
    assert found.model.fit.chi2 < samples
    assert found.model.fit.values[late] == pytest.approx(0.014, rel=0.03)

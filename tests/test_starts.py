"""Where fits of finalists begin: near the nominal fit, and at the robot's description."""

from dataclasses import replace

import numpy as np
import pytest

from pup.diagnosis import starts
from pup.diagnosis.coordinates import nominal_coordinate
from pup.diagnosis.fit import Fit
from pup.diagnosis.fitting import complete, fit_together, start_best
from pup.diagnosis.folds import NOMINAL, without_samples
from pup.diagnosis.hypotheses import hypotheses
from pup.diagnosis.noise import assumed_noise
from pup.diagnosis.nominal import free_names
from pup.diagnosis.replays import Bench, Replays, threads
from pup.diagnosis.residuals import Measured
from pup.diagnosis.starts import DRIVEN, LOUD, begun_anew, described, distinct, puzzling
from pup.physics.parameters import robot_space
from tests.diagnosis_cases import BENCH, recordings

SPACE = robot_space(BENCH, "pd")
MISSING = {"integral_action/gain@joint:servo": 8.5, "integral_action/share@joint:servo": 0.3}


@pytest.fixture(scope="module")
def replays() -> Replays:
    measured = Measured.of(BENCH, recordings(MISSING))
    return Replays(measured, SPACE, threads(Bench(measured), 1), 1)


def nominal(**changed: float) -> Fit:
    """A nominal model by its values; those not given are the description's."""
    coordinates = tuple(nominal_coordinate(SPACE, n) for n in free_names(SPACE, ground=False))
    values = {n: float(SPACE.nominal[SPACE.names.index(n)]) for n in SPACE.names} | changed
    return Fit(coordinates, np.array([c.coordinate(values[c.name]) for c in coordinates]))


def test_where_nothing_is_chosen_nothing_is_begun(replays: Replays) -> None:
    """Recordings of a second or two leave nothing to go on with."""
    count = replays.count
    start_best([], [], replays, assumed_noise(replays.measured))
    assert replays.count == count


def test_a_fit_that_ends_far_from_the_description_is_begun_there_too(replays: Replays) -> None:
    noise = assumed_noise(replays.measured)
    assert described(nominal(), replays, noise) is None
    assert described(nominal(**{"kp/servo": 6.0}), replays, noise) is None
    fit = described(nominal(**{"kp/servo": 20.0}), replays, noise)
    assert fit is not None and fit.jacobian is not None
    assert fit.values["kp/servo"] == pytest.approx(3.84)
    assert np.isfinite(fit.chi2)


def test_what_the_other_motions_do_not_tell_stays_near_to_what_all_do() -> None:
    """A slow triangle never comes to the torque's limit: noise alone would say what that is."""
    measured = Measured.of(BENCH, recordings({}))
    replays = Replays(measured, SPACE, threads(Bench(measured), 1), 1)
    noise = assumed_noise(measured)
    fit = nominal()
    fit_together([fit], replays, noise)
    complete([fit], replays, noise)
    inside = ~measured.only(measured.motions()["triangle"])
    held = without_samples(fit, inside)
    assert held.belief is not None and held.belief.cost(held.at) == 0
    free = replace(held, belief=None)
    tight, loose = fit.names.index("kp/servo"), fit.names.index("tau_max/servo")
    for one in (held, free):  # from where only the data could lead them back
        one.at = fit.at.copy()
        one.at[[tight, loose]] += [0.1, 0.4]
        one.residual = one.jacobian = None
        fit_together([one], replays, noise)
    assert np.abs(free.at - fit.at)[loose] > 0.3 > NOMINAL > np.abs(held.at - fit.at)[loose]
    assert np.abs(held.at - fit.at)[tight] < 0.02  # the others tell that well


def test_what_explains_little_or_leaves_much_is_a_puzzle(replays: Replays) -> None:
    noise = assumed_noise(replays.measured)
    before, after = nominal(), nominal()
    fit_together([before], replays, noise, iterations=0)
    samples = len(replays.measured.values)
    for much, left, puzzle in ((11, 10, True), (11, 3, False), (1001, 3, False), (1001, 33, True)):
        before.chi2, after.chi2 = float(much * samples), float(left * samples)
        assert puzzling(before, [((), after)]) is puzzle
    assert puzzling(before, [])
    before.chi2, after.chi2 = 11.0 * samples, 4.0 * samples
    assert not puzzling(before, [((), after)])
    assert puzzling(before, [((), after)], DRIVEN)


def test_of_fits_with_the_same_effect_the_best_counts(replays: Replays) -> None:
    lag, other = [
        next(h for h in hypotheses(replays.measured) if h.effect == name)
        for name in ("actuator_lag", "backlash")
    ]
    fits = [nominal(), nominal(), nominal()]
    for fit, chi2 in zip(fits, (30.0, 20.0, 25.0), strict=True):
        fit.chi2 = chi2
    told = distinct(list(zip([(lag,), (lag,), (other,)], fits, strict=True)))
    assert [(h[-1].effect, f.chi2) for h, f in told] == [("actuator_lag", 20.0), ("backlash", 25.0)]


@pytest.mark.parametrize(("found", "kept"), [(7.0, 7.0), (30.0, 20.0)])
def test_a_fit_out_of_step_is_begun_by_beginnings_and_the_better_one_stays(
    replays: Replays, monkeypatch: pytest.MonkeyPatch, found: float, kept: float
) -> None:
    """What is near the noise stays as it is."""
    samples = len(replays.measured.values)

    def ends(fits: list[Fit], *_: object) -> None:
        for fit in fits:
            fit.chi2 = found * samples

    monkeypatch.setattr(starts, "begun", lambda fits, *_: [fit.at.fill(0.5) for fit in fits])
    monkeypatch.setattr(starts, "closely", ends)
    near, far = nominal(), nominal()
    near.chi2, far.chi2 = (LOUD - 1) * samples, 20.0 * samples
    begun_anew([near, far], replays, assumed_noise(replays.measured))
    assert near.chi2 == (LOUD - 1) * samples
    assert far.chi2 == kept * samples
    assert bool((far.at == 0.5).all()) is (found == kept)

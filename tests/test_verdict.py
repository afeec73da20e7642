"""What fitted models amount to: twins of a finding, and what a model leaves."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from pup.diagnosis.coordinates import term_coordinate
from pup.diagnosis.discover import beside
from pup.diagnosis.doubts import doubt, left_outside, left_over
from pup.diagnosis.evidence import Projector, Score, Trace, scores, traced
from pup.diagnosis.fit import Fit
from pup.diagnosis.hypotheses import hypotheses
from pup.diagnosis.models import Model, Round
from pup.diagnosis.residuals import Measured, Noise
from pup.diagnosis.verdict import (
    OTHER_FORM,
    Alternative,
    Finding,
    Parameter,
    in_order,
    of_other_form,
    probabilities,
    shared,
    twins_of,
)
from pup.physics.terms import TERMS, Place
from tests.diagnosis_cases import BENCH, recordings

MEASURED = Measured.of(BENCH, recordings({}))
CHANGE = np.linspace(-1, 1, 50)[:, None] / 4


def score(effect: str, sign: float, size: float) -> Score:
    hypothesis = next(h for h in hypotheses(MEASURED) if h.effect == effect)
    trace = Trace(hypothesis, sign * CHANGE, sign * CHANGE, CHANGE / np.linalg.norm(CHANGE))
    return Score(trace, 9.0, 1, np.array([size]))


@pytest.mark.parametrize(
    ("effect", "sign", "told"),
    [
        ("measurement_delay", 1.0, True),
        ("derivative_kick", -1.0, False),  # it would have to be negative
        ("clock_skew", -1.0, True),  # which may be
    ],
)
def test_twins_have_sizes_that_they_can_have(effect: str, sign: float, told: bool) -> None:
    own, other = score("command_delay", 1.0, 2.0), score(effect, sign, 2.0 * sign)
    chosen = Round(left(MEASURED, 1.0), (own, other), (), 1)
    found = twins_of(own.trace.hypothesis, {}, chosen)
    assert [name for name, _ in found] == ([effect] if told else [])


def left(measured: Measured, error: float, worth: float = 0.0) -> Model:
    """A model that leaves errors of some size, in units of the noise."""
    residual = error * np.random.default_rng(0).normal(size=len(measured.values))
    fit = Fit((), np.empty(0), residual=residual, jacobian=np.empty((len(residual), 0)))
    fit.chi2 = float(residual @ residual)
    return Model((), 0, fit, np.array([worth]), measured)


def test_a_model_of_some_recordings_leaves_what_it_leaves_of_those() -> None:
    """Rounds of a first look, at what the nominal model can follow, are judged by their samples."""
    some = Measured.of(BENCH, MEASURED.recordings[:2])
    noise = Noise(np.full(3, 0.002), np.zeros(3), "repeats")
    assert left_over(left(some, 1.0), noise) == 0
    beyond = left_over(left(some, 2.0), noise)
    assert beyond == pytest.approx(2.9 * len(some.values), rel=0.1)


def test_what_is_lost_on_motions_left_out_is_left_besides() -> None:
    """A ripple that follows the motions it was fitted to is no name for what it cannot foretell."""
    noise = Noise(np.full(3, 0.002), np.zeros(3), "repeats")
    model = left(MEASURED, 1.0)
    unit = np.random.default_rng(1).normal(size=len(MEASURED.values)) * 0.002
    foretold = replace(model, predicted=MEASURED.values + unit)
    astray = replace(model, predicted=MEASURED.values + 3 * unit)
    assert left_outside(foretold, noise) == left_over(model, noise) == 0
    assert left_outside(astray, noise) == pytest.approx(7.9 * len(MEASURED.values), rel=0.2)
    worse = replace(foretold, fit=left(MEASURED, 2.0).fit)
    assert left_outside(worse, noise) == left_over(worse, noise) > 0  # never less than in sample


def rival(effect: str, error: float, held_out: float = 0.0) -> Model:
    model = left(MEASURED, error, held_out)
    return replace(model, hypotheses=(score(effect, 1.0, 1.0).trace.hypothesis,))


def test_of_what_fits_alike_the_usual_law_is_likelier() -> None:
    """Friction that rises at rest is described seldom, and has a law of more freedom."""
    noise, before = Noise(np.full(3, 0.002), np.zeros(3), "repeats"), left(MEASURED, 20.0)
    usual, rising = rival("stribeck_friction", 1.0), rival("rising_static_friction", 1.0)
    assert usual.worth < rising.worth
    likely, rare = probabilities([usual, rising], before, noise)
    assert likely > 2 * rare > 0.1
    worse = rival("stribeck_friction", 1.5)  # what explains much more is meant all the same
    assert probabilities([rising, worse], before, noise)[0] > 0.85


@given(
    statistic=st.floats(0.1, 3000.0),
    freedom=st.integers(1, 4),
    more=st.floats(1.01, 2.0),
)
def test_a_score_of_several_magnitudes_is_as_improbable_as_that_of_one(
    statistic: float, freedom: int, more: float
) -> None:
    trace = score("command_delay", 1.0, 1.0).trace
    told = Score(trace, statistic, freedom, np.ones(freedom)).surprise
    assert told <= statistic + 1e-9
    assert told < Score(trace, more * statistic, freedom, np.ones(freedom)).surprise
    if stats.chi2.logsf(statistic, freedom) > -250:
        wanted = stats.chi2.logsf(statistic, freedom)
        assert stats.chi2.logsf(told, 1) == pytest.approx(wanted, rel=1e-6, abs=1e-9)


def test_sizes_that_a_score_asks_for_are_those_of_least_squares() -> None:
    """Of one magnitude, told without a decomposition, as of two."""
    rng = np.random.default_rng(0)
    project = Projector(rng.normal(size=(50, 3)))
    errors = project(rng.normal(size=(50, 1)))[:, 0]
    hypothesis = score("clock_skew", 1.0, 1.0).trace.hypothesis
    for columns in (1, 2):
        trace = traced(hypothesis, rng.normal(size=(50, columns)), project)
        assert trace is not None
        (told,) = scores([trace], errors)
        wanted, (rest,), *_ = np.linalg.lstsq(trace.left, errors, rcond=None)
        assert told.sizes == pytest.approx(wanted)
        assert told.statistic == pytest.approx(errors @ errors - rest)
        assert trace.basis.T @ trace.basis == pytest.approx(np.eye(columns))


def test_a_sibling_that_explains_nearly_as_much_keeps_a_part_of_what_its_class_is_given() -> None:
    """Real gears act in forms of their own: which of two is nearer is less sure than the class."""
    noise, before = Noise(np.full(3, 0.002), np.zeros(3), "repeats"), left(MEASURED, 20.0)
    gear = rival("gear_efficiency", 1.0)
    near, far = rival("load_dependent_friction", 1.5), rival("load_dependent_friction", 10.0)
    lag = rival("actuator_lag", 1.5)  # as near, but of another class
    told = probabilities([gear, near, lag], before, noise)
    assert told.sum() == pytest.approx(1)
    assert told[0] > 0.85
    assert told[1] > 0.05
    assert told[2] < 1e-6
    assert probabilities([gear, far], before, noise)[1] < 0.01


def test_siblings_that_fit_alike_are_alike_likely() -> None:
    noise, before = Noise(np.full(3, 0.002), np.zeros(3), "repeats"), left(MEASURED, 20.0)
    late, old = rival("command_delay", 1.0), rival("measurement_delay", 1.0)
    assert probabilities([late, old], before, noise) == pytest.approx([0.5, 0.5])


def test_of_what_fits_alike_the_more_usual_size_is_likelier() -> None:
    """An encoder that is off by a tenth of a radian is rarer than a load that hangs askew."""
    noise, before = Noise(np.full(3, 0.002), np.zeros(3), "repeats"), left(MEASURED, 20.0)

    def sized(effect: str, size: float) -> Model:
        model = rival(effect, 1.0)
        (known,) = model.hypotheses
        free = tuple(term_coordinate(name, known.scale) for name in known.magnitudes[:1])
        return replace(model, fit=replace(model.fit, coordinates=free, at=np.array([size])))

    load, encoder = sized("com_offset", 0.8), sized("encoder_bias", 6.0)
    assert load.worth < encoder.worth < sized("encoder_bias", 7.0).worth
    likely, rare = probabilities([load, encoder], before, noise)
    assert likely > 2 * rare > 0.1
    assert probabilities([load, sized("encoder_bias", 1.5)], before, noise)[1] > 0.45


def test_noise_that_is_not_well_known_is_no_reason_to_doubt() -> None:
    """A tenth more than the floor is doubtful by a floor of many readings, not by one of few."""
    model = left(MEASURED, np.sqrt(1.25))
    sure, unsure = (
        Noise(np.full(3, 0.002), np.zeros(3), "repeats", readings) for readings in (100_000, 60)
    )
    gained = 2000.0
    assert doubt(gained, left_over(model, sure)) > 0.15
    assert doubt(gained, left_over(model, unsure)) == pytest.approx(0.03)
    assert doubt(gained / 100, left_over(model, sure)) > doubt(gained, left_over(model, sure))


def test_what_rattles_may_leave_more() -> None:
    """Of the same share that is left, play is doubted less than friction, and of none as little."""
    assert doubt(100.0, 50.0, "lost_motion") < 0.5 < doubt(100.0, 50.0, "friction")
    assert doubt(100.0, 50.0, "friction") == doubt(100.0, 50.0)
    assert doubt(100.0, 0.0, "lost_motion") == doubt(100.0, 0.0)


def found(effect: str, gain: float, size: float, probability: float = 0.9) -> Finding:
    place = Place("joint", BENCH.joint_names[0])
    return Finding(effect, place, "", (), {}, probability, (), {}, None, gain, size)


def test_what_every_robot_has_a_little_of_comes_after_what_is_of_a_usual_size() -> None:
    """However much of the error is its: a clock that is off by a little moves everything."""
    clock, ripple = found("clock_skew", 8000.0, 0.2), found("cogging", 400.0, 0.4)
    nameless = found("unknown", 100.0, np.inf)
    assert in_order([clock, ripple, nameless]) == (ripple, nameless, clock)


@pytest.mark.parametrize(
    ("name", "before", "after"),
    [
        (0.83, 0.84, 0.83),
        (0.6, 0.79, 0.6),
        (0.95, 0.4, 0.4),
        (0.33, 0.47, 0.47),
        (None, 0.97, 0.97),
    ],
)
def test_what_has_no_name_is_no_surer_than_a_name_that_is_likely(
    name: float | None, before: float, after: float
) -> None:
    """Without its steps a servo's strength is anybody's guess, and all left there no evidence."""
    nameless = found("unknown", 5.0, np.inf, before)
    named = [] if name is None else [found("actuator_lag", 900.0, 1.0, name)]
    assert beside(nameless, named, BENCH).probability == after


@pytest.mark.parametrize(("likely", "first"), [(0.3, "cogging"), (0.2, "unknown")])
def test_what_has_no_name_is_first_where_it_is_surer_than_what_has(
    likely: float, first: str
) -> None:
    """However much it explains: a torque that may be anything explains the most."""
    nameless, clock = found("unknown", 9000.0, np.inf, 0.25), found("clock_skew", 20.0, 0.2)
    told = in_order([nameless, found("cogging", 400.0, 0.4, likely), clock])
    assert told[0].effect == first
    assert [f.gain for f in told if f.effect != first] == sorted(
        (f.gain for f in told if f.effect != first), reverse=True
    )


def test_a_flex_of_a_link_and_a_compliance_of_its_joint_are_one_cause() -> None:
    joint = Place("joint", BENCH.joint_names[0])
    compliant = found("joint_compliance", 50.0, 1.0, 0.6)
    flex = replace(found("structural_flex", 900.0, 1.0), place=Place("body", "arm"), seat=joint)
    told = shared([flex, compliant])
    assert [e.effect for e in told[0].equivalents] == ["joint_compliance"]
    assert told[0].of_class == pytest.approx(0.9)
    apart = replace(flex, seat=Place("joint", "another"))
    assert shared([apart, compliant]) == [apart, compliant]


def test_what_explains_nearly_all_is_first_whatever_its_size() -> None:
    drag, spring = found("quadratic_damping", 10_200.0, 0.23), found("joint_spring", 220.0, 0.45)
    assert in_order([spring, drag]) == (drag, spring)


def test_findings_stand_by_what_they_explain_where_none_is_of_a_usual_size_for_sure() -> None:
    clock, ripple = found("clock_skew", 8000.0, 0.2), found("cogging", 400.0, 0.4, 0.3)
    nameless = found("unknown", 100.0, np.inf)
    assert in_order([nameless, ripple, clock]) == (clock, ripple, nameless)


def test_two_forms_of_one_class_at_one_place_are_one_cause_that_is_either() -> None:
    """Dry friction that only takes two laws together acts in a form of its own."""
    friction, ripple = found("coulomb_friction", 900.0, 1.0), found("cogging", 400.0, 1.0)
    hysteresis = found("presliding_hysteresis", 900.0, 1.0, 0.8)
    told = shared([friction, ripple, hysteresis])
    assert told[1] == ripple
    for one, other in ((told[0], hysteresis), (told[2], friction)):
        assert [e.effect for e in one.equivalents] == [other.effect] and one.believed
    assert told[0].probability == told[0].equivalents[0].probability == 0.45
    assert shared(told) == told  # a rival that is told already is not told twice
    elsewhere = replace(hysteresis, place=Place("joint", "another"))
    unlike = [friction, elsewhere, found("unknown", 9.0, 1.0), found("unknown", 8.0, 1.0)]
    assert shared(unlike) == unlike


def test_of_two_forms_of_one_class_the_usual_one_is_likelier_and_first() -> None:
    """A third as likely is friction that rises at rest, however much of the two's error it has."""
    rising = found("rising_static_friction", 900.0, 1.0, 0.96)
    stribeck, ripple = found("stribeck_friction", 300.0, 1.0, 0.88), found("cogging", 400.0, 1.0)
    told = in_order(shared([rising, ripple, stribeck]))
    assert [f.effect for f in told] == ["stribeck_friction", "cogging", "rising_static_friction"]
    assert told[0].probability == pytest.approx(0.66, abs=0.01)
    assert told[0].of_class == pytest.approx(0.88) and told[2].of_class == pytest.approx(0.96)
    assert told[2].equivalents[0].probability == pytest.approx(0.72, abs=0.01)


def test_an_interval_is_as_wide_as_a_law_of_another_form_asks() -> None:
    torque = next(q for q in TERMS["coulomb_friction"].quantities if not q.shape)
    sharp = of_other_form(Parameter(0.1, "N m", 0.0999, 0.1001), torque)
    assert sharp.upper - 0.1 == pytest.approx(0.1 * OTHER_FORM, rel=1e-4)
    blunt = of_other_form(Parameter(0.1, "N m", 0.05, 0.2), torque)  # noise tells the most of it
    assert (blunt.lower, blunt.upper) == pytest.approx((0.0483, 0.2008), abs=1e-4)
    most = Parameter(torque.limit, "N m", 0.9 * torque.limit, torque.limit)
    assert of_other_form(most, torque).upper == torque.limit
    large = Parameter(20 * torque.limit, "N", 19 * torque.limit, 21 * torque.limit)
    told = of_other_form(large, torque, 200.0)  # of an axis of 600 N
    assert told.lower < large.lower < large.value < large.upper < told.upper
    shape = next(q for q in TERMS["stribeck_friction"].quantities if q.shape)
    speed = Parameter(0.1, "rad/s", 0.09, 0.11)
    assert of_other_form(speed, shape) == speed


def test_what_has_no_name_is_no_surer_than_the_first_that_is_likely() -> None:
    """What is found later, of the little that is left, may be as sure as it likes."""
    late, drag = found("actuator_lag", 900.0, 1.0, 0.6), found("quadratic_damping", 90.0, 1.0, 0.9)
    nameless = found("unknown", 5.0, np.inf, 0.8)
    assert beside(nameless, [late, drag], BENCH).probability == 0.6
    assert beside(nameless, [replace(late, probability=0.4), drag], BENCH).probability == 0.8


@pytest.mark.parametrize(("other", "after"), [("measurement_delay", 0.47), ("cogging", 0.65)])
def test_a_name_is_as_likely_as_its_class(other: str, after: float) -> None:
    """A lag that is told as late commands or as late readings is late, whatever has no name."""
    twin = Alternative(other, Place("joint", BENCH.joint_names[0]), 0.44)
    late = replace(found("command_delay", 900.0, 1.0, 0.47), equivalents=(twin,))
    assert beside(found("unknown", 5.0, np.inf, 0.65), [late], BENCH).probability == after

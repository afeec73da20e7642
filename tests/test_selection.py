"""Which effects are exchanged, refitted and looked at again, on models made up of whole cloth."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest

from pup.diagnosis import exchanges, retracing, selection
from pup.diagnosis.coordinates import term_coordinate
from pup.diagnosis.evidence import Projector, Trace
from pup.diagnosis.exchanges import Exchanger
from pup.diagnosis.fit import Fit
from pup.diagnosis.hypotheses import Hypothesis, hypotheses
from pup.diagnosis.models import Model, Round
from pup.diagnosis.residuals import LOST
from pup.diagnosis.shortlist import FINALISTS, FURTHER, shortlist
from pup.diagnosis.starts import Tried
from pup.diagnosis.verdict import probabilities
from pup.physics.terms import Place
from pup.robot import RobotDescription
from tests.diagnoses import ENOUGH, Maker

MAKER = Maker(RobotDescription.load("darwin_leg"))
FIRST, RIVAL, OTHER, LAST = (
    next(h for h in hypotheses(MAKER.measured) if h.effect == effect)
    for effect in ("coulomb_friction", "quadratic_damping", "armature", "command_delay")
)
SOFT = Hypothesis("ground_compliance", Place("ground"), FIRST.scale)
Worths = Mapping[tuple[Hypothesis, ...], float]


def nothing(*asked: object, **more: object) -> None:
    """Fits stay where they are."""


def made(known: Sequence[Hypothesis], worth: float) -> Model:
    """A model of some worth, all of it chi-squared, in and out of sample."""
    model = MAKER.model(known[-1] if known else None, 1.0)
    fit = replace(model.fit, chi2=worth)
    return replace(model, hypotheses=tuple(known), freedom=0, fit=fit, held_out=np.array([worth]))


class Made(Exchanger):
    """A selector that simulates nothing: what each set of effects is worth is given."""

    def __init__(self, worths: Worths, unfit: Sequence[Hypothesis] = ()) -> None:
        self.replays: Any = SimpleNamespace(measured=MAKER.measured)
        self.noise, self.enough = MAKER.noise, ENOUGH
        self.worths, self.unfit = worths, unfit
        self.nominal = made((), 1000.0)
        self.traces: Any = SimpleNamespace(around=nothing)

    def models(self, fitted: Sequence[Tried]) -> list[Model]:
        return [made(known, self.worths[known]) for known, _ in fitted]

    def without(self, model: Model) -> list[Any]:
        return [None] * len(model.hypotheses)

    def holds(self, before: Model, after: Model) -> bool:
        return after.hypotheses[-1] not in self.unfit

    def _exchanges(self, model: Model, rounds: Sequence[Round]) -> list[tuple[int, Tried]]:
        """With fits as good as their models."""
        ways = super()._exchanges(model, rounds)
        return [(n, (known, replace(fit, chi2=self.worths[known]))) for n, (known, fit) in ways]


@pytest.fixture(autouse=True)
def still(monkeypatch: pytest.MonkeyPatch) -> None:
    for room in (exchanges, selection):
        for name in ("fit_together", "closely"):
            monkeypatch.setattr(room, name, nothing)
    monkeypatch.setattr(exchanges, "start_best", nothing)


def chosen(before: Model, *finalists: Model) -> Round:
    return Round(before, (), finalists, len(finalists))


class TestSwaps:
    """Of the first of two effects, whose rivals explain more with the second."""

    found = made((FIRST, LAST), 400.0)
    rounds = (
        chosen(
            made((), 1000.0), made((FIRST,), 700.0), made((RIVAL,), 705.0), made((OTHER,), 710.0)
        ),
        chosen(made((FIRST,), 700.0), found),
    )
    worths: ClassVar[Worths] = {(LAST, RIVAL): 300.0, (LAST, OTHER): 350.0, (LAST,): 900.0}

    def test_a_better_rival_takes_the_place_of_an_effect(self) -> None:
        swap = Made(self.worths)._swap(self.found, self.rounds)
        assert swap is not None
        assert [m.hypotheses[-1] for m in swap.finalists] == [RIVAL, OTHER, FIRST]
        assert swap.holding == 3

    def test_a_rival_that_does_not_hold_takes_none(self) -> None:
        swap = Made(self.worths, [RIVAL])._swap(self.found, self.rounds)
        assert swap is not None
        assert [m.hypotheses[-1] for m in swap.finalists] == [OTHER, FIRST, RIVAL]
        assert swap.holding == 2
        assert Made(self.worths, [RIVAL, OTHER])._swap(self.found, self.rounds) is None

    def test_a_rival_of_the_last_one_that_does_not_hold_hinders_none(self) -> None:
        unsettled = chosen(self.found, made((FIRST, OTHER), 390.0))
        rounds = (self.rounds[0], replace(unsettled, before=made((FIRST,), 700.0)))
        worths = self.worths | {(FIRST, OTHER): 299.0}
        swap = Made(worths, [OTHER])._swap(self.found, rounds)
        assert swap is not None
        assert swap.finalists[0].hypotheses == (LAST, RIVAL)

    def test_of_those_behind_only_what_holds_is_a_rival(self) -> None:
        swap = Made(self.worths, [OTHER])._swap(self.found, self.rounds)
        assert swap is not None
        assert [m.hypotheses[-1] for m in swap.finalists] == [RIVAL, FIRST, OTHER]
        assert swap.holding == 2


class TestSettled:
    """The first of two effects, compared with its rivals once more beside the second."""

    found = made((FIRST, LAST), 400.0)
    rounds = (
        chosen(made((), 1000.0), made((FIRST,), 700.0), made((RIVAL,), 702.0)),
        chosen(made((FIRST,), 700.0), found),
    )

    def test_a_rival_that_explains_less_by_now_is_one_no_more(self) -> None:
        """What others left had blurred them; the round says how they compare now."""
        selector = Made({(LAST, RIVAL): 480.0, (LAST,): 900.0})
        model, rounds = selector.settled(self.found, self.rounds)
        assert model is self.found
        assert len(rounds) == 3
        assert rounds[2].again and rounds[2].before.hypotheses == (LAST,)
        assert [m.hypotheses[-1] for m in rounds[2].finalists] == [FIRST, RIVAL]
        then = probabilities(self.rounds[0].finalists, self.rounds[0].before, MAKER.noise)
        now = probabilities(rounds[2].finalists, rounds[2].before, MAKER.noise)
        assert then[1] > 0.4 and now[1] < 0.05

    def test_one_that_is_worth_more_takes_its_place(self) -> None:
        """By however little: nothing speaks for the one that was first."""
        selector = Made({(LAST, RIVAL): 399.0, (LAST,): 900.0})
        model, rounds = selector.settled(self.found, self.rounds)
        assert model.hypotheses == (LAST, RIVAL)
        assert [m.hypotheses[-1] for m in rounds[2].finalists] == [RIVAL, FIRST]

    def test_forms_of_its_class_are_compared_however_far_behind_they_were(self) -> None:
        """A drag that hides had made friction that rises at rest of dry friction."""
        form = replace(FIRST, effect="presliding_hysteresis")
        assert form.sibling_of(FIRST) and not RIVAL.sibling_of(FIRST)
        far = (made((FIRST,), 700.0), made((form,), 950.0), made((RIVAL,), 950.0))
        rounds = (chosen(made((), 1000.0), *far), self.rounds[1])
        selector = Made({(LAST, form): 380.0, (LAST, RIVAL): 300.0, (LAST,): 900.0})
        model, told = selector.settled(self.found, rounds)
        assert model.hypotheses == (LAST, form)
        assert [m.hypotheses[-1] for m in told[2].finalists] == [form, FIRST]

    def test_what_was_found_beside_all_others_is_not_compared_again(self) -> None:
        model = made((LAST,), 400.0)
        rounds = [chosen(made((), 1000.0), model, made((RIVAL,), 402.0))]
        assert Made({}).settled(model, rounds) == (model, rounds)


class TestTheLast:
    """Of an effect that was found last, or alone, whose rivals are weighed by another noise."""

    found = made((FIRST,), 700.0)
    worths: ClassVar[Worths] = {(RIVAL,): 690.0, (OTHER,): 710.0}

    def test_it_is_exchanged_where_a_rival_is_worth_more_by_now(self) -> None:
        rounds = [chosen(made((), 1000.0), self.found, made((RIVAL,), 695.0))]
        selector = Made(self.worths)
        swap = selector._swap(self.found, rounds)
        assert swap is not None
        assert [m.hypotheses for m in swap.finalists] == [(RIVAL,), (FIRST,)]
        assert swap.before is selector.nominal

    def test_it_stays_where_it_is_still_the_best(self) -> None:
        rounds = [chosen(made((), 1000.0), self.found, made((OTHER,), 705.0))]
        assert Made(self.worths)._swap(self.found, rounds) is None
        assert Made({(OTHER,): 0.0})._swap(self.found, rounds) is None


def test_two_forms_of_one_class_do_not_make_each_other_needless() -> None:
    """What each is worth is seen without the other, which would make up for it."""
    place = next(h.place for h in hypotheses(MAKER.measured) if h.effect == "coulomb_friction")
    dry, other = (
        next(h for h in hypotheses(MAKER.measured) if h.effect == effect and h.place == place)
        for effect in ("coulomb_friction", "presliding_hysteresis")
    )
    model = MAKER.model(LAST, 1.0)
    fit = replace(model.fit, chi2=100.0)
    selector = Made({})
    both = replace(model, hypotheses=(dry, other), fit=fit)
    assert all(fit is selector.nominal.fit for fit in selector.without_class(both))
    three = replace(model, hypotheses=(dry, LAST, other), fit=fit)
    alone = [replace(fit, chi2=worth) for worth in (110.0, 900.0, 120.0)]

    class Apart(Made):
        def without(self, model: Model) -> list[Any]:
            return alone

    first, last, second = Apart({}).without_class(three)
    assert last is alone[1]
    assert first is second and all(first is not fit for fit in alone)


def test_places_that_hold_all_joints_are_told_once() -> None:
    """A group of all joints is the robot, or its bus, where an effect can be there."""
    measured = replace(MAKER.measured, robot=one_group(MAKER.robot))
    places = {h.key for h in hypotheses(measured)}
    assert ("coulomb_friction", Place("robot")) in places
    assert ("coulomb_friction", Place("group", "leg")) not in places
    assert ("coulomb_friction", Place("group", "knee")) not in places


def one_group(robot: RobotDescription) -> RobotDescription:
    joints = tuple(replace(joint, group="leg") for joint in robot.joints)
    return replace(robot, joints=joints, groups=("leg",))


def test_an_effect_that_was_given_up_is_looked_at_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where there are more hypotheses than are simulated again around each model."""
    for name in ("LEADING", "MOST"):
        monkeypatch.setattr(retracing, name, 3)

    def traces(asked: Sequence[Hypothesis], fit: Fit, *more: object) -> list[Trace]:
        return [MAKER.trace(h, Projector(fit.slopes)) for h in asked]

    monkeypatch.setattr(retracing, "traces", traces)
    nominal, with_first, with_rival = (
        MAKER.model(known, error) for known, error in ((None, 3.0), (FIRST, 2.0), (RIVAL, 1.0))
    )
    found = traces(hypotheses(MAKER.measured), nominal.fit)
    retracer = retracing.Retracer(Made({}).replays, MAKER.noise, found, nominal.fit)
    assert FIRST.key not in {t.hypothesis.key for t in retracer.around(with_first)}
    assert FIRST.key in {t.hypothesis.key for t in retracer.around(with_rival)}


def test_a_fold_that_diverged_is_as_far_off_wherever_it_is() -> None:
    selector = Made({})
    selector.folds = [[0], [1, 2]]
    selector.replays.together = lambda asked: [
        np.full((1, MAKER.measured.only(fold).sum()), np.nan) for _, fold in asked
    ]
    told = selector.predicting(replace(MAKER.model(FIRST, 1.0), predicted=np.empty(0)))
    assert told.predicted - MAKER.measured.values == pytest.approx(LOST)


def test_rivals_of_other_classes_are_compared_as_closely_as_the_best(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """However many forms of the best one stand between them."""
    ended: list[Fit] = []
    monkeypatch.setattr(selection, "closely", lambda fits, *more: ended.extend(fits))
    monkeypatch.setattr(selection, "begun_anew", nothing)
    known = [FIRST] * 6 + [RIVAL, OTHER, LAST]
    fits = [replace(MAKER.model(h, 1.0).fit, chi2=5000.0 + i) for i, h in enumerate(known)]
    fits[-1].chi2 = 6000.0
    Made({})._refit([((h,), fit) for h, fit in zip(known, fits, strict=True)], 9000.0)
    assert [fit.chi2 for fit in ended] == [fit.chi2 for fit in fits[:-1]]


@pytest.mark.parametrize(
    ("known", "left", "begun"),
    [(SOFT, 1.05, False), (SOFT, 5.0, True), (FIRST, 1.05, True), (None, 0.9, True)],
)
def test_no_round_begins_where_the_form_of_what_was_found_may_leave_all_that_is_left(
    monkeypatch: pytest.MonkeyPatch, known: Hypothesis | None, left: float, begun: bool
) -> None:
    """A soft floor at another time step leaves a tenth of its trace, in which anything is seen."""
    asked: list[object] = []
    monkeypatch.setattr(selection, "scores", lambda *told: asked.append(told) or [])
    monkeypatch.setattr(selection, "unimitated", nothing)
    samples = MAKER.samples

    def off(by: float, *told: Hypothesis) -> Model:
        model = made((FIRST,), by * samples)
        fit = replace(model.fit, residual=np.full(samples, np.sqrt(by)))
        return replace(model, hypotheses=told, fit=fit)

    selector = Made({})
    standing = SimpleNamespace(grounded=np.ones(samples, bool), channel=MAKER.measured.channel)
    selector.replays, selector.nominal = SimpleNamespace(measured=standing), off(40.0)
    assert selector._round(off(left, *([known] if known else []))) is None
    assert bool(asked) is begun


@pytest.mark.parametrize("followed", [False, True])
def test_a_motion_that_is_lost_hides_nothing_in_others(followed: bool) -> None:
    """Half a radian off, even a form's small share of it is more than a second effect explains."""
    lost = np.arange(MAKER.samples) < MAKER.samples // 10

    def off(there: float, elsewhere: float) -> Model:
        model = made((FIRST,), 1.0)
        return replace(model, fit=replace(model.fit, residual=np.where(lost, there, elsewhere)))

    selector = Made({})
    selector.nominal, selector.followed = off(250.0, 3.0), ~lost if followed else None
    assert selector._beyond_forms(off(5.0, 1.2), off(5.0, 1.0)) is followed
    assert not selector._beyond_forms(off(5.0, 1.2), off(4.9, 1.2))


@pytest.mark.parametrize(
    ("known", "left", "told"),
    [(FIRST, 1.05, True), (FIRST, 1.2, False), (SOFT, 1.05, False)],
)
def test_an_effect_that_explains_nearly_all_that_is_left_is_no_wrong_form(
    known: Hypothesis, left: float, told: bool
) -> None:
    """Beside a limit of the rate that explains 1,600 times as much; but all of contact is rough."""

    def off(by: float, *effects: Hypothesis) -> Model:
        model = made((FIRST,), by * MAKER.samples)
        fit = replace(model.fit, residual=np.full(MAKER.samples, np.sqrt(by)))
        return replace(model, hypotheses=effects, fit=fit)

    selector = Made({})
    selector.nominal, selector.followed = off(2000.0), None
    before, after = off(1.4, known), off(left, known, LAST)
    assert not selector._beyond_forms(before, after)
    assert selector._completes(before, after) is told


@pytest.mark.parametrize(("left", "looked"), [(50.0, True), (5.0, False)])
def test_where_all_that_was_tried_leaves_many_times_the_noise_more_are_tried(
    monkeypatch: pytest.MonkeyPatch, left: float, looked: bool
) -> None:
    """So far off slopes say little: the ninth of a ranking was the one that fitted."""
    every = {h.key: h for h in hypotheses(MAKER.measured) if h.place == FIRST.place}
    ranking: list[Any] = [
        SimpleNamespace(surprise=1000.0 - i, trace=SimpleNamespace(hypothesis=h))
        for i, h in enumerate(every.values())
    ]
    assert len(ranking) > FINALISTS + 4
    fit = replace(MAKER.model(None, 1.0).fit, chi2=left * MAKER.samples)

    def begun(self: Made, model: Model, chosen: Sequence[Any]) -> list[Any]:
        return [((score.trace.hypothesis,), fit) for score in chosen]

    monkeypatch.setattr(Made, "_begun", begun)
    monkeypatch.setattr(Made, "_refit", nothing)
    selector, model = Made({}), made((), 90.0 * MAKER.samples)
    tried = begun(selector, model, shortlist(ranking, ENOUGH))
    more = [known[-1] for known, _ in selector._further(model, ranking, tried)]
    first = {known[-1] for known, _ in tried}
    rest = [s.trace.hypothesis for s in ranking[:FURTHER] if s.trace.hypothesis not in first]
    assert set(more) == (set(rest) if looked else set())


def ended_at(known: Hypothesis, name: str, value: float) -> tuple[Model, Model]:
    """A model of an effect whose fit has come to some value of a column, after one without it."""
    coordinate, bare = term_coordinate(name, MAKER.scale), MAKER.model(None, 3.0)
    found = MAKER.model(known, 1.0)
    at = np.r_[found.fit.at, coordinate.coordinate(value)]
    fit = replace(found.fit, coordinates=(*found.fit.coordinates, coordinate), at=at)
    return bare, replace(found, fit=fit)


@pytest.mark.parametrize(("seconds", "told"), [(0.02, False), (0.1, True), (3.0, False)])
def test_a_law_that_ends_where_it_does_as_another_is_not_that_law(
    seconds: float, told: bool
) -> None:
    """Friction that has risen at once is lower the faster, no more: Stribeck's, in another form."""
    base = next(h for h in hypotheses(MAKER.measured) if h.effect == "rising_static_friction")
    selector = Made({})
    selector.followed = None
    assert Exchanger.holds(selector, *ended_at(base, base.telling[0], seconds)) is told


@pytest.mark.parametrize(("share", "told"), [(0.1, False), (0.5, True)])
def test_what_gives_way_as_a_spring_does_is_no_stop(share: float, told: bool) -> None:
    base = next(h for h in hypotheses(MAKER.measured) if h.effect == "joint_stop")
    selector = Made({})
    selector.followed = None
    models = ended_at(base, base.magnitudes[0], share * base.typical[0])
    assert Exchanger.holds(selector, *models) is told

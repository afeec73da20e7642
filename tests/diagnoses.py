"""Diagnoses made up of whole cloth: every part is of the right shape, none was simulated."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pup.diagnosis.coordinates import nominal_coordinate, term_coordinate
from pup.diagnosis.discover import Unexplained
from pup.diagnosis.evidence import Projector, Trace, scores
from pup.diagnosis.fit import Fit
from pup.diagnosis.held_out import held_out
from pup.diagnosis.hypotheses import Hypothesis, hypotheses
from pup.diagnosis.impulses import WRENCH_NAMES
from pup.diagnosis.lacks import Lack
from pup.diagnosis.lawfit import Law
from pup.diagnosis.locate import MissingInput
from pup.diagnosis.models import Model, Round
from pup.diagnosis.nominal import Certificate, Nominal, free_names
from pup.diagnosis.regimes import Regime, Window
from pup.diagnosis.residuals import Measured, Noise
from pup.diagnosis.result import Diagnosis
from pup.diagnosis.splits import Ratio, Split
from pup.diagnosis.verdict import Alternative, Finding, Parameter
from pup.physics.parameters import robot_space
from pup.physics.terms import TERMS, Place
from pup.physics.terms.learned import LearnedLaw, unit
from pup.physics.terms.scale import Scale
from pup.recording import Recording
from pup.robot import RobotDescription, TermSpec

MOTIONS = ("step", "chirp", "hold")
SIGMA = 0.002
ENOUGH = 15.0


def recordings(robot: RobotDescription, ticks: int, motions: Sequence[str]) -> list[Recording]:
    """Sines on all joints, followed with noise; one recording of each motion."""
    rng = np.random.default_rng(1)
    support = "suspended" if robot.floating else "bench"
    time = 0.033 * np.arange(ticks)
    target = np.repeat(0.3 * np.sin(time)[:, None], len(robot.joints), axis=1)
    return [
        Recording(
            id=f"{motion}_{i}",
            robot=robot.name,
            motion=motion,
            support=support,
            source="simulation",
            joints=robot.joint_names,
            time=time,
            target=target,
            position=target + SIGMA * rng.normal(size=target.shape),
        )
        for i, motion in enumerate(motions)
    ]


def split(group: str, first: str, second: str, chance: float = 1e-9, **values: float) -> Split:
    """Parameters of two halves, known to 5 %; simulations gain what their difference promises."""
    ratios = tuple(
        Ratio(name, value, value / 1.05, value * 1.05, float(np.log(value) / 0.03))
        for name, value in values.items()
    )
    wald = float(sum(r.surprise**2 for r in ratios))
    return Split(group, first, second, ratios, wald, chance, wald, wald)


class Maker:
    """Makes diagnoses of one robot.

    Args:
      robot: the robot.
      ticks: of each recording.
      motions: of the recordings.
      most: hypotheses.
    """

    def __init__(
        self,
        robot: RobotDescription,
        ticks: int = 120,
        motions: Sequence[str] = MOTIONS,
        most: int = 60,
    ) -> None:
        self.robot = robot
        self.rng = np.random.default_rng(2)
        self.measured = Measured.of(robot, recordings(robot, ticks, motions))
        self.space = robot_space(robot, "pd")
        self.samples = len(self.measured.values)
        self.scale = Scale.of(robot)
        self.noise = Noise(
            np.full(self.measured.channels, SIGMA), np.zeros(self.measured.channels), "repeats"
        )
        self.most = most

    def fit(self, hypothesis: Hypothesis | None, error: float) -> Fit:
        """A fit with errors of some size, in units of the noise."""
        names = free_names(self.space, False)
        coordinates = [nominal_coordinate(self.space, name) for name in names]
        nominal = [self.space.nominal[self.space.names.index(name)] for name in names]
        at = [c.coordinate(v) for c, v in zip(coordinates, nominal, strict=True)]
        if hypothesis is None:
            at[1] += 0.27  # kd hides what is missing
        else:
            coordinates += [term_coordinate(n, self.scale) for n in hypothesis.magnitudes]
            at += [1.0] * len(hypothesis.magnitudes)
        residual = error * self.rng.normal(size=self.samples)
        return Fit(
            tuple(coordinates),
            np.array(at),
            fixed=dict(hypothesis.shape) if hypothesis else {},
            residual=residual,
            jacobian=self.rng.normal(size=(self.samples, len(at))),
            chi2=float(residual @ residual),
        )

    def model(self, hypothesis: Hypothesis | None, error: float) -> Model:
        """A fitted model whose predictions are off by as much."""
        off = self.rng.normal(size=self.samples)
        off *= error * SIGMA / np.sqrt(np.mean(off**2))
        folds = np.full(3, error**2 * self.samples / 3)
        known = () if hypothesis is None else (hypothesis,)
        fit = self.fit(hypothesis, error)
        return Model(known, len(known), fit, folds, self.measured, self.measured.values - off)

    def trace(self, hypothesis: Hypothesis, project: Projector) -> Trace:
        """Something that a hypothesis may have left in the samples."""
        whole = self.rng.normal(size=(self.samples, len(hypothesis.magnitudes)))
        left = project(whole)
        return Trace(hypothesis, whole, left, np.linalg.qr(left)[0])

    def nothing(self, error: float = 1.0) -> Diagnosis:
        """That nothing is missing; errors of the model in units of the noise."""
        model = self.model(None, error)
        assert model.fit.jacobian is not None
        project = Projector(model.fit.jacobian)
        tried = hypotheses(self.measured)
        chosen = tried[:: max(1, len(tried) // self.most)][: self.most]
        inside = self.measured.time > np.median(self.measured.time)
        return Diagnosis(
            robot=self.robot,
            verdict="none",
            reason="",
            measured=self.measured,
            nominal=Nominal(model.fit, self.noise, Certificate((1.0, 1.1, 5.0), True, 0.4)),
            findings=(),
            held_out=held_out(self.measured, model, model, 0),
            model=model,
            rounds=(),
            found=tuple(self.trace(h, project) for h in chosen),
            enough=ENOUGH,
            regimes=(Regime("at reversals", inside), Regime("at rest", ~inside)),
            replays=321,
        )

    def missing(self, effect: str, place: Place, **more: float) -> Diagnosis:
        """That one effect is missing, in its typical size where no other is given."""
        base = self.nothing(3.0)
        before = base.model
        assert before is not None and before.fit.jacobian is not None
        shape = tuple(
            (f"{effect}/{q.name}@{place}", more.get(q.name, q.typical))
            for q in TERMS[effect].quantities
            if q.shape
        )
        hypothesis = Hypothesis(effect, place, self.scale, shape)
        rest = [t for t in base.found if t.hypothesis.key != hypothesis.key]
        traces = (self.trace(hypothesis, Projector(before.fit.jacobian)), *rest)
        strong = before.fit.residual + 30 * traces[0].left[:, 0] / np.linalg.norm(traces[0].left)
        after = self.model(hypothesis, 1.0)
        rival = self.model(rest[0].hypothesis, 2.0)
        ranking = scores(traces, strong)
        first = Round(before, tuple(ranking), (after, rival), 2)
        return replace(
            base,
            verdict="mismatch",
            findings=(self.finding(hypothesis, more, rest[0].hypothesis),),
            held_out=held_out(self.measured, before, after, 0),
            before=before,
            model=after,
            rounds=(first,),
            found=traces,
        )

    def finding(
        self, hypothesis: Hypothesis, sizes: Mapping[str, float], other: Hypothesis
    ) -> Finding:
        """What is told of an effect."""
        first = self.measured.recordings[0].id
        return Finding(
            effect=hypothesis.effect,
            place=hypothesis.place,
            regime="at reversals",
            when=(Window(first, 0.5, 1.5), Window(first, 2.0, 2.5)),
            parameters={
                q.name: Parameter(value, q.unit, 0.9 * value, 1.1 * value)
                for q, typical in zip(
                    TERMS[hypothesis.effect].magnitudes(), hypothesis.typical, strict=True
                )
                for value in [sizes.get(q.name, typical)]
            },
            probability=0.9,
            equivalents=(Alternative(other.effect, other.place, 0.07),),
            absorbed_by={f"kd/{self.robot.joints[0].group}": 0.31},
            law="tau -= x",
            gain=100.0,
        )

    def located(self, strengths: Mapping[str, float]) -> MissingInput:
        """Torques of some strength at some channels, with evidence in its proportion.

        Each is strongest in the second recording, half a second before its end.
        """
        channels = (*self.robot.joint_names, *WRENCH_NAMES)
        joints = len(self.robot.joints)
        strength = np.array([strengths.get(name, 0.0) for name in channels])
        time = [np.arange(0.0, r.time[-1], 0.04) for r in self.measured.recordings]
        mean = [0.1 * strength * np.sin(3 * t)[:, None] for t in time]
        mean[1][np.abs(time[1] - time[1][-1] + 0.5) < 0.1] = 2 * strength
        deviation = [np.repeat(0.1 * strength[None], len(t), axis=0) for t in time]
        return MissingInput(
            channels,
            ("N m",) * joints + ("N",) * 3 + ("N m",) * 3,
            strength,
            500 * strength,
            1.0,
            tuple(time),
            tuple(mean),
            tuple(deviation),
            np.zeros(self.samples),
        )

    def beyond(self, base: Diagnosis, place: Place, law: Law | None) -> Diagnosis:
        """That something is left which no effect explains, with a law for it or without."""
        assert base.model is not None
        first = self.measured.recordings[0].id
        channel = 0
        if place.kind == "joint":
            channel = self.robot.joint_names.index(place.name)
        missing = self.located({self.robot.joint_names[channel]: 0.2})
        model, sizes = base.model, {}
        if law is not None:
            fit = law.started(model.fit, place)
            fit.residual, fit.chi2 = model.fit.residual, model.fit.chi2 / 2
            fit.jacobian = self.rng.normal(size=(self.samples, len(fit.at)))
            model = replace(model, fit=fit)
            sizes = dict(zip(law.features, law.coefficients, strict=True))
        finding = Finding(
            effect="unknown",
            place=place,
            regime="throughout",
            when=(Window(first, 0.5, 1.5),),
            parameters={n: Parameter(v, unit(n), v - 0.01, v + 0.01) for n, v in sizes.items()},
            probability=0.97,
            equivalents=(),
            absorbed_by={},
            law=str(law) if law else None,
            gain=model.fit.chi2,  # a law halves chi-squared
        )
        promising = "tau += 0.031 N m s/rad v"
        left = Unexplained(
            finding,
            missing,
            (Lack(channel, 3.0, 12.0, 2.25, 8.0, 1.21), Lack(channel, 0.2, 1.0, None, 0.0, 0.0)),
            (str(law), promising) if law else (promising,),
            model,
            (TermSpec(LearnedLaw.effect, place.kind, place.name, sizes),) if law else (),
        )
        return replace(
            base,
            verdict="mismatch",
            findings=(*base.findings, finding),
            held_out=held_out(self.measured, base.model, model, 0),
            model=model,
            missing=missing,
            unexplained=left,
        )

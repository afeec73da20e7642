"""What each hypothesis changes in the samples, with as few simulations as can tell it.

A hypothesis is simulated once, at a moderate size; of a single joint in the air, where simulations
cost little, at a small one too. While the torso is fixed, joints are simulated one by one, limbs
sharing simulations, and what several joints change together is the sum of what each does. On the
ground everything moves everything and a simulation costs five times as much: there joints are first
simulated together, and one by one only where they look, together, like the errors.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.evidence import Projector, Trace, scores, traced
from pup.diagnosis.fit import Fit
from pup.diagnosis.hypotheses import Hypothesis
from pup.diagnosis.probing import changes
from pup.diagnosis.replays import Replays
from pup.diagnosis.residuals import Noise
from pup.physics.terms import Place
from pup.robot import RobotDescription

Array = NDArray[np.float64]

PROMISING = 12
"""Effects at several joints each, whatever their forms, whose joints are simulated one by one on
the ground too."""
SMALL = 0.1
"""Share of the moderate size at which hypotheses of a single joint are looked at again: where a
motion hangs by a hair, what much of an effect changes says nothing of what little of it does."""
AT_ONCE = 300
"""Hypotheses that are simulated at once: enough for all cores, few enough for the memory."""


def traces(
    hypotheses: Sequence[Hypothesis],
    base: Fit,
    replays: Replays,
    noise: Noise,
) -> list[Trace]:
    """Simulate hypotheses around a fit.

    The trace of a single joint that does not look promising on the ground has nothing there.

    Args:
      hypotheses: what to simulate.
      base: a fit with its Jacobian.
      replays: simulates.
      noise: weighs the samples.
    """
    assert base.residual is not None
    recordings = replays.measured.recordings
    ground = [i for i, r in enumerate(recordings) if r.support == "ground"]
    fixed = [i for i in range(len(recordings)) if i not in ground]
    together = _together(hypotheses, replays.measured.robot)
    members = {h for several in together.values() for h in several}
    project = Projector(base.slopes)

    def simulated(
        some: Iterable[Hypothesis], where: Sequence[int]
    ) -> Iterator[tuple[Hypothesis, Array]]:
        return _simulated(list(some), where, base, replays, noise)

    wholes = dict(simulated((h for h in hypotheses if h not in together), fixed))
    wholes |= {h: np.sum([wholes[m] for m in several], axis=0) for h, several in together.items()}
    if ground:
        for h, whole in simulated((h for h in hypotheses if h not in members), ground):
            wholes[h] += whole
        seen = (traced(h, wholes[h], project) for h in together)
        ranking = scores([t for t in seen if t is not None], base.residual)
        leading = list(dict.fromkeys(s.trace.hypothesis.key for s in ranking))[:PROMISING]
        close = dict.fromkeys(m for h in together if h.key in leading for m in together[h])
        for h, whole in simulated(close, ground):
            wholes[h] += whole
    told = [traced(h, wholes[h], project) for h in hypotheses]
    if len(replays.measured.robot.joints) == 1 and not ground:
        small = dict(_simulated(hypotheses, fixed, base, replays, noise, SMALL))
        again = [traced(h, small[h], project) for h in hypotheses]
        told = [_likelier(pair, base.residual) for pair in zip(told, again, strict=True)]
    return [trace for trace in told if trace is not None]


def _likelier(told: Iterable[Trace | None], residual: Array) -> Trace | None:
    """The one of some traces of a hypothesis that looks most like the errors."""
    seen = [trace for trace in told if trace is not None]
    return scores(seen, residual)[0].trace if seen else None


def by_rank(
    hypotheses: Sequence[Hypothesis],
    rank: Mapping[tuple[str, Place], int],
    robot: RobotDescription,
) -> list[Hypothesis]:
    """Some hypotheses in the order of what they claim.

    A joint that has no rank, as it was not simulated alone (see `traces`), has that of the first of
    the groups that it belongs to.

    Args:
      hypotheses: some.
      rank: by what is claimed, the least first.
      robot: theirs.
    """

    def order(hypothesis: Hypothesis) -> int:
        if hypothesis.key in rank or hypothesis.place.kind != "joint":
            return rank.get(hypothesis.key, len(hypotheses))
        joints = set(hypothesis.place.joints(robot))
        told = (
            number
            for (effect, place), number in rank.items()
            if effect == hypothesis.effect and joints < set(place.joints(robot))
        )
        return min(told, default=len(hypotheses))

    return sorted(hypotheses, key=order)


def _simulated(
    hypotheses: Sequence[Hypothesis],
    recordings: Sequence[int],
    base: Fit,
    replays: Replays,
    noise: Noise,
    share: float = 1.0,
) -> Iterator[tuple[Hypothesis, Array]]:
    """Whitened changes of some recordings' samples per typical size, (n_samples, n_magnitudes)."""
    for first in range(0, len(hypotheses), AT_ONCE):
        some = hypotheses[first : first + AT_ONCE]
        probes = [probe for h in some for probe in h.probes(share)]
        changed = changes([(base.row(), probes, probes)], replays, recordings)[0]
        white = replays.measured.whiten(changed, noise)
        ends = np.cumsum([0, *(len(h.magnitudes) for h in some)])
        for h, a, b in zip(some, ends[:-1], ends[1:], strict=True):
            yield h, white[a:b].T / (share * h.moderate)


def _together(
    hypotheses: Sequence[Hypothesis], robot: RobotDescription
) -> Mapping[Hypothesis, list[Hypothesis]]:
    """Hypotheses of several joints, each with those of its joints alone."""
    at_joints = {(h.effect, h.place.name, h.form): h for h in hypotheses if h.place.kind == "joint"}
    told: dict[Hypothesis, list[Hypothesis]] = {}
    for hypothesis in hypotheses:
        members = [
            at_joints.get((hypothesis.effect, robot.joint_names[i], hypothesis.form))
            for i in hypothesis.place.joints(robot)
        ]
        known = [m for m in members if m is not None]
        if hypothesis.place.kind != "joint" and members and len(known) == len(members):
            told[hypothesis] = known
    return told

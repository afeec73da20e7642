"""Many small changes simulated at once, where they cannot meet.

On a fixed torso limbs move apart from each other: a change at one limb leaves all others alone, but
for rounding. Changes at different limbs then share a simulation, and each is read from its own
limb's joints. On the ground everything moves everything, and each change has its own; so it has
where limbs share a supply that sags.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.replays import Replays, Row
from pup.physics.model import compile_model
from pup.physics.terms import Place, split_column
from pup.recording import Recording
from pup.robot import RobotDescription

Array = NDArray[np.float64]

COUPLING = frozenset(("voltage_sag",))
"""Effects by which limbs feel each other on a fixed torso too."""


Asked = tuple[Row, Sequence[Row], Sequence[Row]]
"""Where some probes start, the columns that each sets in the air, and those on the ground."""


def changes(
    asked: Sequence[Asked],
    replays: Replays,
    recordings: Sequence[int] | None = None,
    coarse: bool = True,
) -> list[Array]:
    """What probes change in the samples; see `probed`. In the air in longer sub-steps."""
    return [changed for _, changed in probed(asked, replays, recordings, coarse)]


def probed(
    asked: Sequence[Asked],
    replays: Replays,
    recordings: Sequence[int] | None = None,
    coarse: bool = False,
) -> list[tuple[Array, Array]]:
    """Simulations of some rows, and what probes change in them, all in one replay.

    Args:
      asked: some probes, as many in the air as on the ground.
      replays: simulates.
      recordings: simulate these only, and leave the others' samples at zero.
      coarse: whether sub-steps may be longer, where only changes are asked for.

    Returns:
      For each of them its samples, shape (n_samples,), and the changes, shape (n_probes,
      n_samples), rad.
    """
    measured = replays.measured
    every = range(len(measured.recordings)) if recordings is None else recordings
    ground = [i for i in every if measured.recordings[i].support == "ground"]
    fixed = [i for i in every if i not in ground]
    apart = limbs_of(measured.robot, measured.recordings)
    limbs = [
        np.zeros_like(apart) if coupled([*replays.space.names, *here]) else apart
        for here, _, _ in asked
    ]
    packs = [
        _packs(probes, measured.robot, own) if fixed else []
        for (_, probes, _), own in zip(asked, limbs, strict=True)
    ]
    calls: list[tuple[list[Row], list[int]]] = []
    if fixed:
        rows = [
            row
            for (here, probes, _), packed in zip(asked, packs, strict=True)
            for row in (here, *(_merged(here, probes, pack) for pack in packed))
        ]
        calls.append((rows, fixed))
    if ground:
        calls.append(
            ([r for here, _, p in asked for r in (here, *({**here, **q} for q in p))], ground)
        )
    answers = iter(replays.together(calls, coarse))
    n = len(measured.values)
    out = [(np.zeros(n), np.zeros((len(probes), n))) for _, probes, _ in asked]
    if fixed:
        told = next(answers)
        inside = measured.only(fixed)
        for (_, probes, _), own, packed, (base, changed) in zip(
            asked, limbs, packs, out, strict=True
        ):
            limb = own[measured.channel[inside]]
            base[inside], told = told[0], told[1:]
            for pack in packed:
                change, told = told[0] - base[inside], told[1:]
                for i in pack:
                    mine = np.isin(limb, list(_reach(probes[i], measured.robot, own)))
                    changed[i, inside] = np.where(mine, change, 0.0)
    if ground:
        told = next(answers)
        inside = measured.only(ground)
        for (_, _, probes), (base, changed) in zip(asked, out, strict=True):
            base[inside] = told[0]
            changed[:, inside] = told[1 : 1 + len(probes)] - told[0]
            told = told[1 + len(probes) :]
    return out


def _merged(here: Row, probes: Sequence[Row], pack: Sequence[int]) -> Row:
    return {**here, **{name: value for i in pack for name, value in probes[i].items()}}


def coupled(columns: Iterable[str]) -> bool:
    """Whether one of some columns puts an effect in by which limbs feel each other."""
    return any(told is not None and told[0] in COUPLING for told in map(split_column, columns))


def limbs_of(robot: RobotDescription, recordings: Sequence[Recording]) -> NDArray[np.int64]:
    """Number of the limb that each joint belongs to while the torso is fixed, (n_joints,)."""
    support = next((r.support for r in recordings if r.support != "ground"), "ground")
    model = compile_model(robot, support).compiled
    bodies = [int(model.joint(name).bodyid[0]) for name in robot.joint_names]
    roots = []
    for body in bodies:
        root, above = body, int(model.body_parentid[body])
        while above:
            if above in bodies:
                root = above
            above = int(model.body_parentid[above])
        roots.append(root)
    return np.asarray(np.unique(roots, return_inverse=True)[1], dtype=np.int64)


def _packs(
    probes: Sequence[Row], robot: RobotDescription, limbs: NDArray[np.int64]
) -> list[list[int]]:
    """Probes that share a simulation: none reaches a limb of another, and no two are alike."""
    packs: list[tuple[set[int], list[int]]] = []
    for i, probe in enumerate(probes):
        reach = _reach(probe, robot, limbs)
        for taken, members in packs[::-1]:
            if not taken & reach:
                taken |= reach
                members.append(i)
                break
        else:
            packs.append((set(reach), [i]))
    return [members for _, members in packs]


def _reach(probe: Row, robot: RobotDescription, limbs: NDArray[np.int64]) -> frozenset[int]:
    """The limbs that a probe's columns act on."""
    return frozenset(int(limb) for name in probe for limb in _limbs_reached(name, robot, limbs))


def _limbs_reached(
    name: str, robot: RobotDescription, limbs: NDArray[np.int64]
) -> NDArray[np.int64]:
    told = split_column(name)
    group = name.partition("/")[2]
    place = Place("group", group) if group in robot.groups else Place("robot")
    if told is not None:
        place = told[2]
    if place.kind == "body":
        return np.asarray(limbs[_carrier(robot, place.name)])
    joints = place.joints(robot)
    return np.asarray(limbs[joints]) if len(joints) else limbs


def _carrier(robot: RobotDescription, body: str) -> NDArray[np.bool_]:
    """The joint that moves a body; all joints where none does."""
    support = "suspended" if robot.floating else "bench"
    model = compile_model(robot, support).compiled
    carriers = {int(model.joint(n).bodyid[0]): i for i, n in enumerate(robot.joint_names)}
    at = int(model.body(body).id)
    chosen = np.zeros(len(robot.joints), dtype=bool)
    while at:
        if at in carriers:
            chosen[carriers[at]] = True
            return chosen
        at = int(model.body_parentid[at])
    return ~chosen

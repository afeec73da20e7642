"""Making a sealed set: all its cases, the key and the commitment."""

import hashlib
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pup.blind.cases import NULLS, STRATA, make_case, strata
from pup.blind.seal import commit, write_key
from pup.errors import InputError
from pup.files import read_json, write_json
from pup.recording import write_recordings
from pup.robot import RobotDescription

ROBOTS = ("servo_bench", "darwin_leg", "darwin_op2")  # those that typical sizes are known for
SEALED = 946_684_800  # s since 1970, the date that all files of a set bear

Report = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Order:
    """One case to be made.

    Attributes:
      id: random.
      robot: name.
      stratum: see `make_case`.
      ground: whether the robot stands.
      seed: of the case.
    """

    id: str
    robot: str
    stratum: str
    ground: bool
    seed: tuple[int, ...]


def make_set(
    cases: Mapping[str, int],
    nulls: Mapping[str, int],
    seed: str,
    out: Path,
    key: Path,
    report: Report = lambda id, done, total: None,
) -> dict[str, Any]:
    """Make a set; stopped and called again with the same arguments, it goes on.

    Args:
      cases: how many with something missing, by robot.
      nulls: how many without, by robot.
      seed: any text; keep it to yourself until the key is revealed, as it tells the key.
      out: folder of the set.
      key: file for the key, outside of that folder.
      report: told the id of each case made, how many are done and of how many.

    Returns:
      The commitment.

    Raises:
      InputError: a count, a robot or a place that does not do.
    """
    orders = _orders(cases, nulls, seed)
    if key.resolve().is_relative_to(out.resolve()):
        raise InputError(f"{key}: the key must lie outside of the set's folder {out}")
    parts = _parts(key)
    _claim(out, key, {"cases": dict(cases), "nulls": dict(nulls), "seed": _sha(seed)})
    robots = {name: RobotDescription.load(name) for name in {order.robot for order in orders}}
    for done, order in enumerate(orders, start=1):
        part = parts / f"{order.id}.json"
        if not part.exists():
            robot = robots[order.robot]
            made = make_case(robot, order.stratum, order.ground, order.seed, order.id)
            folder = out / f"case_{order.id}"
            shutil.rmtree(folder, ignore_errors=True)  # what a call that was killed left of it
            write_recordings(made.recordings, folder / "recordings")
            if made.tests:
                write_recordings(made.tests, folder / "test")
            write_json(part, made.truth)
        report(order.id, done, len(orders))
    counts: dict[str, int] = {}
    for order in orders:
        name = robots[order.robot].name
        counts[name] = counts.get(name, 0) + 1
    truths = sorted((read_json(parts / f"{o.id}.json") for o in orders), key=lambda t: t["id"])
    write_key(key, {"schema": 1, "salt": _sha(f"salt of {seed}"), "cases": truths})
    commitment = commit(out, key, counts)
    for path in (*out.rglob("*"), out):
        os.utime(path, (SEALED, SEALED))  # how long a case took would tell of what kind it is
    shutil.rmtree(parts)
    return commitment


def _orders(cases: Mapping[str, int], nulls: Mapping[str, int], seed: str) -> list[Order]:
    """All cases of a set in the order of making, which tells nothing."""
    words = [int(_sha(seed)[k : k + 8], 16) for k in range(0, 64, 8)]
    rng = np.random.default_rng([*words, 0])
    orders: list[Order] = []
    for robot in sorted({*cases, *nulls}):
        if robot not in ROBOTS:
            raise InputError(f"robot {robot!r}: blind sets are of {', '.join(ROBOTS)}")
        feet = bool(RobotDescription.load(robot).feet)
        kinds = strata(cases.get(robot, 0), STRATA)
        kinds += [f"null:{kind}" for kind in strata(nulls.get(robot, 0), NULLS)]
        for n, kind in enumerate(kinds):
            # Of those with feet every other; only in the air some effects cannot be told apart.
            ground = feet and n % 2 == 0 and kind != "unidentifiable"
            id = rng.bytes(5).hex()
            orders.append(Order(id, robot, kind, ground, (*words, len(orders) + 1)))
    if not orders:
        raise InputError("no case asked for; give --robot NAME=COUNT or --nulls NAME=COUNT")
    return sorted(orders, key=lambda order: order.id)


def _claim(out: Path, key: Path, what: Mapping[str, Any]) -> None:
    """Start a set, or go on with the same one."""
    plan = _parts(key) / "set.json"
    if plan.exists():
        if read_json(plan) != what:
            raise InputError(f"{plan.parent}: left by another set; remove it or use another --key")
        return
    if key.exists():
        raise InputError(f"{key}: there is a key already; use another --key")
    if out.exists() and any(out.iterdir()):
        raise InputError(f"{out}: not empty; use another folder")
    write_json(plan, what)


def _parts(key: Path) -> Path:
    """Where the truths of the cases made so far stand."""
    return key.with_name(f"{key.name}.parts")


def _sha(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()

"""Making a sealed set: all its cases, the key and the commitment."""

import hashlib
import os
import shutil
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from pup.blind.cases import make_case, strata
from pup.blind.origin import generator
from pup.blind.seal import check_cases, commit, write_key
from pup.blind.setting import NULLS, STRATA
from pup.errors import InputError
from pup.files import read_json
from pup.recording import write_recordings
from pup.robot import RobotDescription

ROBOTS = ("servo_bench", "darwin_leg", "darwin_op2")  # those that typical sizes are known for
SEALED = 946_684_800  # s since 1970, the date that all files of a set bear

SHORTEST = 16  # characters of a seed; fewer can be found by trying, and tell the key

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
      folder: where its recordings go.
      part: file for its entry in the key.
    """

    id: str
    robot: str
    stratum: str
    ground: bool
    seed: tuple[int, ...]
    folder: Path
    part: Path

    @property
    def done(self) -> bool:
        """Whether its truth and all its recordings are there."""
        if not self.part.exists():
            return False
        truth = read_json(self.part)
        return all(
            {file.stem for file in (self.folder / kind).glob("*.parquet")} == set(truth[ids])
            for kind, ids in (("recordings", "recordings"), ("test", "tests"))
        )


Each = Callable[[Callable[[Order], str], Sequence[Order]], Generator[tuple[Order, Any], None, None]]
"""Does a job for all orders, in any order of time, and gives each with its outcome; an exception
where its process was lost."""


def one_by_one(
    job: Callable[[Order], str], orders: Sequence[Order]
) -> Generator[tuple[Order, Any], None, None]:
    """An `Each` of this process."""
    for order in orders:
        yield order, job(order)


def make_set(
    cases: Mapping[str, int],
    nulls: Mapping[str, int],
    seed: str,
    out: Path,
    key: Path,
    report: Report = lambda id, done, total: None,
    each: Each = one_by_one,
) -> dict[str, Any]:
    """Make a set; stopped and called again with the same arguments, it goes on.

    Args:
      cases: how many with something missing, by robot.
      nulls: how many without, by robot.
      seed: a long text; keep it to yourself until the key is revealed, as it tells the key.
      out: folder of the set.
      key: file for the key, outside of that folder.
      report: told the id of each case made, how many are done and of how many.
      each: what makes the cases, several at once or not: each has a seed and files of its own.

    Returns:
      The commitment.

    Raises:
      InputError: a count, a robot, a seed or a place that does not do, or a case that cannot be
        made.
    """
    # Absolute, as a worker's working directory is another.
    orders = _orders(cases, nulls, seed, out.absolute(), parts_of(key).absolute())
    if len(seed) < SHORTEST:
        raise InputError(f"the seed tells the key; use one of {SHORTEST} characters or more")
    if key.resolve().is_relative_to(out.resolve()):
        raise InputError(f"{key}: the key must lie outside of the set's folder {out}")
    made_with = generator()
    wanted = {"cases": dict(cases), "nulls": dict(nulls), "seed": _sha(seed)}
    _claim(out, key, wanted | {"generator": made_with})
    todo = [order for order in orders if not order.done]
    done = len(orders) - len(todo)
    with closing(each(make_one, todo)) as outcomes:
        for order, outcome in outcomes:
            if isinstance(outcome, Exception):
                raise outcome
            if outcome:
                raise InputError(outcome)
            done += 1
            report(order.id, done, len(orders))
    truths = [read_json(order.part) for order in orders]
    check_cases(out, truths)
    salt = _sha(f"salt of {seed}")
    write_key(key, {"schema": 1, "salt": salt, "generator": made_with, "cases": truths})
    commitment = commit(out, key)
    _date(out, orders)
    for order in orders:
        order.part.unlink()  # before what tells that the set is to be gone on with
    shutil.rmtree(parts_of(key))
    return commitment


def _date(out: Path, orders: Sequence[Order]) -> None:
    """Give all files of a set one date: how long a case took would tell of what kind it is.

    A file system remembers when a file was begun too, which nobody can set: the cases' are begun
    anew here, one case after the other.
    """
    for order in orders:
        anew = out / f".{order.folder.name}"
        shutil.rmtree(anew, ignore_errors=True)  # what a call that was killed left of it
        shutil.copytree(order.folder, anew)
        shutil.rmtree(order.folder)
        os.replace(anew, order.folder)
    for path in (*out.rglob("*"), out):
        os.utime(path, (SEALED, SEALED))


def make_one(order: Order) -> str:
    """Make a case and write it down; tells why where it cannot be made."""
    robot = RobotDescription.load(order.robot)
    try:
        with threadpool_limits(limits=1):  # sums depend on how many threads share them
            made = make_case(robot, order.stratum, order.ground, order.seed, order.id)
    except InputError as error:
        return str(error)
    shutil.rmtree(order.folder, ignore_errors=True)  # what a call that was killed left of it
    write_recordings(made.recordings, order.folder / "recordings")
    if made.tests:
        write_recordings(made.tests, order.folder / "test")
    write_key(order.part, made.truth)
    return ""


def _orders(
    cases: Mapping[str, int], nulls: Mapping[str, int], seed: str, out: Path, parts: Path
) -> list[Order]:
    """All cases of a set in the order of their ids, which tells nothing."""
    words = [int(_sha(seed)[k : k + 8], 16) for k in range(0, 64, 8)]
    rng = np.random.default_rng([*words, 0])
    orders: list[Order] = []
    for robot in sorted({*cases, *nulls}):
        if robot not in ROBOTS:
            raise InputError(
                f"robot {robot!r}: blind sets are of {', '.join(ROBOTS)} alone; how large effects "
                "typically are is not known of another robot"
            )
        feet = bool(RobotDescription.load(robot).feet)
        kinds = strata(cases.get(robot, 0), STRATA)
        kinds += [f"null:{kind}" for kind in strata(nulls.get(robot, 0), NULLS)]
        for n, kind in enumerate(kinds):
            # Of those with feet every other; only in the air some effects cannot be told apart.
            ground = feet and n % 2 == 0 and kind != "unidentifiable"
            id = rng.bytes(5).hex()
            own = (*words, len(orders) + 1)
            folder, part = out / f"case_{id}", parts / f"{id}.json"
            orders.append(Order(id, robot, kind, ground, own, folder, part))
    if not orders:
        raise InputError("no case asked for; give --robot NAME=COUNT or --nulls NAME=COUNT")
    return sorted(orders, key=lambda order: order.id)


def _claim(out: Path, key: Path, what: Mapping[str, Any]) -> None:
    """Start a set, or go on with the same one."""
    plan = parts_of(key) / "set.json"
    if plan.exists():
        told = read_json(plan)
        if told != what:
            changed = isinstance(told, dict) and told | {"generator": what["generator"]} == what
            by = "another version of the generator" if changed else "another set"
            raise InputError(f"{plan.parent}: left by {by}; remove it or use another --key")
        return
    if key.exists():
        raise InputError(f"{key}: there is a key already; use another --key")
    if out.exists() and any(out.iterdir()):
        raise InputError(f"{out}: not empty; use another folder")
    plan.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    write_key(plan, what)


def parts_of(key: Path) -> Path:
    """Where the truths of the cases made so far stand."""
    return key.with_name(f"{key.name}.parts")


def _sha(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()

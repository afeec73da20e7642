"""At most one motion per trial, and no end that gets lost, whatever the link and the power do."""

import json
import os
import random
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware_agent.journal import Journal
from hardware_agent.trials import RESTARTED, End, TrialBook
from pup.errors import InputError
from pup.wire import (
    Accepted,
    Acknowledge,
    Assign,
    Body,
    Cancel,
    Finished,
    Message,
    Outcome,
    Running,
    decode,
    encode,
)

FELL = End(Outcome.SUCCEEDED, "fell", None, 3.0, "recording", "0" * 64)


def assign(trial: str = "t", attempt: int = 1, fence: int = 1) -> Assign:
    return Assign("study", trial, attempt, fence, "p" * 64, (0.1, 1 / 3, -1.0), 14.0)


def book(folder: Path) -> TrialBook:
    return TrialBook(Journal(folder / "journal"))


def test_no_entry_stands_behind_one_that_a_full_disk_cut(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal, write = Journal(tmp_path / "journal"), os.write
    journal.append({"event": "one"})
    with monkeypatch.context() as full:
        full.setattr(os, "write", lambda file, line: write(file, line[:9]))
        with pytest.raises(OSError, match="the disk is full"):
            journal.append({"event": "lost"})
    journal.append({"event": "two"})
    journal.close()
    kept = Journal(tmp_path / "journal").entries
    assert [entry["event"] for entry in kept] == ["one", "two"]


class PowerCutError(Exception):
    """The agent is killed here."""


class Fragile(Journal):
    """A journal whose power may go.

    Attributes:
      cut: entries until it does; None for never.
    """

    cut: int | None = None

    def append(self, entry: dict[str, Any]) -> None:
        if self.cut == 0:
            raise PowerCutError
        if self.cut is not None:
            self.cut -= 1
        super().append(entry)


@dataclass
class World:
    """An agent, a gateway and a link between them that does what it wants.

    Attributes:
      folder: of the agent's journal.
      moved: motions that the robot began, by trial and attempt.
      stored: ends that the gateway has.
      outbox: messages under way to the gateway.
      inbox: to the agent.
      forbidden: trials that were cancelled before they moved.
    """

    folder: Path
    moved: Counter[tuple[str, int]] = field(default_factory=Counter)
    stored: dict[tuple[str, int], Finished] = field(default_factory=dict)
    told: Counter[tuple[str, int]] = field(default_factory=Counter)
    fences: dict[tuple[str, int], int] = field(default_factory=dict)
    outbox: list[Body] = field(default_factory=list)
    inbox: list[Body] = field(default_factory=list)
    forbidden: set[tuple[str, int]] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Power is back: everything but the journal is gone."""
        self.journal = Fragile(self.folder / "journal")
        self.book = TrialBook(self.journal)
        left = self.book.unmeasured
        self.moving: Assign | None = left and left[0]

    def agent(self, body: Body) -> None:
        """The agent gets a message."""
        if isinstance(body, Assign):
            self.outbox += self.book.assigned(body)
        elif isinstance(body, Cancel):
            key = (body.trial, body.attempt)
            known = {(e.trial, e.attempt): e.fence for e in self.book.entries()}
            answers, end = self.book.cancelled(body)
            if body.fence >= known.get(key, 0) and not self.moved[key]:
                self.forbidden.add(key)
            self.outbox += answers
            if end and self.moving is not None:
                self.outbox.append(self.book.finish(self.moving, End(Outcome.ABORTED, "halted")))
                self.moving = None
        elif isinstance(body, Acknowledge):
            self.book.acknowledged(body)

    def move(self) -> None:
        """The robot begins the trial that there is."""
        current = self.book.current
        if current is None or self.book.running:
            return
        self.outbox.append(self.book.begin(current))
        self.moved[current.trial, current.attempt] += 1
        self.moving = current

    def over(self) -> None:
        """It has ended, and somebody goes for the tape."""
        if self.moving is not None and self.book.unmeasured is None:
            self.book.walked(self.moving, FELL)

    def stand(self) -> None:
        """It has ended, and how far it came is known."""
        if self.moving is not None:
            self.outbox.append(self.book.finish(self.moving, replace(FELL, distance=0.5)))
            self.moving = None

    def gateway(self, body: Body) -> None:
        """The gateway gets a message."""
        if isinstance(body, Finished):
            key = (body.trial, body.attempt)
            if body.fence < self.fences.get(key, 0):
                return  # of a time before the trial was handed out anew
            if key not in self.stored:
                self.stored[key] = body
                self.told[key] += 1
            self.inbox.append(Acknowledge("m", body.trial, body.attempt, body.fence))


WEIGHTS = {
    "assign": 4.0,
    "cancel": 0.3,
    "deliver": 12.0,
    "drop": 5.0,
    "repeat": 2.0,
    "move": 3.0,
    "over": 1.0,
    "stand": 2.0,
    "resend": 1.0,
    "restart": 0.4,
    "cut": 0.4,
}
"""How often what happens."""


@pytest.mark.parametrize("seed", range(40))
def test_no_trial_moves_twice_and_every_end_is_told_once(tmp_path: Path, seed: int) -> None:
    """300 things happen to a dozen trials; then the link works again."""
    rng, world = random.Random(seed), World(tmp_path)
    kinds, weights = list(WEIGHTS), list(WEIGHTS.values())
    for kind in rng.choices(kinds, weights, k=300):
        try:
            _do(world, kind, rng)
        except PowerCutError:
            world.restart()
    _settle(world)
    assert len(world.moved) > 1, "nothing was tested"
    assert all(count == 1 for count in world.moved.values())
    assert all(count == 1 for count in world.told.values())
    assert set(world.moved) <= set(world.stored), "an end was lost"
    assert not world.book.owed
    assert not any(world.moved[key] for key in world.forbidden)
    for key, finished in world.stored.items():
        if finished.state is Outcome.SUCCEEDED:
            assert world.moved[key] == 1
        if finished.reason == "cancelled":
            assert world.moved[key] == 0


def _do(world: World, kind: str, rng: random.Random) -> None:
    if kind in ("assign", "cancel"):
        newest = len({trial for trial, _ in world.fences}) // 2
        trial = f"t{rng.randint(max(0, newest - 1), newest + 1)}"
        key = (trial, rng.choice((1, 1, 1, 2)))
        if kind == "assign":
            world.fences[key] = world.fences.get(key, 1) + rng.choice((0, 0, 1))
            world.inbox.append(assign(*key, world.fences[key]))
        elif key in world.fences:
            world.inbox.append(Cancel(*key, world.fences[key]))
    elif kind in ("deliver", "drop", "repeat"):
        _pass(world, kind, rng.random() < 0.5, rng.choice((0, 0, 0, rng.randrange(30))))
    elif kind == "resend":
        world.outbox += world.book.owed
    elif kind == "cut":
        world.journal.cut = rng.randrange(4)
    else:
        does = {"move": world.move, "over": world.over, "stand": world.stand}
        (does | {"restart": world.restart})[kind]()


def _pass(world: World, kind: str, up: bool, which: int) -> None:
    """Deliver, lose or deliver without forgetting a message, in any order."""
    queue = world.outbox if up else world.inbox
    if not queue:
        return
    body = queue[which % len(queue)]
    if kind != "repeat":
        queue.remove(body)
    if kind != "drop":
        body = decode(encode(Message(body))).body
        (world.gateway if up else world.agent)(body)


def _settle(world: World) -> None:
    """The link works again, for long enough."""
    world.journal.cut = None
    for _ in range(6):
        world.stand()
        if world.moving is None and world.book.running:
            world.restart()  # what ran when the power went
        world.outbox += world.book.owed
        while world.outbox or world.inbox:
            for up, queue in ((True, world.outbox), (False, world.inbox)):
                while queue:
                    body = queue.pop(0)
                    if up or isinstance(body, Acknowledge):
                        (world.gateway if up else world.agent)(body)
        if not world.book.owed:
            return
        # an end under an old fence is only told under the one that the gateway knows
        for finished in world.book.owed:
            key = (finished.trial, finished.attempt)
            world.agent(assign(*key, world.fences[key]))


def test_a_motion_that_the_power_cut_is_told_as_aborted(tmp_path: Path) -> None:
    first = book(tmp_path)
    first.assigned(assign())
    first.begin(assign())
    again = book(tmp_path)
    assert again.current is None
    (owed,) = again.owed
    assert (owed.state, owed.reason) == (Outcome.ABORTED, RESTARTED)
    assert again.assigned(assign()) == [owed]


def test_a_walk_that_is_over_waits_for_its_distance_after_a_restart_too(tmp_path: Path) -> None:
    first = book(tmp_path)
    first.assigned(assign())
    first.begin(assign())
    first.walked(assign(), FELL)
    again = book(tmp_path)
    assert again.unmeasured == (assign(), FELL) and again.running and not again.owed
    assert again.assigned(assign(fence=2)) == [Running("t", 1, 2)], "not walked again"
    third = book(tmp_path)
    assert third.unmeasured == (assign(fence=2), FELL)
    told = third.finish(assign(fence=2), replace(FELL, distance=0.4))
    assert (told.state, told.distance, told.fence) == (Outcome.SUCCEEDED, 0.4, 2)
    assert book(tmp_path).unmeasured is None


def test_a_trial_that_was_only_accepted_goes_on_after_a_restart(tmp_path: Path) -> None:
    assert book(tmp_path).assigned(assign()) == [Accepted("t", 1, 1)]
    again = book(tmp_path)
    assert again.current == assign()
    assert [e.state for e in again.entries()] == ["accepted"]


def test_an_older_fence_gets_no_answer_and_a_newer_one_is_taken_over(tmp_path: Path) -> None:
    trials = book(tmp_path)
    trials.assigned(assign(fence=3))
    assert trials.assigned(assign(fence=2)) == []
    assert trials.cancelled(Cancel("t", 1, 2)) == ([], False)
    assert trials.assigned(assign(fence=4)) == [Accepted("t", 1, 4)]
    trials.begin(trials.current or assign())
    assert trials.assigned(assign(fence=5)) == [Running("t", 1, 5)]
    told = trials.finish(assign(), End(Outcome.SUCCEEDED, "fell", 0.4, 2.0))
    assert told.fence == 5
    trials.acknowledged(Acknowledge("m", "t", 1, 5))
    assert trials.owed == []
    (again,) = book(tmp_path).assigned(assign(fence=6))
    assert isinstance(again, Finished) and (again.fence, again.distance) == (6, 0.4)


def test_a_cancellation_that_overtakes_its_trial_holds(tmp_path: Path) -> None:
    trials = book(tmp_path)
    answers, end = trials.cancelled(Cancel("t", 1, 1))
    assert not end and isinstance(answers[0], Finished)
    assert trials.assigned(assign()) == answers
    assert trials.current is None


def test_one_trial_at_a_time_and_a_new_attempt_replaces_what_has_not_moved(tmp_path: Path) -> None:
    trials = book(tmp_path)
    trials.assigned(assign("a"))
    assert trials.assigned(assign("b")) == []
    assert trials.assigned(assign("a", attempt=2)) == [Accepted("a", 2, 1)]
    assert trials.current == assign("a", attempt=2)
    assert trials.assigned(assign("a", attempt=1, fence=1)) == trials.owed
    trials.begin(assign("a", attempt=2))
    assert trials.assigned(assign("a", attempt=3)) == []


@given(st.integers(1, 400))
@settings(max_examples=40)
def test_a_journal_survives_being_cut_off_anywhere(cut: int) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder)
        trials = book(path)
        trials.assigned(assign())
        trials.begin(assign())
        trials.finish(assign(), End(Outcome.SUCCEEDED, "fell", 0.4, 2.0))
        data = (path / "journal").read_bytes()
        left = data[: max(1, len(data) - cut)]
        (path / "journal").write_bytes(left)
        again = book(path)
        told = left.count(b"\n") - 1  # after the line that tells the schema: taken on, begun, ended
        ends = {f.state for f in again.owed}
        assert len(again.entries()) == (told >= 1)
        assert ends == (
            {Outcome.SUCCEEDED} if told >= 3 else {Outcome.ABORTED} if told == 2 else set()
        )
        again.assigned(assign("next"))
        assert book(path).entries() == again.entries()


def test_damage_in_the_middle_of_a_journal_is_refused(tmp_path: Path) -> None:
    trials = book(tmp_path)
    trials.assigned(assign())
    trials.begin(assign())
    file = tmp_path / "journal"
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)
    with pytest.raises(InputError, match="damaged"):
        book(tmp_path)


def test_a_journal_of_another_schema_is_refused(tmp_path: Path) -> None:
    import zlib

    text = json.dumps({"event": "journal", "schema": 2})
    (tmp_path / "journal").write_text(f"{zlib.crc32(text.encode()):08x} {text}\n")
    with pytest.raises(InputError, match="schema 1"):
        book(tmp_path)

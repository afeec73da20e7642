"""Lets studies go on: suggests trials, hands them out, hears how they end.

What keeps a walk from being lost, made twice or told twice: a change is computed by
`pup.transfer.trial`, written to the store, and only then kept in memory, sent or acknowledged. A
gateway that dies between any two of these finds in the store what it had decided and goes on from
there: it sends the same assignment with the same fence again, and the agent sends its result again
until it is acknowledged.
"""

import asyncio
import logging
import secrets
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from typing import Any

from pup.errors import InputError
from pup.transfer import orders
from pup.transfer.steps import Choose, Finish, Step, Suggest, Wait, Walk, next_step
from pup.transfer.study import Gate, Study, StudySettings, StudyState
from pup.transfer.trial import (
    HANDED_OUT,
    Purpose,
    Result,
    Ticket,
    Trial,
    TrialError,
    TrialState,
    UnknownError,
    Verdict,
)
from pup.wire import Accepted, Armed, Cancel, Finished, Running
from services.gateway import fits
from services.gateway.agents import AgentView
from services.gateway.assignment import place_of, unfit, waits_for
from services.gateway.courier import Courier
from services.gateway.metrics import Metrics
from services.gateway.posteriors import Posteriors
from services.gateway.records import Row
from services.gateway.store import Change, Event, ReplacedError, Store

log = logging.getLogger(__name__)

PERIOD = 0.5
"""Between two looks at leases, idle agents and unanswered assignments, s."""

REPORTED = {
    Accepted: TrialState.ASSIGNED,
    Armed: TrialState.ARMED,
    Running: TrialState.RUNNING,
}


class Conductor:
    """The studies of one gateway.

    Args:
      store: what must not be forgotten.
      fitted: runs the Gaussian processes.
      metrics: counts.
    """

    def __init__(self, store: Store, fitted: fits.Fits, metrics: Metrics) -> None:
        self.store, self.fits, self.metrics = store, fitted, metrics
        self.posteriors = Posteriors(fitted, self.notify)
        self.studies: dict[str, Study] = {}
        self.simulated: dict[str, Row | None] = {}
        self.agents: dict[str, AgentView] = {}
        self.revision: dict[str, int] = defaultdict(int)
        self.courier = Courier(self.agents)
        self.stopped: BaseException | None = None
        self._locks: dict[str, asyncio.Lock] = defaultdict(asyncio.Lock)
        self._heard: dict[str, float] = {}
        self._changed: dict[str, asyncio.Event] = defaultdict(asyncio.Event)
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._trouble: dict[str, str] = {}
        self._wanted: set[str] = set()
        self._handing_out = asyncio.Lock()

    async def load(self) -> None:
        """Read the store; trials that were handed out get a whole lease anew."""
        for study, simulated in await self.store.studies():
            self.studies[study.name], self.simulated[study.name] = study, simulated
            self._heard[study.name] = time.monotonic()

    async def run(self) -> None:
        """Go on until the process ends, or another gateway takes over."""
        while self.stopped is None:
            self.tick()
            await asyncio.sleep(PERIOD)

    def tick(self) -> None:
        """Look once at all agents and studies."""
        for view in self.agents.values():
            if view.stop:
                self.courier.send(view.name, view.stop)
            if view.changed():
                self.notify("")
                for study in self.studies.values():
                    if view.name in (study.agent, study.open and study.open.agent):
                        self.notify(study.name)
        for name in list(self.studies):
            if self.studies[name].state is not StudyState.DONE:
                self._go_on(name)

    @property
    def admitted(self) -> list[AgentView]:
        """The agents whose keys are known, by name."""
        return [view for _, view in sorted(self.agents.items()) if view.admitted]

    def study(self, name: str) -> Study:
        """A study by its name.

        Raises:
          UnknownError: there is none.
        """
        if name not in self.studies:
            raise UnknownError(f"there is no study {name}")
        return self.studies[name]

    async def create(
        self, name: str, settings: StudySettings, simulated: Row | None, who: str
    ) -> tuple[Study, bool]:
        """Make a study; one of the same name and settings is joined.

        Returns:
          The study, and whether it is new.

        Raises:
          TrialError: there is one of this name with other settings.
        """
        async with self._locks[name]:
            if name in self.studies:
                same = simulated in (None, self.simulated[name])
                if self.studies[name].settings != settings or not same:
                    raise TrialError(f"study {name} exists with other settings; use another name")
                return self.studies[name], False
            event = Event("created", who, detail={"settings": asdict(settings)})
            self._heard[name] = time.monotonic()
            self.simulated[name] = simulated
            study = Study(name, settings, mark=secrets.token_hex(4))
            await self._write(Change(study, events=[event], simulated=simulated))
        self._go_on(name)
        return study, True

    async def change(self, name: str, who: str, act: Callable[[Study], Study], kind: str) -> Study:
        """Do what an operator wants with a study."""
        async with self._locks[name]:
            before = self.study(name)
            study = act(before)
            if study != before:
                trials = [t for t in study.trials if t not in before.trials]
                number = trials[0].number if trials else None
                await self._write(Change(study, trials, [Event(kind, who, number)]))
        self._go_on(name)
        return study

    async def go_on(self, name: str, who: str, act: Callable[[Study], Study], kind: str) -> Study:
        """Do what lets a study go on; robots that were stopped may walk for it again."""
        study = await self.change(name, who, act, kind)
        if study.state is StudyState.ACTIVE:  # not where an order that was given before comes again
            for view in self.agents.values():
                if study.agent in (None, view.name):
                    view.held = ""
        return study

    async def cancel(self, name: str, number: int, who: str, reason: str = "") -> Study:
        """Take a trial back, or ask its agent to stop it; the study pauses."""
        reason = reason or f"cancelled by {who}"
        order = partial(orders.cancel, number=number, reason=reason)
        study = await self.change(name, who, order, "cancelled")
        self.courier.recall(study.trial(number))
        return study

    def heard(self, agent: str, trial: str | None) -> None:
        """A sign of life: it renews the lease of the trial that it names."""
        study = self.studies.get((trial or "").rpartition("/")[0])
        if study and study.open and study.open.wire == trial and study.open.agent == agent:
            self._heard[study.name] = time.monotonic()

    async def reported(self, agent: str, body: Accepted | Armed | Running) -> Verdict:
        """An agent took a trial on, or its robot moves."""
        where = place_of(body.trial, self.studies)
        if where is None:
            return Verdict.UNKNOWN
        name, number = where
        ticket = Ticket(body.attempt, body.fence, agent)
        self.agents[agent].journal.add((body.trial, body.attempt, body.fence))
        async with self._locks[name]:
            study = self.studies[name]
            trial, verdict = study.trial(number).report(ticket, REPORTED[type(body)])
            if verdict is Verdict.COUNTED:
                event = Event(trial.state.value, agent, number, asdict(body))
                await self._write(Change(study.with_trial(trial), [trial], [event]))
        if verdict in (Verdict.LATE, Verdict.UNKNOWN) and not isinstance(body, Running):
            self.courier.send(agent, Cancel(body.trial, body.attempt, body.fence))
        return verdict

    async def finished(self, agent: str, body: Finished) -> Verdict:
        """A trial ended; once this returns, it is stored and may be acknowledged."""
        where = place_of(body.trial, self.studies)
        if where is None:
            event = Event("unknown", agent, detail=asdict(body))
            await self.store.log([event])
            return Verdict.UNKNOWN
        name, number = where
        result = Result(
            TrialState(body.state.value),
            body.distance,
            body.time,
            body.reason,
            body.recording,
            body.digest,
        )
        self.heard(agent, body.trial)  # the walk is over, not the telling of it
        async with self._locks[name]:
            study = self.studies[name]
            before = study.trial(number)
            trial, verdict = before.finish(
                Ticket(body.attempt, body.fence, agent), result, study.settings.horizon
            )
            if verdict is Verdict.COUNTED:
                event = Event(trial.state.value, agent, number, asdict(body))
                study = study.with_trial(trial)
                if before.state is not TrialState.LOST:  # else that was told when it was lost
                    study = orders.after_end(study, trial)
                await self._write(Change(study, [trial], [event]))
                self.metrics.trials.labels(trial.state.value).inc()
            elif verdict is not Verdict.REPEATED:
                await self.store.log([Event(verdict.value, agent, number, asdict(body))], name)
                self.metrics.trials.labels(verdict.value).inc()
        self._go_on(name)
        return verdict

    async def posterior(self, name: str, seconds: float | None = None) -> Row:
        """The Gaussian process of a study; that of fewer walks where this takes too long."""
        study = self.study(name)
        if seconds is None:
            return await self.posteriors.of(study, self.simulated[name])
        return await self.posteriors.soon(study, self.simulated[name], seconds)

    async def wait(self, name: str, revision: int, seconds: float) -> int:
        """Wait until a study, or with an empty name an agent, changed since a revision."""
        if self.revision[name] == revision:
            with suppress(TimeoutError):
                await asyncio.wait_for(self._changed[name].wait(), seconds)
        return self.revision[name]

    def notify(self, name: str) -> None:
        """Tell whoever waits that something changed."""
        self.revision[name] += 1
        self._changed.pop(name, asyncio.Event()).set()

    def waits_for(self, study: Study) -> str:
        """What a study waits for, in words."""
        return self._trouble.get(study.name) or waits_for(study, self.studies, self.agents)

    def measure(self) -> None:
        """Bring the gauges up to date."""
        states = [s.state for s in self.studies.values()]
        for state in StudyState:
            self.metrics.studies.labels(state.value).set(states.count(state))
        self.metrics.health.clear()
        for view in self.agents.values():
            self.metrics.agent(view)

    async def _write(self, change: Change) -> None:
        """Store a change, then make it known."""
        try:
            await self.store.write(change)
        except ReplacedError as error:
            self.stopped = error
            raise
        self.studies[change.study.name] = change.study
        self.notify(change.study.name)

    def _go_on(self, name: str) -> None:
        """Look at a study without waiting for it; again, where a look is under way."""
        self._wanted.add(name)
        if name not in self._tasks:
            task = asyncio.get_running_loop().create_task(self._looks(name))
            self._tasks[name] = task
            task.add_done_callback(lambda done: self._looked(name, done))

    async def _looks(self, name: str) -> None:
        while name in self._wanted:
            self._wanted.discard(name)
            await self._look(name)

    def _looked(self, name: str, done: "asyncio.Task[None]") -> None:
        self._tasks.pop(name, None)
        before, trouble = self._trouble.pop(name, ""), ""
        if not done.cancelled() and (error := done.exception()):
            trouble = f"the gateway, which failed ({type(error).__name__}); see its log"
            tell = log.debug if trouble == before else log.error  # it is tried again soon
            tell("study failed", extra={"study": name}, exc_info=error)
            self._trouble[name] = trouble
        if trouble != before:
            self.notify(name)
        if trouble:
            return
        if name in self._wanted and not done.cancelled():
            self._go_on(name)

    async def _look(self, name: str) -> None:
        """Do what a study needs: end a lease, hand out, suggest, choose."""
        async with self._locks[name]:
            study = self.studies[name]
            trial = study.open
            if trial and trial.state in HANDED_OUT:
                await self._watch(study, trial)
            elif trial and trial.released and study.state is StudyState.ACTIVE:
                async with self._handing_out:
                    await self._hand_out(study, trial)
            elif not isinstance(step := next_step(study), Wait):
                await self._step(study, step)
                self._wanted.add(name)

    async def _watch(self, study: Study, trial: Trial) -> None:
        if time.monotonic() - self._heard[study.name] > study.settings.lease:
            lost = trial.expire()
            event = Event("lost", trial=trial.number, detail={"agent": trial.agent})
            study = orders.after_end(study.with_trial(lost), lost)
            await self._write(Change(study, [lost], [event]))
            self.metrics.trials.labels("lost").inc()
        elif self.courier.waits(trial):
            return
        elif trial.cancelled:
            self.courier.recall(trial)
        elif trial.state is TrialState.ASSIGNED:
            self.courier.assign(study, trial)

    async def _hand_out(self, study: Study, trial: Trial) -> None:
        reasons = unfit(study, self.studies, self.agents)
        agent = next((name for name, why in reasons.items() if why is None), None)
        if agent is None:
            return
        given = trial.assign(agent, study.fence + 1)
        study = replace(study, fence=given.fence).with_trial(given)
        self._heard[study.name] = time.monotonic()
        event = Event("assigned", trial=given.number, detail={"agent": agent, "fence": given.fence})
        await self._write(Change(study, [given], [event]))
        self.courier.assign(study, given)

    async def _step(self, study: Study, step: Step) -> None:
        match step:
            case Suggest():
                with self.metrics.suggest.time():
                    decision = await self.fits.run(fits.suggest, study, self.simulated[study.name])
                if decision.purpose is Purpose.REPEAT:
                    await self._keep(study, decision)
                else:
                    await self._add(study, decision.eta, decision.purpose, asdict(decision))
            case Walk(eta, purpose):
                await self._add(study, eta, purpose, {"eta": list(eta), "purpose": purpose.value})
            case Choose():
                try:
                    decision = await self.fits.run(fits.choose, study, self.simulated[study.name])
                except InputError as error:  # nothing walked: another attempt finds the same
                    await self._write(Change(orders.pause(study, str(error)), events=[]))
                    return
                await self._keep(study, decision)
            case Finish():
                study = replace(study, state=StudyState.DONE)
                await self._write(Change(study, events=[Event("done")]))

    async def _keep(self, study: Study, decision: Any) -> None:
        study = replace(study, chosen=decision.eta)
        await self._write(Change(study, events=[Event("chosen", detail=asdict(decision))]))

    async def _add(self, study: Study, eta: Any, purpose: Purpose, why: Row) -> None:
        released = study.settings.gate is Gate.AUTO
        number = len(study.trials) + 1
        trial = Trial(study.name, number, tuple(eta), purpose, released=released, mark=study.mark)
        event = Event("requested", trial=trial.number, detail=why)
        await self._write(Change(study.with_trial(trial), [trial], [event]))

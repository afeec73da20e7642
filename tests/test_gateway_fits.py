"""What the optimiser hears of a study: its walks, and the trials that gave none."""

import asyncio
import os
import signal

import pytest

pytest.importorskip("botorch")

from pup.transfer.study import Study, StudySettings
from pup.transfer.trial import Purpose, Result, Ticket, Trial, TrialState
from services.gateway import fits

S = TrialState
SETTINGS = StudySettings("darwin_op2", "0" * 64, initial=3, seed=4)


def ended(study, *states):
    """The study after trials that the optimiser asked for and that ended so."""
    for state in states:
        number = len(study.trials) + 1
        eta = fits.suggest(study, None).eta
        trial = Trial("s", number, eta, Purpose.SEARCH).release().assign("a", number)
        result = Result(state, 0.5 + 0.1 * eta[0], 15.0)
        trial, _ = trial.finish(Ticket(1, number, "a"), result, 15.0)
        study = study.with_trial(trial)
    return study


def test_the_middle_is_walked_though_the_first_trial_was_aborted():
    study = ended(Study("s", SETTINGS), S.ABORTED, *[S.SUCCEEDED] * 3)
    plain = ended(Study("s", SETTINGS), *[S.SUCCEEDED] * 3)
    assert study.trial(2).eta == (0.0, 0.0, 0.0)
    assert [t.eta for t in study.told] == [t.eta for t in plain.told], "none is left out"


def test_a_first_point_that_is_made_void_is_offered_again():
    study = ended(Study("s", SETTINGS), S.SUCCEEDED, S.SUCCEEDED)
    study = study.with_trial(study.trial(1).void("held"))
    assert ended(study, S.SUCCEEDED).trial(3).eta == study.trial(1).eta


def test_whoever_resumes_after_an_overload_gets_another_eta():
    study = ended(Study("s", SETTINGS), *[S.SUCCEEDED] * 6, S.ABORTED, S.ABORTED)
    search = fits.search_of(study, None)
    assert search.avoided == search.fruitless == (study.trial(7).eta, study.trial(8).eta)
    decided = fits.suggest(study, None)
    assert "away from what gave no result" in decided.why
    after = ended(study, S.SUCCEEDED)
    assert not fits.search_of(after, None).avoided and len(after.fruitless) == 2


def stopped(known):
    """What a process comes to, the first time, that neither ends nor goes on."""
    if not known.exists():
        known.touch()
        os.kill(os.getpid(), signal.SIGSTOP)
    return os.getpid()


def test_a_process_that_hangs_is_replaced(tmp_path):
    """Whoever waits behind its fit gets an answer, too."""

    async def through():
        running = fits.Fits()
        try:
            await running.warm_up()
            before, running.longest = await running.run(os.getpid), 1.0
            hung = asyncio.create_task(running.run(stopped, tmp_path / "known"))
            await asyncio.sleep(0.5)
            running.longest = 60.0
            return before, await running.run(os.getpid), await hung
        finally:
            running.close()

    before, behind, after = asyncio.run(asyncio.wait_for(through(), 120.0))
    assert before != behind == after

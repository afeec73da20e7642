"""Jobs without a cluster: what may be one, how one goes on, its process, its folder."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from commandline import TINY
from hypothesis import given, settings
from hypothesis import strategies as st
from jobs import holder

from pup.errors import InputError
from services.arguments import parser
from services.gateway.jobs import Job, JobState, Seen, Status, reconciled
from services.job_arguments import VERBS, command
from services.job_folder import REVOKED, JobFolder, Order, Outcome, below, folder_of, turn

OUT = Path("/shared/jobs/job-1/out")
FIT = ("recordings", "--robot", "servo_bench")


@pytest.fixture
def shared(tmp_path):
    (tmp_path / "recordings").mkdir()
    return tmp_path


def refusal(*given, shared=None):
    with pytest.raises(InputError) as caught:
        command(*given, OUT, 1, shared)
    return str(caught.value)


def test_a_job_joins_the_cluster_and_writes_to_its_folder():
    told = command("presysid", FIT, OUT, 2)
    assert told == ["presysid", *FIT, "--out", str(OUT), "--address", "auto", "--cores", "2"]
    told = command("presysid", (*FIT, "--local", "--cores", "3"), OUT, 2)
    assert told == ["presysid", *FIT, "--local", "--cores", "3", "--out", str(OUT)]
    assert "--address" not in command("replay", FIT, OUT)
    assert "--cores" not in command("train", ("--runners", "2"), OUT)


@pytest.mark.parametrize(
    ("verb", "arguments", "words"),
    [
        ("serve", (), "cannot be a job"),
        ("transfer", ("--policy", "x", "--study", "y"), "cannot be a job"),
        ("presysid", (), "required"),
        ("presysid", (*FIT, "--generations", "0"), "is not between"),
        ("presysid", (*FIT, "--nonsense"), "unrecognized"),
        ("presysid", (*FIT, "--out", "elsewhere"), "--out"),
        ("presysid", (*FIT, "--ou", "elsewhere"), "--out"),
        ("presysid", (*FIT, "--address", "10.0.0.1:6379"), "--address"),
        ("presysid", (*FIT, "--json"), "--json"),
        ("presysid", ("--help",), "no job"),
        ("presysid", (*FIT, "--"), "'--'"),
        ("presysid", (*FIT, "a\nb"), "cannot be printed"),
        ("presysid", ("x",) * 257, "more than 256"),
        ("presysid", ("x" * 1025,), "more than"),
        ("record", ("step", "--robot", "servo_bench", "--virtual", "--truth", "t.json"), "--truth"),
        ("; rm -rf /", (), "cannot be a job"),
    ],
)
def test_what_the_verb_would_refuse_is_no_job(verb, arguments, words):
    assert words in refusal(verb, arguments)


@pytest.mark.parametrize(
    "arguments",
    [
        ("/etc", "--robot", "servo_bench"),
        ("../recordings", "--robot", "servo_bench"),
        ("recordings/../../x", "--robot", "servo_bench"),
        ("link", "--robot", "servo_bench"),
        ("absent", "--robot", "servo_bench"),
        ("recordings", "--robot", "/tmp"),
        ("recordings", "--robot", "../robot"),
    ],
)
def test_paths_stay_in_the_shared_storage(shared, arguments):
    (shared / "link").symlink_to("/etc")
    assert "is not in the shared storage" in refusal("presysid", arguments, shared=shared)


def test_paths_within_may_be_written_either_way(shared):
    for path in ("recordings", "./recordings", str(shared / "recordings")):
        assert command("presysid", (path, *FIT[1:]), OUT, 1, shared)


def test_every_option_of_a_job_that_names_a_file_is_known_as_a_path():
    """A new option of a verb that takes a file as mere text would escape the check."""
    texts = {"robot", "robot_name", "motion", "notes", "joints", "state_topic", "command_topic"}
    texts |= {"format", "motions", "address", "track", "fitted_to", "repeat_of"}
    verbs = next(a for a in parser()._actions if a.dest == "name").choices
    for verb in VERBS:
        for action in verbs[verb]._actions:
            if action.type is None and action.nargs != 0 and not action.choices:
                assert action.dest in texts, (verb, action.dest)


NEW = Job("job-1", "presysid", FIT, "ann", 0.0, retries=2).attempted(1.0)
SEEN = st.builds(
    Seen,
    st.sampled_from(Status),
    st.sampled_from(["", "Job is running.", "a\nlast line"]),
    st.sampled_from([None, 0, 1, 2, REVOKED, 130]),
    st.booleans(),
)
OUTCOMES = st.none() | st.builds(Outcome, st.just(1), st.sampled_from([0, 1, 2, 75, 130, 137]))
LOOKS = st.lists(st.tuples(SEEN, OUTCOMES, st.booleans(), st.booleans()), max_size=30)


@settings(max_examples=300)
@given(LOOKS)
def test_whatever_is_seen_a_job_keeps_to_its_rules(looks):
    """States that are final stay; attempts end once and in order; failures stay within retries."""
    job, now = NEW, 1.0
    for seen, outcome, claimed, cancel in looks:
        now += 1.0
        if job.state is JobState.QUEUED:
            job = job.attempted(now)
        if cancel:
            job = job.cancel("ann")
        if not job.open:
            break
        before = job
        job = reconciled(job, seen, outcome, claimed, now)
        assert job.attempts[:-1] == before.attempts[:-1]
        ended = [a.ended is not None for a in job.attempts]
        assert all(ended[:-1]) and ended[-1] == (not job.open or job.state is JobState.QUEUED)
        assert job.failures <= job.retries + 1
        assert (job.state is JobState.CANCELLING) <= bool(job.cancelled_by)
        if outcome and outcome.exit == 0:
            assert job.state is JobState.SUCCEEDED
        if job.state is JobState.SUCCEEDED:
            assert (outcome and outcome.exit == 0) or seen.status is Status.SUCCEEDED
        if job.cancelled_by:
            assert job.state is not JobState.QUEUED
        if seen.status is Status.AWAY and outcome is None:
            assert job == before
    if job.cancelled_by and job.open:
        gone = reconciled(job.known(), Seen(Status.UNKNOWN), None, True, now)
        assert gone.state is JobState.CANCELLED


def test_attempts_are_made_until_there_are_no_more_retries():
    job, lost, now = NEW, Seen(Status.UNKNOWN), 10.0
    for failures in (1, 2):
        job = reconciled(job.known(), lost, None, True, now)
        assert (job.state, job.failures, job.due > now) == (JobState.QUEUED, failures, True)
        now = job.due
        job = job.attempted(now)
    job = reconciled(job.known(), lost, None, True, now)
    assert job.state is JobState.LOST and "head restarted" in job.reason
    again = job.again("ann")
    assert (
        again.state is JobState.QUEUED
        and again.failures == 0
        and again.attempted(0).last.number == 4
    )


def test_a_clock_that_is_put_back_keeps_no_job_waiting():
    job = reconciled(NEW.known(), Seen(Status.UNKNOWN), None, True, 10_000.0)
    assert job.waits(10_002.0) == 3.0
    assert job.waits(10_005.0) == job.waits(9000.0) == 0.0


def test_what_was_lost_after_long_work_is_tried_again_and_again():
    job, lost, now = NEW, Seen(Status.UNKNOWN), 10.0
    for lasted in (700.0, 700.0, 700.0, 30.0):
        job = reconciled(job, Seen(Status.RUNNING), None, True, now)
        job = reconciled(job, lost, None, True, now + lasted)
        assert (job.state, job.failures) == (JobState.QUEUED, 1 + (lasted < 600))
        now = job.due
        job = job.attempted(now)
    job = reconciled(job, Seen(Status.RUNNING), None, True, now)
    ended = reconciled(job, Seen(Status.FAILED, "killed", 137), None, True, now + 700)
    assert ended.state is JobState.FAILED  # by its own process, whose memory was too small, say


def test_bad_input_is_not_tried_again_and_waiting_costs_no_retry():
    failed = reconciled(NEW, Seen(Status.FAILED, "x\nno such robot", 2), None, True, 2.0)
    assert (failed.state, failed.reason) == (JobState.FAILED, "no such robot")
    late = reconciled(NEW, Seen(Status.FAILED, "", None, True), None, False, 2.0)
    assert late.state is JobState.QUEUED and late.failures == 0


def test_an_outcome_in_shared_storage_goes_before_a_cluster_that_forgot():
    done = reconciled(NEW.known(), Seen(Status.UNKNOWN), Outcome(1, 0), True, 2.0)
    assert done.state is JobState.SUCCEEDED
    away = reconciled(NEW.cancel("ann"), Seen(Status.AWAY), Outcome(1, 130), True, 2.0)
    assert away.state is JobState.CANCELLED


def order(folder, attempt, *command, stop=False, fresh=False):
    folder.write_order(Order(folder.path.name, attempt, stop, fresh, [str(c) for c in command]))


def runner(folder, attempt):
    command = [sys.executable, "-m", "services.job_runner", str(folder.path), str(attempt)]
    return subprocess.Popen(command, stderr=subprocess.DEVNULL)


@pytest.fixture
def folder(shared, bench_recordings):
    (shared / "recordings").rmdir()
    (shared / "recordings").symlink_to(bench_recordings)
    made = folder_of(shared, "job-1")
    made.path.mkdir(parents=True)
    return made


def replay(folder):
    return ("replay", "recordings", "--robot", "servo_bench", "--cores", "1", "--out", folder.out)


def endless(folder):
    fit = ("--local", "--cores", "1", "--population", "4", "--generations", "100000")
    return ("presysid", *FIT, *fit, "--out", folder.out)


def test_a_process_runs_its_verb_once_and_says_how_it_ended(folder):
    order(folder, 1, *map(str, replay(folder)), fresh=True)
    (folder.out / "old").mkdir(parents=True)
    assert runner(folder, 1).wait(120) == 0
    outcome = folder.outcome(1)
    assert (
        outcome.exit == 0
        and outcome.artifacts == folder.digests()
        and "old" not in os.listdir(folder.out)
    )
    assert "replay.json" in outcome.artifacts and folder.log.read_text().startswith("attempt 1 on ")
    assert runner(folder, 1).wait(60) == REVOKED
    assert runner(folder, 2).wait(60) == REVOKED
    order(folder, 2, "replay", "absent", "--robot", "servo_bench", "--out", str(folder.out))
    assert runner(folder, 2).wait(60) == 2
    assert "absent" in folder.outcome(2).told


def test_a_lock_that_a_node_left_behind_holds_no_attempt_up(folder):
    """It comes to where the verb has its folder, and refuses its input there."""
    folder.out.mkdir()
    start = folder.out / "bounds.json"
    start.write_text("{}")
    order(folder, 1, "presysid", *FIT, *TINY, "--start", start, "--out", folder.out)
    with holder(folder.out):
        assert runner(folder, 1).wait(120) == 2, folder.tail(4096)
    assert "lies in the folder that is written to" in folder.outcome(1).told


def test_a_file_in_the_shared_storage_is_no_library(folder):
    (folder.shared / "random.py").write_text("raise SystemExit('a stranger')")
    order(folder, 1, *map(str, replay(folder)))
    assert runner(folder, 1).wait(120) == 0, folder.tail(4096)


def wait_until(true, seconds=300.0):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.05)


def children(pid):
    text = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    return [int(word) for word in text.split()]


@pytest.mark.parametrize("how", ["order", "signal", "kill"])
def test_however_it_is_stopped_nothing_lives_on(folder, how):
    order(folder, 1, *map(str, endless(folder)))
    process = runner(folder, 1)
    wait_until(lambda: "fits: 0%" in folder.tail(4096))
    verbs = children(process.pid)
    assert verbs
    if how == "order":
        folder.revoke()
    else:
        process.send_signal(signal.SIGTERM if how == "signal" else signal.SIGKILL)
    code = process.wait(60)
    wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in verbs))
    assert (folder.outcome(1) is None) == (how == "kill")
    if how != "kill":
        assert code == folder.outcome(1).exit == 130
    assert list((folder.out / "checkpoints").rglob("*.npz")) or how == "kill"


def test_an_attempt_waits_until_the_one_before_is_silent(folder):
    order(folder, 1, *map(str, endless(folder)))
    first = runner(folder, 1)
    wait_until(lambda: "fits: 0%" in folder.tail(4096))
    first.send_signal(signal.SIGSTOP)  # as behind a cut: it neither beats nor ends
    order(folder, 2, *map(str, replay(folder)))
    began = time.monotonic()
    second = runner(folder, 2)
    assert second.wait(120) == 0 and time.monotonic() - began > 9
    first.send_signal(signal.SIGCONT)
    assert first.wait(60) == 130  # the order names another one
    assert folder.outcome(2).exit == 0


def test_names_lead_to_artefacts_and_nowhere_else(tmp_path):
    folder = JobFolder(tmp_path / "jobs" / "job-1")
    (folder.out / "sub").mkdir(parents=True)
    for name in ("a.json", "sub/b c.npz", ".a.json.part"):
        (folder.out / name).write_text(name)
    (tmp_path / "secret").write_text("x")
    (folder.out / "link").symlink_to(tmp_path / "secret")
    (folder.out / "way").symlink_to(tmp_path)
    assert [name for name, _ in folder.files()] == ["a.json", "sub/b c.npz"]
    for name in ("a.json", "sub/b c.npz"):
        assert folder.file(name) == folder.out / name
    wrong = ("", ".", "..", "../log.txt", "sub", "sub/../a.json", "/etc/hostname", "link", "absent")
    wrong += ("way/secret", "sub//b c.npz", ".a.json.part", "a.json\0", "..\\secret", "./a.json")
    for name in wrong:
        assert folder.file(name) is None, name


def test_files_come_in_the_order_that_pages_go_on_in(tmp_path):
    for name in ("b", "a/c", "a-b/d", "a/b/e", "a/b.x", "ä", "a b/f", "B/g"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    names = [name for name, _ in below(tmp_path)]
    assert len(names) == 8 and names == sorted(names, key=turn)


def test_the_tail_of_a_log_begins_with_a_line(tmp_path):
    folder = JobFolder(tmp_path)
    assert folder.tail(10) == "" and folder.last_line() == ""
    folder.log.write_bytes("first\nsecönd\nthird\n".encode())
    assert folder.tail(10) == "third\n" and folder.last_line() == "third"
    assert folder.tail(10**6).startswith("first")


FILES = {
    "order.json": {"job": "j", "attempt": 1, "stop": False, "fresh": True, "command": ["replay"]},
    "beat.json": {"attempt": 1, "count": 7},
    "outcome-1.json": {"attempt": 1, "exit": 0, "told": "done", "artifacts": {"a": "5e"}},
}


def filled(path, **changed):
    """A folder with a file of each kind; a change of a field goes to all files that have it."""
    for name, told in FILES.items():
        told = {"schema": 1} | told | {k: v for k, v in changed.items() if k in told or k == "new"}
        (path / name).write_text(json.dumps({k: v for k, v in told.items() if v is not ...}))
    return JobFolder(path)


@pytest.mark.parametrize("changed", [{}, {"new": {"of": "a newer program"}}])
def test_what_a_newer_program_adds_to_the_files_of_a_job_is_left_out(tmp_path, changed):
    folder = filled(tmp_path, **changed)
    assert folder.order() == Order(**FILES["order.json"])
    assert folder.heard() == (1, 7)
    assert folder.outcome(1) == Outcome(**FILES["outcome-1.json"])


@pytest.mark.parametrize("wrong", [..., None, "1", 1.0, True, [1], {"a": 1}])
def test_files_of_a_job_of_another_shape_are_as_good_as_unreadable(tmp_path, wrong):
    folder = filled(tmp_path, attempt=wrong)
    assert folder.outcome(1) is None and folder.heard() is None
    with pytest.raises(InputError, match=r"order.json: attempt is "):
        folder.order()
    with pytest.raises(OSError, match=r"order.json: attempt is "):  # it may hold a process
        folder.revoke()


@pytest.mark.parametrize(
    "changed",
    [{"artifacts": {"a": 1}}, {"artifacts": ["a"]}, {"told": None}, {"exit": False}, {"exit": ...}],
)
def test_an_outcome_holds_what_is_read_of_it(tmp_path, changed):
    assert filled(tmp_path, **changed).outcome(1) is None


@pytest.mark.parametrize("changed", [{"command": "replay"}, {"command": ["a", 1]}, {"stop": 0}])
def test_an_order_holds_what_is_read_of_it(tmp_path, changed):
    with pytest.raises(InputError, match="is of another type"):
        filled(tmp_path, **changed).order()


@pytest.mark.parametrize("text", ["[]", "1", "null", "{}", '{"schema": 2}', '{"schema": []}'])
def test_json_that_is_no_file_of_a_job_is_refused(tmp_path, text):
    for name in FILES:
        (tmp_path / name).write_text(text)
    folder = JobFolder(tmp_path)
    assert folder.outcome(1) is None and folder.heard() is None
    with pytest.raises(InputError, match="not of schema 1"):
        folder.order()

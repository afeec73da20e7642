"""A whole job that is killed again and again ends as one that nobody disturbed.

`pup run` runs once undisturbed. Then the same runs in another folder and is killed (SIGKILL) after
times drawn evenly up to a fifth of what the first one took; after each kill no process of it may
be left. At the end all that both found is compared, to the last bit.

    python -m benchmarks.kills --kills 10 --out kills -- --trials 6 --repeats 2

What stands behind `--` is passed on to `pup run`. A folder that holds an undisturbed run is not
run again.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

from pup.files import read_json, sha256, write_json
from workers import reaper

PATIENCE = 60.0
"""For the processes of a killed job to end, s; the machine may be busy."""
LONGEST = 1 / 5
"""Share of the undisturbed run's time that the job lives at most until it is killed."""
UNALIKE = frozenset(
    {"seconds", "processor_seconds", "provenance", "corrected_robot", "model", "video", "policy"}
    | {"attempt", "recording", "digest", "policy_sha256", "seconds_sampling", "seconds_learning"}
)
"""What tells of times, places and attempts, or carries their hashes."""
EXACT = ("train/policy/weights.npz", "corrected/train/policy/weights.npz")
STAGES = "presysid/bounds.json", "replay/replay.json", "walk/replay.json", "transfer/transfer.json"
FOUND = ("diagnosis/diagnosis.json", *STAGES, *(f"corrected/{name}" for name in STAGES))


def start(out: Path, arguments: list[str], mark: str) -> "subprocess.Popen[bytes]":
    """`pup run` with all of its processes marked, and its words in a file."""
    out.mkdir(parents=True, exist_ok=True)
    with (out / "log").open("ab") as log:
        return subprocess.Popen(
            [sys.executable, "-m", "services.cli", "run", *arguments, "--out", str(out / "job")],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env=os.environ | {"PUP_KILLS": mark},
            start_new_session=True,
        )


def undisturbed(out: Path, arguments: list[str]) -> float:
    """Seconds that the undisturbed run took."""
    told = out / "took.json"
    if not told.exists():
        begin = time.monotonic()
        code = start(out, arguments, "whole").wait()
        if code:
            raise SystemExit(f"the undisturbed run failed with {code}, see {out / 'log'}")
        write_json(told, {"seconds": time.monotonic() - begin})
    return float(read_json(told)["seconds"])


def stage(job: Path) -> str:
    """The stage that has begun and is not done."""
    journal = job / "run.json"
    done = list(read_json(journal)["stages"]) if journal.exists() else []
    return f"after {done[-1]}" if done else "presysid"


def killed(out: Path, arguments: list[str], lives: list[float]) -> list[dict[str, Any]]:
    """Run and kill the job until it ends by itself; tells where each kill struck."""
    struck = []
    for i, life in enumerate(lives):
        mark = f"kill{i}"
        process = start(out, arguments, mark)
        try:
            process.wait(life)
        except subprocess.TimeoutExpired:
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
        else:
            break
        struck.append({"after": round(life, 1), "stage": stage(out / "job"), "left": left(mark)})
        print(struck[-1], flush=True)
    return struck


def left(mark: str) -> int:
    """Processes of a killed job that are still there after a while."""
    deadline = time.monotonic() + PATIENCE
    while (there := reaper.marked(f"PUP_KILLS={mark}")) and time.monotonic() < deadline:
        time.sleep(0.2)
    return len(there)


def alike(value: Any) -> Any:
    """A document without what tells of times, places and attempts."""
    if isinstance(value, dict):
        return {k: alike(v) for k, v in value.items() if k not in UNALIKE}
    return [alike(one) for one in value] if isinstance(value, list) else value


def results(job: Path) -> dict[str, str]:
    """What a job found, as text, by file."""
    told = {name: sha256(job / name) for name in EXACT if (job / name).exists()}
    for name in FOUND:
        if (job / name).exists():
            told[name] = json.dumps(alike(read_json(job / name)), sort_keys=True)
    return told


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=10, metavar="N")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of the moments")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("arguments", nargs="*", metavar="ARG", help="of pup run")
    options = parser.parse_args()
    took = undisturbed(options.out / "whole", options.arguments)
    print(f"undisturbed: {took:.0f} s", flush=True)
    rng = random.Random(options.seed)
    lives = [rng.uniform(0, took * LONGEST) for _ in range(options.kills)]
    begin = time.monotonic()
    struck = killed(options.out / "parts", options.arguments, lives)
    code = start(options.out / "parts", options.arguments, "last").wait()
    lasted = time.monotonic() - begin
    wanted, found = (results(options.out / name / "job") for name in ("whole", "parts"))
    other = sorted(n for n in wanted.keys() | found.keys() if wanted.get(n) != found.get(n))
    told = {
        "code": code,
        "undisturbed_s": round(took, 1),
        "with_kills_s": round(lasted, 1),
        "struck": struck,
        "stages": Counter(one["stage"] for one in struck),
        "left": sum(one["left"] for one in struck),
        "compared": sorted(wanted),
        "other": other,
    }
    write_json(options.out / "kills.json", told)
    print(json.dumps(told, indent=1))
    raise SystemExit(bool(code or other or told["left"]))


if __name__ == "__main__":
    main()

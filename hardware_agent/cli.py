"""The command line `pup-agent`: runs the agent, and talks to the one that runs."""

import argparse
import json
import logging
import math
import os
import re
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hardware_agent.config import Settings
from hardware_agent.control import Unreachable, say
from pup.errors import InputError
from pup.files import MISTAKES
from pup.usage import Usage

DONE, FAILED, REFUSED = 0, 1, 2
PLACE, VARIABLE = "/etc/pup-agent/agent.toml", "PUP_AGENT_CONFIG"
SCRIPTS = "file of `pup record --scripts`, or a folder of them, played in the order of their names"
SETUP = "what was changed on the robot, by its knobs; kept with the recordings"
MOST = 100  # repeats of a script


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb.

    Returns:
      0 done or healthy, 1 unhealthy or failed, 2 bad input or usage.
    """
    options = _parser().parse_args(arguments)
    try:
        return int(VERBS[options.verb](options))
    except InputError as error:
        print(f"pup-agent {options.verb}: {' '.join(str(error).splitlines())}", file=sys.stderr)
        return REFUSED
    except OSError as error:  # of the storage: it may pass
        print(f"pup-agent {options.verb}: {' '.join(str(error).splitlines())}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        return FAILED


def _parser() -> argparse.ArgumentParser:
    whole = Usage(
        prog="pup-agent",
        description="Runs trials on a robot, and keeps it whole.",
        epilog=f"Without --config, the file that the variable {VARIABLE} names is used, or "
        f"{PLACE}. `pup-agent VERB --help` tells the options of a verb.",
    )
    place = os.environ.get(VARIABLE, PLACE)
    verbs = whole.add_subparsers(required=True, dest="verb", metavar="VERB")
    for name, told in (
        ("run", "run the agent; the robot does not move until it is enabled"),
        ("enable", "torque on, holding the pose that the robot is in"),
        ("disable", "torque off, also when no agent runs; the robot goes limp"),
        ("stop", "emergency stop: torque off at once, also when no agent runs"),
        ("health", "tell how the agent is; exit code 0 when it is well, 1 when not"),
        ("operate", "stand at the robot: start trials, stop them, type distances"),
        ("arm", "let the trial that waits start"),
        ("skip", "do not run the trial that waits"),
        ("distance", "tell how far the robot came, in metres"),
        ("play", "play scripts and record them; whoever stands at the robot agrees to each"),
        ("keys", "make a pair of CURVE keys for the link"),
    ):
        verb = verbs.add_parser(name, help=told, description=f"{told[0].upper()}{told[1:]}.")
        verb.add_argument(
            "--config",
            type=Path,
            default=Path(place),
            metavar="FILE",
            help=f"default: the variable {VARIABLE}, or {PLACE}; now %(default)s",
        )
        if name == "health":
            verb.add_argument("--json", action="store_true", help="print one JSON object")
        elif name == "distance":
            verb.add_argument("metres", type=float)
        elif name == "play":
            verb.add_argument("scripts", type=Path, nargs="+", metavar="SCRIPT", help=SCRIPTS)
            verb.add_argument("--repeats", type=int, default=1, metavar="N", help="of each script")
            verb.add_argument("--auto", action="store_true", help='ask nobody; needs gate = "auto"')
            verb.add_argument(
                "--setup", nargs="+", action="extend", default=[], metavar="KNOB=NUMBER", help=SETUP
            )
        elif name == "keys":
            verb.add_argument("name", help="of the files NAME.key and NAME.key_secret")
            verb.add_argument("--out", type=Path, required=True, metavar="DIR")
    return whole


def _run(options: argparse.Namespace) -> int:
    from hardware_agent.config import check_together
    from hardware_agent.daemon import Agent

    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    settings = Settings.read(options.config)
    check_together(settings, options.config)
    agent = Agent(settings)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: agent.end())
    agent.run()
    return DONE


def _say(do: str, **more: Any) -> Any:
    def verb(options: argparse.Namespace) -> int:
        told = say(Settings.read(options.config).socket, {"do": do, **more})
        if told:
            print(told.get("state", json.dumps(told)))
        return DONE

    return verb


def _distance(options: argparse.Namespace) -> int:
    say(Settings.read(options.config).socket, {"do": "distance", "distance": options.metres})
    return DONE


def _limp(options: argparse.Namespace) -> int:
    from hardware_agent.stopping import make_limp

    return DONE if make_limp(options.config, options.verb) else FAILED


def _health(options: argparse.Namespace) -> int:
    try:
        told = say(Settings.read(options.config).socket, {"do": "health"})
    except Unreachable as error:
        if options.json:
            print(json.dumps({"problems": [str(error)]}))
        else:
            print(error, file=sys.stderr)
        return FAILED
    if options.json:
        print(json.dumps(told, allow_nan=False))
    else:
        _show(told)
    return FAILED if told["problems"] else DONE


def _show(told: dict[str, Any]) -> None:
    loop, hottest = told["loop"], told.get("hottest", {})
    print(f"{told['agent']} ({told['robot']}): {told['state']} {told['reason']}".rstrip())
    if loop["period_p99"] is not None:
        print(
            f"loop: {loop['ticks']} ticks, {loop['missed']} missed, period "
            f"{1000 * loop['period_p50']:.2f} ms, p99 {1000 * loop['period_p99']:.2f} ms"
        )
    if hottest:
        print(f"supply {told['supply']} V; {hottest['joint']} {hottest['temperature']} °C")
    bus = told["bus"]
    print(f"bus: {bus['repeated']} questions repeated, {bus['lost']} answers lost")
    print(f"trial: {told['trial']} {told['stage']} {told['waiting']}".rstrip())
    for problem in told["problems"]:
        print(f"PROBLEM: {problem}")


def _operate(options: argparse.Namespace) -> int:
    from hardware_agent.prompt import operate

    return operate(Settings.read(options.config).socket)


def _play(options: argparse.Namespace) -> int:
    from hardware_agent.playing import play

    if not 1 <= options.repeats <= MOST:
        raise InputError(f"--repeats: {options.repeats} is not 1 to {MOST}")
    setup = _knobs(options.setup)
    files = [
        f for at in options.scripts for f in (sorted(at.glob("*.json")) if at.is_dir() else [at])
    ]
    if not files:
        raise InputError(f"{options.scripts[0]}: no *.json in this folder")
    socket = Settings.read(options.config).socket
    return play(socket, files, options.repeats, options.auto, setup)


def _knobs(told: Sequence[str]) -> dict[str, float]:
    """What `--setup` says; the agent knows which knobs there are."""
    setup: dict[str, float] = {}
    for text in told:
        name, _, value = text.partition("=")
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not name or not math.isfinite(number):
            raise InputError(f"--setup: {text!r} is not KNOB=NUMBER")
        if name in setup:
            raise InputError(f"--setup: {name} is told twice")
        setup[name] = number
    return setup


def _keys(options: argparse.Namespace) -> int:
    import zmq.auth

    from pup.wire import NAME

    if not re.fullmatch(NAME, options.name):
        raise InputError(
            f"{options.name[:70]!r} is no name: use 1 to 63 letters, digits, '-', '_' and '.'"
        )
    secret = options.out / f"{options.name}.key_secret"
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        if secret.exists():
            raise InputError(f"{options.out}: there are keys of this name; use another")
        made = zmq.auth.create_certificates(options.out, options.name)
        os.chmod(secret, 0o600)
    except MISTAKES as error:
        raise InputError(f"--out: {error.filename}: {error.strerror}") from error
    for file in made:
        print(file)
    return DONE


VERBS = {
    "run": _run,
    "enable": _say("enable"),
    "disable": _limp,
    "stop": _limp,
    "health": _health,
    "operate": _operate,
    "arm": _say("arm"),
    "skip": _say("skip"),
    "distance": _distance,
    "play": _play,
    "keys": _keys,
}


if __name__ == "__main__":
    sys.exit(main())

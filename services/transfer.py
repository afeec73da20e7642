"""The job behind `pup transfer`: a study on a running gateway, followed to its end."""

import os
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from pup.errors import InputError
from pup.files import read_json, sha256, write_json
from pup.policy.bundle import CARD, NumpyPolicy, PolicyCard
from pup.transfer.study import Gate
from services.gateway.keys import check_name

SCHEMA = 1
FILE = "study.json"
PERIOD = 1.0
"""Between two looks at the study, s."""
TIMEOUT = 30.0
PATIENCE = 3600.0
"""For a gateway that does not answer, once it has, s."""
Told = Callable[[str], None]
Tend = Callable[["Gateway", dict[str, Any]], None]
"""Sees to a study, given as the gateway tells it, whenever it is looked at."""


@dataclass(frozen=True)
class Wanted:
    """What is asked of the gateway.

    Attributes:
      policy: folder of the bundle.
      study: name.
      url: of the gateway.
      token: of an operator.
      settings: of the study, where they differ from the defaults.
      simulated: rollouts in simulation to start from, or None.
    """

    policy: Path
    study: str
    url: str
    token: str
    settings: dict[str, Any]
    simulated: dict[str, Any] | None = None


class Gateway:
    """A gateway over HTTP; requests are repeated, with the same key, while it is away.

    Args:
      url: of the service.
      token: bearer token.
      told: hears why it waits.
    """

    def __init__(self, url: str, token: str, told: Told) -> None:
        if not url.startswith(("http://", "https://")):
            raise InputError(f"--url: {url[:60]!r} does not begin with http:// or https://")
        headers = {"Authorization": f"Bearer {token}"}
        self.url, self.told, self.met = url, told, False
        try:
            self.http = httpx.Client(base_url=url, headers=headers, timeout=TIMEOUT)
        except (httpx.InvalidURL, ValueError, UnicodeEncodeError) as error:
            raise InputError(f"--url or token: cannot be used ({error})") from error

    def get(self, path: str, **query: Any) -> Any:
        """The answer to a GET."""
        return self._ask("GET", path, params=query)

    def post(self, path: str, body: Any, key: str | None = None) -> Any:
        """The answer to a POST, which is carried out once for each key."""
        headers = {"Idempotency-Key": key or uuid.uuid4().hex}
        return self._ask("POST", path, json=body, headers=headers)

    def all(self, path: str, of: str) -> list[Any]:
        """All pages of a list."""
        found, after = [], None
        while True:
            page = self.get(path, **({} if after is None else {"after": after}))
            found += page[of]
            if (after := page["next"]) is None:
                return found

    def _ask(self, method: str, path: str, **options: Any) -> Any:
        began, pause = time.monotonic(), 0.25
        while True:
            try:
                answer = self.http.request(method, path, **options)
                if not (why := away(answer)):
                    break
                self.met = self.met or "Retry-After" in answer.headers
            except httpx.ReadTimeout as error:  # somebody is there, and slow
                why, self.met = str(error), True
            except httpx.HTTPError as error:
                why = str(error) or type(error).__name__
            except ValueError as error:  # a key beyond ASCII, a number that JSON does not know
                raise InputError(f"what was given cannot be sent ({error})") from error
            if not self.met or time.monotonic() - began > PATIENCE:
                raise InputError(
                    f"{self.url}: no gateway answers ({why}); start one with `pup serve`, or say "
                    "where it is with --url"
                )
            self.told(f"the gateway does not answer ({why}); waiting")
            time.sleep(pause)
            pause = min(2 * pause, 5.0)
        self.met = True
        if answer.status_code >= 400:
            raise InputError(f"{self.url}: {detail(answer)}")
        try:
            return answer.json()
        except ValueError as error:
            raise InputError(f"{self.url}: not a gateway of pup; its answer is no JSON") from error


def away(answer: httpx.Response) -> str:
    """Why an answer is none yet, in words; empty where it is one, or waiting would not help."""
    if "Retry-After" in answer.headers:
        return detail(answer)
    # The gateway itself says by a problem that it cannot; what stands before it does not.
    kind = answer.headers.get("content-type", "")
    itself = answer.status_code == 503 and kind == "application/problem+json"
    return "" if answer.status_code < 500 or itself else f"it answers {answer.status_code}"


def detail(answer: httpx.Response) -> str:
    """What an answer says of an error."""
    try:
        told = answer.json()
        return str(told["detail"]) or str(told["title"])
    except (ValueError, KeyError, TypeError):
        return f"it answers {answer.status_code}"


def token_of(given: str | None) -> str:
    """The token: of the file named by the option, or of the environment.

    Raises:
      InputError: there is none.
    """
    if given:
        try:
            token = Path(given).read_text(encoding="utf-8").strip()
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"--token-file: {given} cannot be read") from error
    else:
        token = os.environ.get("PUP_TOKEN", "").strip()
    if not token:
        raise InputError("no token; set PUP_TOKEN or give --token-file FILE")
    if not token.isascii() or not token.isprintable():
        place = f"--token-file: {given}" if given else "PUP_TOKEN"
        raise InputError(f"{place}: no token, which is one line of letters, digits, '-' and '_'")
    return token


def transfer(
    wanted: Wanted, out: Path, told: Told, tend: Tend = lambda gateway, study: None
) -> dict[str, Any]:
    """Make or join a study and follow it; write `study.json` as it goes on.

    Args:
      wanted: the study.
      out: folder for the file.
      told: hears how far it is.
      tend: takes an operator's place.

    Returns:
      The document of `study.json`.

    Raises:
      InputError: the policy, the gateway or a setting cannot be used, or the folder has another
        study's file.
    """
    check_name(wanted.study)
    policy = NumpyPolicy.load(wanted.policy)
    card = policy.card
    if not card.eta_lower:
        raise InputError(
            f"{wanted.policy}: is a {card.method} policy, conditioned on nothing, so that there is "
            "no eta to search; give one of `pup train --method pup` or `up`"
        )
    digest = sha256(wanted.policy / CARD)
    begun = _begun(out / FILE, wanted.study, digest)
    _check_rivals(card, wanted.settings.get("compare", ()))
    gateway = Gateway(wanted.url, wanted.token, told)
    if begun is not None:
        _check_known(gateway, wanted.study, begun, out / FILE)
    asked = {
        "name": wanted.study,
        "robot": card.robot,
        "policy": digest,
        "lower": list(card.eta_lower),
        "upper": list(card.eta_upper),
    }
    if wanted.simulated is not None:
        asked["simulated"] = wanted.simulated
    study = gateway.post("/v1/studies", asked | wanted.settings)
    told(f"{wanted.url}/studies/{study['name']}")
    place, last = f"/v1/studies/{study['name']}", ""
    while True:
        study = gateway.get(place)
        tend(gateway, study)
        if (line := _line(study)) != last:
            told(line)
            last = line
            document = _document(gateway, study)
            write_json(out / FILE, document)
        if study["state"] == "done":
            return document
        time.sleep(PERIOD)


def _begun(file: Path, study: str, policy: str) -> object:
    """When the study of a file was made; None where there is no file.

    Raises:
      InputError: it is of another study, whose walks may be told nowhere else.
    """
    if not file.exists():
        return None
    told = read_json(file)
    if not isinstance(told, dict) or (told.get("study"), told.get("policy")) != (study, policy):
        raise InputError(f"{file}: is of another study, or of another policy; use another --out")
    try:
        return told["history"][0]["time"]
    except (KeyError, IndexError, TypeError) as error:
        raise InputError(f"{file}: is damaged; restore or delete it") from error


def _check_known(gateway: Gateway, study: str, begun: object, file: Path) -> None:
    """Refuse to write over a study of the same name that another gateway had."""
    try:
        first = gateway.get(f"/v1/studies/{study}/history", limit=1)["events"]
    except InputError as error:
        raise InputError(f"{file}: cannot be gone on with; use another --out ({error})") from error
    if [event["time"] for event in first] != [begun]:
        raise InputError(f"{file}: is of another study of this name; use another --out")


def _check_rivals(card: PolicyCard, compare: Sequence[Sequence[float]]) -> None:
    """Refuse etas to compare that no agent walks, before the search and not after it."""
    for eta in compare:
        try:
            card.check_eta(eta)
        except InputError as error:
            raise InputError(f"--compare: {error}") from error


def read_simulated(file: Path) -> dict[str, Any]:
    """Simulated rollouts from a JSON file: `{"schema": 1, "eta": [...], "distance": [[...], ...]}`.

    Raises:
      InputError: it is none.
    """
    told = read_json(file)
    if not isinstance(told, dict) or told.get("schema") != SCHEMA:
        raise InputError(f"{file}: not simulated rollouts of schema {SCHEMA}")
    if not isinstance(told.get("eta"), list) or not isinstance(told.get("distance"), list):
        raise InputError(f"{file}: needs the lists eta and distance")
    try:
        tables = [np.array(told[name], dtype=np.float64) for name in ("eta", "distance")]
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{file}: eta and distance must be tables of numbers") from error
    if any(table.ndim != 2 or not np.isfinite(table).all() for table in tables):
        raise InputError(f"{file}: eta and distance must be tables of finite numbers")
    return {"eta": told["eta"], "distance": told["distance"]}


def settings_of(options: Any) -> dict[str, Any]:
    """Settings of a study from the command line; what was not given is the gateway's default."""
    names = ("trials", "initial", "least_gain", "repeats", "horizon", "lease", "failures", "agent")
    told = {n: getattr(options, n) for n in (*names, "seed") if getattr(options, n) is not None}
    told["gate"] = (Gate.AUTO if options.auto else Gate.OPERATOR).value
    told["compare"] = [list(eta) for eta in options.compare]
    told["warm_start"] = not options.no_warm_start
    return told


def _line(study: dict[str, Any]) -> str:
    wanted, farthest = study["settings"]["trials"], study["farthest"]
    line = f"{study['name']}: {study['state']}, {study['walks']}/{wanted} walks"
    if farthest is not None:
        line += f", farthest {farthest:.3f} m"
    if study["open"] is not None:
        line += f"; trial {study['open']}"
    why = study["reason"] or study["waits_for"]
    return f"{line}; waits for {why}" if study["waits_for"] else f"{line}; {why}" if why else line


def _document(gateway: Gateway, study: dict[str, Any]) -> dict[str, Any]:
    place = f"/v1/studies/{study['name']}"
    trials = gateway.all(f"{place}/trials", "trials")
    history = gateway.all(f"{place}/history", "events")
    return {
        "schema": SCHEMA,
        "study": study["name"],
        "state": study["state"],
        "robot": study["settings"]["robot"],
        "policy": study["settings"]["policy"],
        "eta": study["chosen"],
        "settings": study["settings"],
        "evaluation": _evaluation(study, trials),
        "posterior": gateway.get(f"{place}/posterior"),
        "trials": trials,
        "history": history,
    }


def _evaluation(study: dict[str, Any], trials: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Distances of the chosen eta and of those compared with it, walked after the choice."""
    told = []
    for purpose, eta in [("repeat", study["chosen"])] + [
        ("compare", eta) for eta in study["settings"]["compare"]
    ]:
        walked = [
            t["distance"]
            for t in trials
            if (t["purpose"], t["eta"], t["state"]) == (purpose, eta, "succeeded")
        ]
        if walked:
            mean = sum(walked) / len(walked)
            told.append({"purpose": purpose, "eta": eta, "distance": walked, "mean": mean})
    return told


def show(shown: dict[str, Any]) -> None:
    """Print the outcome for people."""
    eta = ", ".join(f"{x:+.3f}" for x in shown["eta"] or ())
    print(f"eta: {eta}")
    for part in shown["evaluation"]:
        walks = " ".join(f"{d:.3f}" for d in part["distance"])
        print(f"{part['purpose']}: {part['mean']:.3f} m ({walks})")

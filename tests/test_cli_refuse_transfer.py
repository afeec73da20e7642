"""The command line of serve and transfer: bad input ends with exit code 2, one clear line."""

import json
from pathlib import Path

import agents
import gateways
import pytest
from commandline import pup
from refusals import Cases, Made, Place, assert_refused, check

from pup.policy.shape import Method

pytest.importorskip("fastapi")
pytest.importorskip("botorch")

case = Cases()
KEPT = ("PUP_TOKEN", "PUP_DATA", "PUP_HOST", "PUP_PORT", "PUP_LINK", "PUP_DATABASE", "PUP_LOG")


@pytest.fixture(autouse=True)
def environment(monkeypatch):
    for name in KEPT:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PUP_TOKEN", "pup_anything")


def transfer(place: Place, *options: object) -> list[object]:
    given = ["--study", "walk", "--url", f"http://127.0.0.1:{gateways.free_port()}"]
    return ["transfer", *given, *options, "--out", place.out]


def serve(place: Place, config: str, *options: object) -> list[object]:
    return ["serve", *options, "--config", place.write("gateway.toml", config)]


ANYWHERE = 'data = "service"\nport = 0\nlink = "tcp://127.0.0.1:*"\nlog = "error"\n'
"""Of a gateway that listens before it is refused, as another test's may at the same time."""


def bundle(place: Place) -> Path:
    return agents.bundle(place.here / "policy")


@case("a policy that is not there")
def _(place: Place) -> Made:
    return transfer(place, "--policy", place.here / "none"), ("none", "cannot be read")


@case("a policy that is conditioned on nothing")
def _(place: Place) -> Made:
    policy = agents.bundle(place.here / "policy", method=Method.ROBUST)
    return transfer(place, "--policy", policy), (policy, "robust", "no eta", "--method pup")


@case("a gateway that is not there")
def _(place: Place) -> Made:
    return transfer(place, "--policy", bundle(place)), ("no gateway answers", "pup serve")


@case("an address that is none")
def _(place: Place) -> Made:
    return transfer(place, "--policy", bundle(place), "--url", "robot"), ("--url", "http://")


@case("a name that is none")
def _(place: Place) -> Made:
    return transfer(place, "--policy", bundle(place), "--study", "a/b"), ("'a/b'", "no name")


@case("a file of a token that is not there")
def _(place: Place) -> Made:
    options = ("--policy", bundle(place), "--token-file", "nowhere")
    return transfer(place, *options), ("--token-file", "nowhere")


@case("an empty token")
def _(place: Place) -> Made:
    file = place.write("token", "\n")
    return transfer(place, "--policy", bundle(place), "--token-file", file), ("PUP_TOKEN",)


@case("an eta to compare that is none")
def _(place: Place) -> Made:
    return transfer(place, "--policy", "x", "--compare", "a,b"), ("--compare", "'a,b'")


@case("an eta to compare that nothing projects to")
def _(place: Place) -> Made:
    """Before the search: no agent would walk it after that, and the study would never end."""
    wild = transfer(place, "--policy", bundle(place), "--compare", "0.1,9,0")
    return wild, ("--compare: 0.1,9,0", "outside -1 to 1")


@case("an eta to compare of another length")
def _(place: Place) -> Made:
    wrong = transfer(place, "--policy", bundle(place), "--compare", "0.1,0.2")
    return wrong, ("--compare: 2 numbers", "on 3")


@case("more trials than there can be")
def _(place: Place) -> Made:
    return transfer(place, "--policy", "x", "--trials", 5000), ("--trials", "1000")


@case("simulated rollouts that are none")
def _(place: Place) -> Made:
    file = place.write("simulated.json", json.dumps({"schema": 2}))
    return transfer(place, "--policy", bundle(place), "--simulated", file), (file, "schema 1")


for what, eta in {
    "no numbers": [[0.0, None, 0.0]],
    "no finite numbers": [[0.0, float("nan"), 0.0]],
    "no table": [[0.0, 0.1, 0.2], [0.0]],
    "no rows": [0.0, 0.1, 0.2],
}.items():

    @case(f"simulated rollouts with {what}")
    def _(place: Place, eta: list[object] = eta) -> Made:
        told = {"schema": 1, "eta": eta, "distance": [[0.5]]}
        file = place.write("simulated.json", json.dumps(told))
        given = transfer(place, "--policy", bundle(place), "--simulated", file)
        return given, (file, "eta and distance", "numbers")


@case("a folder with another study")
def _(place: Place) -> Made:
    """Its walks may be told nowhere else."""
    file = place.write("study.json", json.dumps({"schema": 1, "study": "monday", "policy": "0"}))
    given = transfer(place, "--policy", bundle(place))[:-1]
    return [*given, file.parent], (file, "another study", "--out")


@case("a configuration that is not there")
def _(place: Place) -> Made:
    return ["serve", "--config", place.here / "none.toml"], ("none.toml", "cannot be read")


@case("a configuration that is not TOML")
def _(place: Place) -> Made:
    return serve(place, "port = "), ("gateway.toml", "not TOML")


@case("a key that is unknown")
def _(place: Place) -> Made:
    return serve(place, "prot = 1"), ("prot", "unknown", "port")


@case("a port that is none")
def _(place: Place) -> Made:
    return serve(place, "port = 70000"), ("port", "'70000'", "65535")


@case("a link that is none")
def _(place: Place) -> Made:
    return serve(place, 'link = "5555"'), ("link", "'5555'", "tcp://")


@case("a certificate that is not there")
def _(place: Place) -> Made:
    told = serve(place, 'certificate = "none.pem"\nkey = "none.key"')
    return told, ("certificate none.pem", "No such file")


@case("a certificate without its key")
def _(place: Place) -> Made:
    return serve(place, 'certificate = "c.pem"'), ("certificate", "key")


@case("a level of log that is none")
def _(place: Place) -> Made:
    return serve(place, 'log = "loud"'), ("log", "'loud'", "warning")


@case("all addresses without a token")
def _(place: Place) -> Made:
    return serve(place, 'data = "service"\nhost = "0.0.0.0"'), ("no token", "pup serve token")


@case("a database that is none")
def _(place: Place) -> Made:
    return serve(place, ANYWHERE + 'database = "nosuch://x"'), (
        "database",
        "nosuch",
    )


@case("a database in a folder that is not there")
def _(place: Place) -> Made:
    file = place.here / "none" / "gateway.db"
    return serve(place, ANYWHERE + f'database = "sqlite:///{file}"'), (
        "database",
        "unable to open",
    )


@case("a token without a name")
def _(place: Place) -> Made:
    return serve(place, 'data = "service"', "token"), ("token", "NAME")


@case("a token with a name that is none")
def _(place: Place) -> Made:
    return serve(place, 'data = "service"', "token", "../x"), ("'../x'", "no name")


@case("a token that is not there to revoke")
def _(place: Place) -> Made:
    return serve(place, 'data = "service"', "revoke-token", "ann"), ("no token ann",)


@case("an agent without a folder")
def _(place: Place) -> Made:
    return serve(place, 'data = "service"', "agent", "darwin"), ("--out",)


@case("an agent that is not there to revoke")
def _(place: Place) -> Made:
    return serve(place, 'data = "service"', "revoke-agent", "darwin"), ("no agent darwin",)


@pytest.mark.parametrize("name", list(case))
def test_bad_input_is_refused(place: Place, name: str) -> None:
    """Nothing is written."""
    check(place, case[name](place))


def test_a_token_that_is_no_operators_is_refused(tmp_path, monkeypatch):
    policy = agents.bundle(tmp_path / "policy")
    with gateways.running(tmp_path / "data") as service:
        options = ("--policy", policy, "--study", "walk", "--url", service.url, "--out", tmp_path)
        assert_refused(pup("transfer", *options), "bearer token")
        monkeypatch.setenv("PUP_TOKEN", service.tokens["viewer"])
        assert_refused(pup("transfer", *options), "role operator", "viewer")
        assert not (tmp_path / "study.json").exists()


def test_more_initial_trials_than_trials_are_refused(tmp_path, monkeypatch):
    policy = agents.bundle(tmp_path / "policy")
    with gateways.running(tmp_path / "data") as service:
        monkeypatch.setenv("PUP_TOKEN", service.tokens["operator"])
        options = ("--policy", policy, "--study", "walk", "--url", service.url, "--out", tmp_path)
        done = pup("transfer", *options, "--trials", 3, "--initial", 4)
        assert_refused(done, "initial (4) must be at most trials (3)")
        with service.client() as http:
            assert http.get("/v1/studies/walk").status_code == 404
        assert not (tmp_path / "study.json").exists()

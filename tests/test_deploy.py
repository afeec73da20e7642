"""deploy/k8s: manifests that an API server takes, and that say of the code what is true."""

import os
import re
import shlex
import subprocess
import tomllib
from importlib.metadata import version
from pathlib import Path

import kuberay
import pytest
import yaml
from jsonschema import Draft202012Validator
from manifests import (
    K8S,
    KUBERNETES,
    OVERLAYS,
    ROOT,
    Document,
    bytes_of,
    cores_of,
    jobs,
    one,
    overlay,
    pods,
    problems,
    render,
    selects,
)

from services.arguments import parser
from services.cli import main
from services.gateway.app import application
from services.gateway.conductor import Conductor
from services.gateway.config import DATABASE_FILE, PREFIX, Config
from services.gateway.dispatcher import Dispatcher
from services.gateway.fits import Fits
from services.gateway.keys import Tokens
from services.gateway.metrics import Metrics
from services.gateway.store import TRY, Store

IMAGE = re.compile(rf"pup-(gateway|cluster|agent):{re.escape(version('pup'))}(-cuda)?")
USER = 1000
LINK = int(Config.link.rpartition(":")[2])
SHARED = Path("/shared")


def documents(name: str) -> list[Document]:
    return overlay(name) + jobs(name)


@pytest.fixture(scope="module")
def secrets(tmp_path_factory: pytest.TempPathFactory) -> list[Document]:
    """The Secrets, from files made as docs/deploy.md tells."""
    folder = tmp_path_factory.mktemp("secrets")
    (folder / "kustomization.yaml").write_text((K8S / "secrets/kustomization.yaml").read_text())
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PUP_DATA", str(folder))
        assert main(["serve", "token", "ann", "--role", "admin"]) == 0
        assert main(["serve", "agent", "darwin-1", "--out", str(folder / "robot")]) == 0
    for name in ("auth_token", "metrics_token", "database_url"):
        (folder / name).write_text("x")
    return render(folder)


@pytest.mark.parametrize("kubernetes", KUBERNETES)
@pytest.mark.parametrize("name", OVERLAYS)
def test_the_api_server_would_take_every_document(name: str, kubernetes: str) -> None:
    found = [p for document in documents(name) for p in problems(document, kubernetes)]
    assert not found
    assert len(overlay(name)) >= 16 and len(jobs(name)) == 3


@pytest.mark.parametrize("kubernetes", KUBERNETES)
def test_the_api_server_would_take_the_secrets(secrets: list[Document], kubernetes: str) -> None:
    assert not [p for document in secrets for p in problems(document, kubernetes)]


def test_schemas_refuse_what_is_wrong() -> None:
    cluster = one(overlay("gpu"), "RayCluster")
    wrong: list[tuple[Document, str]] = []
    for group in ({"minReplica": 0}, {"maxReplicas": "8"}):
        spec = cluster["spec"]
        workers = [spec["workerGroupSpecs"][0] | group]
        wrong.append((cluster | {"spec": spec | {"workerGroupSpecs": workers}}, "workerGroupSpecs"))
    deployment = one(overlay("gpu"), "Deployment")
    wrong.append((deployment | {"spec": deployment["spec"] | {"replica": 1}}, "replica"))
    policy = one(overlay("gpu"), "NetworkPolicy", "gateway")
    wrong.append((policy | {"spec": policy["spec"] | {"ingres": []}}, "ingres"))
    for document, word in wrong:
        assert word in " ".join(problems(document, KUBERNETES[-1]))


@pytest.mark.skipif(
    "PUP_KUBERAY_CRDS" not in os.environ,
    reason="PUP_KUBERAY_CRDS names no folder with ray-operator/config/crd/bases of KubeRay",
)
@pytest.mark.parametrize("kind", ["RayCluster", "RayJob"])
def test_kuberays_own_definitions_take_every_document(kind: str) -> None:
    file = Path(os.environ["PUP_KUBERAY_CRDS"]) / f"ray.io_{kind.lower()}s.yaml"
    crd = yaml.load(file.read_text(), yaml.CSafeLoader)
    told = [v for v in crd["spec"]["versions"] if v["name"] == "v1"]
    schema = strict(told[0]["schema"]["openAPIV3Schema"])
    held = [d for name in OVERLAYS for d in documents(name) if d["kind"] == kind]
    assert held and not [
        e.message for d in held for e in Draft202012Validator(schema).iter_errors(d)
    ]
    compare(kuberay.SCHEMAS[kind]["properties"]["spec"], schema["properties"]["spec"])


def strict(schema: Document) -> Document:
    """As the API server reads it: no unknown fields, integers where text may stand too."""
    if schema.get("x-kubernetes-int-or-string"):
        return {"type": ["integer", "string"]}
    read = {k: v for k, v in schema.items() if k not in ("properties", "items", "format")}
    if "properties" in schema:
        read["properties"] = {k: strict(v) for k, v in schema["properties"].items()}
        if "metadata" in read["properties"] and "status" in read["properties"]:
            read["properties"]["metadata"] = {"type": "object"}
        read.setdefault("additionalProperties", False)
    if "items" in schema:
        read["items"] = strict(schema["items"])
    return read


def compare(ours: Document, theirs: Document) -> None:
    """Fields of ours are theirs and of the same kind."""
    if "$ref" in ours:
        return
    assert ours["type"] == theirs["type"]
    assert set(ours.get("required", [])) == set(theirs.get("required", []))
    for name, field in ours.get("properties", {}).items():
        compare(field, theirs["properties"][name])
    if ours["type"] == "array":
        compare(ours["items"], theirs["items"])


@pytest.mark.parametrize("name", OVERLAYS)
def test_containers_have_a_pinned_image_of_ours_and_limits(name: str) -> None:
    for pod in pods(documents(name)):
        for container in pod.containers:
            image = IMAGE.fullmatch(container["image"])
            assert image, (pod.where, container["image"])
            assert image[1] == ("gateway" if pod.where == "gateway" else "cluster")
            assert bool(image[2]) == (name == "gpu" and image[1] == "cluster")
            wanted, most = container["resources"]["requests"], container["resources"]["limits"]
            assert wanted["memory"] == most["memory"] and bytes_of(most["memory"]) >= 2**28
            assert 0 < cores_of(wanted["cpu"]) <= cores_of(most["cpu"])


@pytest.mark.parametrize("name", OVERLAYS)
def test_pods_are_restricted(name: str) -> None:
    """Pod Security Standard `restricted`, and more: a root file system that cannot be written."""
    namespace = one(overlay(name), "Namespace")
    assert namespace["metadata"]["labels"]["pod-security.kubernetes.io/enforce"] == "restricted"
    for pod in pods(documents(name)):
        whole = pod.spec["securityContext"]
        assert whole["runAsNonRoot"] is True and whole["seccompProfile"]["type"] == "RuntimeDefault"
        assert whole["runAsUser"] == whole["fsGroup"] == USER
        volumes = {v["name"]: set(v) - {"name"} for v in pod.spec["volumes"]}
        writable = {"emptyDir"}, {"persistentVolumeClaim"}
        for container in pod.containers:
            told = container["securityContext"]
            assert told["allowPrivilegeEscalation"] is False
            assert told["readOnlyRootFilesystem"] is True
            assert told["capabilities"] == {"drop": ["ALL"]}
            mounts = {m["mountPath"]: m for m in container["volumeMounts"]}
            assert volumes[mounts["/tmp"]["name"]] == {"emptyDir"}
            for mount in mounts.values():
                assert mount.get("readOnly") or volumes[mount["name"]] in writable
        told = pod.spec.get("automountServiceAccountToken", True)
        assert told is pod.where.endswith(" head"), pod.where  # its autoscaler needs it


@pytest.mark.parametrize("name", OVERLAYS)
def test_volumes_claims_and_services_are_there(name: str) -> None:
    claims = {d["metadata"]["name"] for d in overlay(name) if d["kind"] == "PersistentVolumeClaim"}
    for pod in pods(documents(name)):
        volumes = {v["name"] for v in pod.spec["volumes"]}
        assert {m["name"] for c in pod.containers for m in c["volumeMounts"]} <= volumes
        used = [v.get("persistentVolumeClaim", {}) for v in pod.spec["volumes"]]
        assert {claim["claimName"] for claim in used if claim} <= claims
    for service in (d for d in overlay(name) if d["kind"] == "Service"):
        led = [
            p
            for p in pods(overlay(name))
            if selects({"matchLabels": service["spec"]["selector"]}, p.labels)
        ]
        assert len(led) == 1
        ports = {p["name"]: p["containerPort"] for p in led[0].containers[0]["ports"]}
        for port in service["spec"]["ports"]:
            assert ports[port["targetPort"]] == port["port"]
    assert len({d["metadata"].get("namespace") for d in documents(name)} - {None}) == 1


@pytest.mark.parametrize("name", OVERLAYS)
def test_the_gateway_is_told_what_it_reads(name: str) -> None:
    deployment = one(overlay(name), "Deployment", "gateway")["spec"]
    assert deployment["replicas"] == 1 and deployment["strategy"] == {"type": "Recreate"}
    pod = deployment["template"]["spec"]
    assert pod["enableServiceLinks"] is False
    container = pod["containers"][0]
    options = parser().parse_args(["serve", *container["args"]])
    assert options.action == "run"
    environment = {e["name"]: e["value"] for e in container["env"]}
    known = {PREFIX + field.upper() for field in Config.__dataclass_fields__} | {DATABASE_FILE}
    assert environment.pop("FORWARDED_ALLOW_IPS") == "*", "uvicorn's: who may tell of TLS"
    assert set(environment) <= known
    database = environment.pop(DATABASE_FILE, None)
    assert bool(database) == (name != "dev")
    config = Config.read(options.config, environment)
    ports = {p["name"]: p["containerPort"] for p in container["ports"]}
    assert not config.loopback and config.link == f"tcp://*:{LINK}"
    assert ports == {"http": config.port, "link": LINK}
    mounts = [Path(m["mountPath"]) for m in container["volumeMounts"]]
    places = [config.data, *map(Path, (config.tokens, config.curve, config.agents))]
    places += [Path(config.ray_token), Path(config.shared), Path(config.recordings)]
    assert Path(config.recordings).is_relative_to(config.shared)
    ray = one(overlay(name), "RayCluster")
    assert config.ray == f"http://{ray['metadata']['name']}-head-svc:8265"
    nodes = [ray["spec"]["headGroupSpec"], *ray["spec"]["workerGroupSpecs"]]
    for node in nodes:
        held = node["template"]["spec"]["containers"][0]["volumeMounts"]
        assert {"name": "shared", "mountPath": config.shared} in held
    for place in [*places, *([Path(database)] if database else [])]:
        assert any(place.is_relative_to(mount) for mount in mounts), place


def test_probes_ask_what_the_gateway_answers() -> None:
    container = one(overlay("dev"), "Deployment", "gateway")["spec"]["template"]["spec"][
        "containers"
    ][0]
    paths = routes()
    for probe, path in (
        ("startupProbe", "/healthz"),
        ("livenessProbe", "/healthz"),
        ("readinessProbe", "/readyz"),
    ):
        assert container[probe]["httpGet"] == {"path": path, "port": "http"}
        assert path in paths
    assert container["readinessProbe"]["timeoutSeconds"] > TRY
    monitor = one(overlay("cluster"), "ServiceMonitor")["spec"]
    assert {e["path"] for e in monitor["endpoints"]} <= paths
    service = one(overlay("cluster"), "Service", "gateway")
    assert selects(monitor["selector"], service["metadata"]["labels"])
    assert not selects(
        monitor["selector"],
        one(overlay("cluster"), "Service", "gateway-link")["metadata"]["labels"],
    )
    assert {e["port"] for e in monitor["endpoints"]} <= {
        p["name"] for p in service["spec"]["ports"]
    }


def routes() -> set[str]:
    """Paths of the gateway's web application."""
    store = Store("sqlite://")  # in memory
    conductor = Conductor(store, Fits(), Metrics())
    jobs = Dispatcher(store, None, Path(), conductor.metrics, conductor.notify)
    app = application(store, Tokens(Path("tokens.json")), conductor, jobs, None)
    return set(app.openapi()["paths"])


@pytest.mark.parametrize("name", OVERLAYS)
def test_every_secret_is_made_and_has_what_is_read(name: str, secrets: list[Document]) -> None:
    made = {d["metadata"]["name"]: set(d["data"]) for d in secrets}
    used: dict[str, set[str]] = {}
    for pod in pods(documents(name)):
        secret = {
            v["name"]: v["secret"]["secretName"] for v in pod.spec["volumes"] if "secret" in v
        }
        for container in pod.containers:
            for mount in container["volumeMounts"]:
                if mount["name"] in secret:
                    keys = used.setdefault(secret[mount["name"]], set())
                    keys |= read_below(mount["mountPath"], container["env"])
    for document in documents(name):
        spec = document.get("spec", {})
        if document["kind"] in ("RayCluster", "RayJob"):
            auth = spec.get("rayClusterSpec", spec)["authOptions"]
            used.setdefault(auth["secretName"], set()).add("auth_token")  # as KubeRay wants it
        if document["kind"] == "ServiceMonitor":
            told = spec["endpoints"][0]["authorization"]["credentials"]
            used.setdefault(told["name"], set()).add(told["key"])
    assert used["pup-tokens"] == {"tokens.json"}
    used["pup-curve"] |= {"gateway.key", "gateway.key_secret"}  # of a KeyRing's folder
    assert set(used) <= set(made)
    for secret, keys in used.items():
        assert keys <= made[secret], secret
    if name != "dev":
        assert set(used) == set(made)


def read_below(folder: str, environment: list[Document]) -> set[str]:
    """Files of a folder that variables name."""
    named = [Path(e["value"]) for e in environment if e["value"].startswith(f"{folder}/")]
    return {str(file.relative_to(folder)) for file in named}


def test_no_secret_is_in_the_repository() -> None:
    for folder in (K8S / "secrets", ROOT / "deploy/secrets"):
        ignored = (folder / ".gitignore").read_text().split()
        assert ignored[0] == "*"
        assert set(ignored[1:]) <= {"!.gitignore", "!kustomization.yaml"}


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="no checkout of git")
@pytest.mark.parametrize("file", ["deploy/secrets/keys/darwin-1.key_secret", "keys/a.key_secret"])
def test_git_ignores_the_keys_of_robots(file: str) -> None:
    assert subprocess.run(["git", "-C", ROOT, "check-ignore", "-q", file]).returncode == 0


@pytest.mark.parametrize("name", OVERLAYS)
def test_disruption_budgets_are_for_pods_that_are_there(name: str) -> None:
    budgets = [d["spec"] for d in overlay(name) if d["kind"] == "PodDisruptionBudget"]
    held = [
        {p.where for p in pods(overlay(name)) if selects(budget["selector"], p.labels)}
        for budget in budgets
    ]
    assert sorted(held, key=sorted) == [{"gateway"}, {"pup head"}]


def ray_specs(name: str) -> list[Document]:
    held = [d["spec"] for d in documents(name) if d["kind"] in ("RayCluster", "RayJob")]
    return [spec.get("rayClusterSpec", spec) for spec in held]


@pytest.mark.parametrize("name", OVERLAYS)
def test_ray_is_as_the_operator_wants_it(name: str) -> None:
    """What KubeRay checks beyond its schema, and what its samples recommend."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    for spec in ray_specs(name):
        assert f"ray[default]=={spec['rayVersion']}" in extras["cluster"]
        assert spec["authOptions"]["mode"] == "token"
        assert spec["enableInTreeAutoscaling"] and spec["autoscalerOptions"]["version"] == "v2"
        head = spec["headGroupSpec"]
        assert head["rayStartParams"]["num-cpus"] == "0"
        ports = {
            p["name"]: p["containerPort"]
            for p in head["template"]["spec"]["containers"][0]["ports"]
        }
        assert ports == {"gcs-server": 6379, "dashboard": 8265, "metrics": 8080}
        groups = [group["groupName"] for group in spec["workerGroupSpecs"]]
        assert groups == (["cpu", "gpu"] if name == "gpu" else ["cpu"])
        for group in spec["workerGroupSpecs"]:
            assert group["minReplicas"] <= group["replicas"] <= group["maxReplicas"]
            resources = group["template"]["spec"]["containers"][0]["resources"]
            assert resources["requests"] == resources["limits"]
            assert float(resources["limits"]["cpu"]).is_integer()
            assert ("nvidia.com/gpu" in resources["limits"]) == (group["groupName"] == "gpu")
        for template in (head["template"], *(g["template"] for g in spec["workerGroupSpecs"])):
            assert "restartPolicy" not in template["spec"]
    for document in documents(name):
        if document["kind"] in ("RayCluster", "RayJob"):
            assert re.fullmatch(r"[a-z]([-a-z0-9]{0,45}[a-z0-9])?", document["metadata"]["name"])


@pytest.mark.parametrize("name", OVERLAYS)
def test_jobs_run_what_the_command_line_takes(name: str) -> None:
    results = {}
    for job in jobs(name):
        spec, wanted = job["spec"], job["metadata"]["name"]
        program, *words = shlex.split(spec["entrypoint"])
        options = parser().parse_args(words)
        assert (program, options.name) == ("pup", wanted)
        assert job["metadata"]["labels"]["app.kubernetes.io/component"] == wanted
        assert options.address == "auto" and options.cores
        results[wanted] = options.out
        read = getattr(options, "recordings", None) or [options.bounds]
        assert all(place.is_relative_to(SHARED) for place in [*read, options.out])
        assert spec["backoffLimit"] > 0 and spec["shutdownAfterJobFinishes"]
        assert spec["rayClusterSpec"] == one(overlay(name), "RayCluster")["spec"]
        submitter = spec["submitterPodTemplate"]["spec"]
        assert submitter["restartPolicy"] == "Never"
        head = spec["rayClusterSpec"]["headGroupSpec"]["template"]["spec"]
        assert submitter["containers"][0]["image"] == head["containers"][0]["image"]
    bounds = parser().parse_args(
        shlex.split(one(jobs(name), "RayJob", "train")["spec"]["entrypoint"])[1:]
    )
    assert bounds.bounds == results["presysid"] / "bounds.json"
    assert len(set(results.values())) == 3


@pytest.mark.parametrize("name", OVERLAYS)
def test_jobs_at_once_leave_cores_for_their_tasks(name: str) -> None:
    container = one(overlay(name), "Deployment", "gateway")["spec"]["template"]["spec"]
    told = {e["name"]: e["value"] for e in container["containers"][0]["env"]}
    config = Config.read(None, {k: v for k, v in told.items() if k != DATABASE_FILE})
    group = one(overlay(name), "RayCluster")["spec"]["workerGroupSpecs"][0]
    limits = group["template"]["spec"]["containers"][0]["resources"]["limits"]
    most = group["maxReplicas"] * cores_of(limits["cpu"])
    assert config.jobs_at_once < most
    assert config.ray_cores == (most if name == "dev" else 0)


@pytest.mark.parametrize("name", OVERLAYS)
def test_workers_can_hold_the_jobs(name: str) -> None:
    for job in jobs(name):
        spec = job["spec"]
        groups = {g["groupName"]: g for g in spec["rayClusterSpec"]["workerGroupSpecs"]}
        cores = {
            k: cores_of(g["template"]["spec"]["containers"][0]["resources"]["limits"]["cpu"])
            for k, g in groups.items()
        }
        options = parser().parse_args(shlex.split(spec["entrypoint"])[1:])
        driver, gpus = spec["entrypointNumCpus"], spec.get("entrypointNumGpus", 0)
        assert driver >= 1 and bool(gpus) == (name == "gpu" and options.name == "train")
        assert driver <= cores["gpu" if gpus else "cpu"]
        if runners := getattr(options, "runners", 0):
            share = options.cores // runners
            places = groups["cpu"]["maxReplicas"] * (cores["cpu"] // share)
            assert share * runners == options.cores
            assert places >= runners + (0 if gpus else -(-driver // share))
        else:  # what it takes besides, it takes as tasks of one core
            assert options.cores <= driver
            spare = groups["cpu"]["maxReplicas"] * cores["cpu"] - driver
            assert spare >= 1 or options.name == "train"

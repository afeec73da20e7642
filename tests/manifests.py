"""Kubernetes manifests for tests: rendered by kustomize, held against schemas, and walked."""

import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import kuberay
import pytest
import yaml
from jsonschema import Draft202012Validator
from kubernetes_validate.utils import schema_contents
from referencing import Registry, Resource

Document = dict[str, Any]

ROOT = Path(__file__).parents[1]
K8S = ROOT / "deploy/k8s"
OVERLAYS = ("dev", "cluster", "gpu")
KUBERAYS = {"app.kubernetes.io/name": "kuberay", "app.kubernetes.io/created-by": "kuberay-operator"}
"""Labels that KubeRay gives all its Ray pods."""
KUBERNETES = ("1.31", "1.37")
"""The oldest and the newest version that the manifests are for."""


def render(folder: Path) -> list[Document]:
    """What `kubectl apply -k` would send."""
    command = ["kubectl", "kustomize"] if shutil.which("kubectl") else ["kustomize", "build"]
    if not shutil.which(command[0]):
        pytest.skip("manifests are rendered by kubectl or kustomize; neither is installed")
    made = subprocess.run([*command, str(folder)], capture_output=True, text=True)
    assert made.returncode == 0, made.stderr
    return [one for one in yaml.safe_load_all(made.stdout) if one]


@cache
def overlay(name: str) -> list[Document]:
    return render(K8S / "overlays" / name)


@cache
def jobs(name: str) -> list[Document]:
    return render(K8S / "overlays" / name / "jobs")


def one(documents: list[Document], kind: str, name: str = "") -> Document:
    found = [d for d in documents if d["kind"] == kind and name in ("", d["metadata"]["name"])]
    assert len(found) == 1, (kind, name, len(found))
    return found[0]


@cache
def _registry(version: str) -> "Registry[Any]":
    file = f"kubernetes-json-schema/v{version}.0-local-strict/_definitions.json"
    definitions = Resource.from_contents(schema_contents(file, version))
    return definitions @ Registry()


def problems(document: Document, version: str) -> list[str]:
    """What a strict API server of that version would refuse, without its own rules."""
    kind, api = document["kind"], document["apiVersion"]
    if kind in kuberay.SCHEMAS:
        schema = kuberay.SCHEMAS[kind]
    else:
        group, _, name = api.rpartition("/")
        place = f"v{version}.0-local-strict/{kind.lower()}-{group.split('.')[0]}-{name}"
        schema = schema_contents(f"kubernetes-json-schema/{place.replace('--', '-')}.json", version)
    validator = Draft202012Validator(schema, registry=_registry(version))
    return [f"{kind} {e.json_path}: {e.message[:200]}" for e in validator.iter_errors(document)]


@dataclass(frozen=True)
class Pod:
    """A pod that some document leads to.

    Attributes:
      where: for messages.
      labels: those it will have, with what KubeRay adds.
      spec: of the pod.
    """

    where: str
    labels: dict[str, str]
    spec: Document

    @property
    def containers(self) -> list[Document]:
        return [*self.spec.get("initContainers", []), *self.spec["containers"]]


def pods(documents: list[Document]) -> Iterator[Pod]:
    """All pods, by the document that they come from."""
    for document in documents:
        kind, name, spec = document["kind"], document["metadata"]["name"], document.get("spec", {})
        if kind == "Deployment":
            template = spec["template"]
            yield Pod(name, template["metadata"]["labels"], template["spec"])
        elif kind == "RayCluster":
            yield from _ray_pods(name, spec)
        elif kind == "RayJob":
            yield from _ray_pods(name, spec["rayClusterSpec"])
            labels = {
                "ray.io/originated-from-crd": "RayJob",
                "ray.io/originated-from-cr-name": name,
            }
            yield Pod(f"{name} submitter", labels, spec["submitterPodTemplate"]["spec"])
        else:
            assert "template" not in spec, kind


def _ray_pods(name: str, spec: Document) -> Iterator[Pod]:
    common = {"ray.io/is-ray-node": "yes", "ray.io/cluster": name} | KUBERAYS
    head = spec["headGroupSpec"]["template"]["spec"]
    scaler = {"name": "autoscaler", "image": head["containers"][0]["image"]}
    scaler |= spec["autoscalerOptions"]
    head = head | {"containers": [*head["containers"], scaler]}
    yield Pod(f"{name} head", common | {"ray.io/node-type": "head"}, head)
    for group in spec["workerGroupSpecs"]:
        labels = common | {"ray.io/node-type": "worker", "ray.io/group": group["groupName"]}
        yield Pod(f"{name} {group['groupName']}", labels, group["template"]["spec"])


def selects(selector: Document, labels: dict[str, str]) -> bool:
    """Whether a label selector takes something with these labels."""
    for rule in selector.get("matchExpressions", []):
        assert rule["operator"] in ("In", "DoesNotExist")
        if rule["operator"] == "DoesNotExist" and rule["key"] in labels:
            return False
        if rule["operator"] == "In" and labels.get(rule["key"]) not in rule["values"]:
            return False
    return selector.get("matchLabels", {}).items() <= labels.items()


def bytes_of(quantity: str) -> float:
    """A quantity of memory."""
    units = {"Mi": 2**20, "Gi": 2**30}
    return float(quantity[:-2]) * units[quantity[-2:]]


def cores_of(quantity: str) -> float:
    """A quantity of CPU."""
    return float(quantity[:-1]) / 1000 if quantity.endswith("m") else float(quantity)

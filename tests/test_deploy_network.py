"""deploy/k8s: who may talk to whom, by evaluating the network policies."""

import ipaddress

import pytest
from manifests import KUBERAYS, OVERLAYS, Document, jobs, one, overlay, pods, selects

from services.gateway.config import Config

PAGES, LINK = Config.port, int(Config.link.rpartition(":")[2])
GCS, DASHBOARD, METRICS, ANY = 6379, 8265, 8080, 23456

Labels = dict[str, str]

HERE: Labels = {"kubernetes.io/metadata.name": "pup"}


class End:
    """One end of a connection.

    Args:
      labels: of the pod; None for what is no pod.
      space: labels of its namespace; that of pup unless told.
      address: for what is no pod.
    """

    def __init__(self, labels: Labels | None, space: Labels = HERE, address: str = "") -> None:
        self.labels, self.space, self.address = labels, space, address

    def is_one_of(self, peers: list[Document]) -> bool:
        return any(self._is(peer) for peer in peers)

    def _is(self, peer: Document) -> bool:
        if "ipBlock" in peer:
            block = ipaddress.ip_network(peer["ipBlock"]["cidr"])
            return bool(self.address) and ipaddress.ip_address(self.address) in block
        if self.labels is None:
            return False
        spaces = peer.get("namespaceSelector", {"matchLabels": HERE})
        return selects(spaces, self.space) and selects(peer.get("podSelector", {}), self.labels)


OUTSIDE = {"kubernetes.io/metadata.name": "elsewhere"}
ROBOT = End(None, address="192.168.7.20")
INTERNET = End(None, address="203.0.113.7")
DNS = End({"k8s-app": "kube-dns"}, {"kubernetes.io/metadata.name": "kube-system"})
OPERATOR = End({"app.kubernetes.io/name": "kuberay-operator"}, OUTSIDE)
PROMETHEUS = End({"app.kubernetes.io/name": "prometheus"}, OUTSIDE)
INGRESS = End({"app": "proxy"}, OUTSIDE | {"pup/ingress": "true"})
KUSTOMIZED = End({"app.kubernetes.io/name": "kuberay"}, OUTSIDE)
FOREIGN_RAY = End({"ray.io/is-ray-node": "yes", "ray.io/node-type": "worker"} | KUBERAYS, OUTSIDE)
STRANGER = End({"app": "proxy"}, OUTSIDE)


def ends(name: str) -> dict[str, End]:
    held = {p.where: End(p.labels) for p in pods(overlay(name) + jobs(name))}
    return {
        "gateway": held["gateway"],
        "head": held["pup head"],
        "worker": held["pup cpu"],
        "submitter": held["train submitter"],
        "job's head": held["train head"],
    }


def may(name: str, source: End, target: End, port: int, protocol: str = "TCP") -> bool:
    """Whether the policies of an overlay let a connection be made."""
    return _side(name, "Egress", source, target, port, protocol) and _side(
        name, "Ingress", target, source, port, protocol
    )


def _side(name: str, way: str, held: End, other: End, port: int, protocol: str) -> bool:
    if held.labels is None or held.space is not HERE:
        return True  # not ours to say
    policies = [
        d["spec"]
        for d in overlay(name)
        if d["kind"] == "NetworkPolicy"
        and way in d["spec"]["policyTypes"]
        and selects(d["spec"]["podSelector"], held.labels)
    ]
    assert policies, "nothing is denied by default"
    peers = "to" if way == "Egress" else "from"
    return any(
        (peers not in rule or other.is_one_of(rule[peers]))
        and ("ports" not in rule or {"protocol": protocol, "port": port} in rule["ports"])
        for policy in policies
        for rule in policy.get(way.lower(), [])
    )


@pytest.mark.parametrize("name", OVERLAYS)
def test_all_is_denied_by_default(name: str) -> None:
    policy = one(overlay(name), "NetworkPolicy", "default-deny")["spec"]
    assert policy == {"podSelector": {}, "policyTypes": ["Ingress", "Egress"]}


@pytest.mark.parametrize("name", OVERLAYS)
def test_services_lead_to_a_gateway_that_is_not_ready(name: str) -> None:
    """Its database may be away: pages and the emergency stop need none."""
    for service in ("gateway", "gateway-link"):
        assert one(overlay(name), "Service", service)["spec"]["publishNotReadyAddresses"] is True


@pytest.mark.parametrize("name", OVERLAYS)
def test_addresses_of_robots_are_not_rewritten_before_the_policies_see_them(name: str) -> None:
    assert one(overlay(name), "Service", "gateway-link")["spec"]["externalTrafficPolicy"] == "Local"


@pytest.mark.parametrize("name", OVERLAYS)
def test_what_is_needed_is_let_through(name: str) -> None:
    there = ends(name)
    gateway, head, worker = there["gateway"], there["head"], there["worker"]
    assert may(name, ROBOT, gateway, LINK)
    assert may(name, INGRESS, gateway, PAGES)
    assert may(name, gateway, head, DASHBOARD)
    for port in (GCS, ANY):
        assert may(name, worker, head, port) and may(name, head, worker, port)
    assert may(name, worker, worker, ANY)
    assert may(name, there["submitter"], there["job's head"], DASHBOARD)
    for operator in (OPERATOR, KUSTOMIZED):
        assert may(name, operator, head, DASHBOARD)
    assert may(name, head, INTERNET, 6443) and may(name, head, INTERNET, 443)  # API server
    for end in there.values():
        assert may(name, end, DNS, 53) and may(name, end, DNS, 53, "UDP")
    cluster = name != "dev"
    assert may(name, PROMETHEUS, gateway, PAGES) is cluster
    assert may(name, PROMETHEUS, worker, METRICS) is cluster
    assert may(name, gateway, INTERNET, 5432) is cluster


@pytest.mark.parametrize("name", OVERLAYS)
def test_what_is_not_needed_is_not(name: str) -> None:
    there = ends(name)
    gateway, head, worker = there["gateway"], there["head"], there["worker"]
    assert not may(name, ROBOT, gateway, PAGES)
    assert not may(name, INTERNET, gateway, LINK)
    for port in (PAGES, LINK):
        assert not may(name, STRANGER, gateway, port)
    for end in (ROBOT, INGRESS, STRANGER, PROMETHEUS, FOREIGN_RAY):
        for port in (DASHBOARD, GCS):
            assert not may(name, end, head, port)
        assert not may(name, end, worker, ANY)
    assert not may(name, gateway, head, GCS)
    assert not may(name, gateway, worker, ANY)
    for end in (head, worker, there["submitter"]):
        assert not may(name, end, gateway, PAGES)
        assert not may(name, end, gateway, LINK)
    assert not may(name, there["submitter"], head, GCS)
    for end in (gateway, worker, there["submitter"]):
        assert not may(name, end, INTERNET, 443)
    assert not may(name, OPERATOR, head, GCS)
    assert not may(name, worker, INTERNET, 5432)

"""What Prometheus reads."""

import math

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram

from services.gateway.agents import AgentView

HEALTH_LIMIT = 64
"""Numbers of an agent's health that are passed on."""


class Metrics:
    """Counters of one gateway, in a registry of its own."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self.trials = Counter(
            "pup_trials", "Trials that ended, by outcome.", ["outcome"], registry=self.registry
        )
        self.suggest = Histogram(
            "pup_suggest_seconds",
            "Time until the next eta is decided on.",
            buckets=(0.05, 0.1, 0.2, 0.3, 0.5, 1, 2, 5),
            registry=self.registry,
        )
        self.messages = Counter(
            "pup_messages", "Messages from agents, by type.", ["type"], registry=self.registry
        )
        self.refused = Counter(
            "pup_refused", "Messages and connections refused.", ["why"], registry=self.registry
        )
        self.requests = Histogram(
            "pup_request_seconds",
            "Time of a request.",
            ["method", "status"],
            buckets=(0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 1, 5),
            registry=self.registry,
        )
        self.studies = Gauge("pup_studies", "Studies, by state.", ["state"], registry=self.registry)
        self.jobs = Gauge("pup_jobs", "Jobs, by state.", ["state"], registry=self.registry)
        self.attempts = Counter(
            "pup_job_attempts",
            "Attempts at jobs that ended, by what became of the job.",
            ["state"],
            registry=self.registry,
        )
        self.ray = Gauge("pup_ray_up", "Whether the Ray cluster answers.", registry=self.registry)
        self.silence = Gauge(
            "pup_agent_heartbeat_age_seconds",
            "Since an agent was last heard.",
            ["agent"],
            registry=self.registry,
        )
        self.health = Gauge(
            "pup_agent_health",
            "Numbers of an agent's health.",
            ["agent", "name"],
            registry=self.registry,
        )

    def agent(self, view: AgentView) -> None:
        """Bring the gauges of an agent up to date; how one is that is away, nobody knows."""
        if math.isfinite(view.silent):
            self.silence.labels(view.name).set(view.silent)
        if not view.present:
            return
        numbers = [(k, v) for k, v in view.health.items() if isinstance(v, int | float)]
        for name, value in numbers[:HEALTH_LIMIT]:
            self.health.labels(view.name, name).set(value)

"""What a policy sees and tells, by training method. Imports no torch."""

from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any

BINS = 11
"""Values that an action may take at each joint (paper, section VI)."""
LATENT = 3
"""Dimensions of eta (paper, section IV: M = 3)."""


class Method(StrEnum):
    """How a policy deals with parameters that are not known exactly.

    Attributes:
      PUP: sees them through a learnt projection to few dimensions (paper, section IV).
      UP: sees them directly.
      ROBUST: does not see them, but they vary in training (domain randomisation).
      NOMINAL: does not see them, and training knows one value only.
    """

    PUP = "pup"
    UP = "up"
    ROBUST = "robust"
    NOMINAL = "nominal"


@dataclass(frozen=True)
class PolicyShape:
    """Sizes of a policy's networks.

    Attributes:
      proprioception: entries of an observation.
      parameters: entries of mu that the policy is given; 0 where it sees none.
      privileged: entries of what the value function sees besides: the course that the robot is
        on, then the true mu; training alone uses it.
      joints: actuated joints.
      latent: dimensions of eta that mu is projected to; 0 without a projection.
      bins: values an action may take at a joint.
      hidden: units in the layers of policy and value function. Three of 64, as the authors have.
      projection: units in the layers between mu and eta; the paper does not tell them.
    """

    proprioception: int
    parameters: int
    privileged: int
    joints: int
    latent: int
    bins: int = BINS
    hidden: tuple[int, ...] = (64, 64, 64)
    projection: tuple[int, ...] = (64,)

    @classmethod
    def of(
        cls,
        method: Method,
        proprioception: int,
        parameters: int,
        privileged: int,
        joints: int,
        bins: int = BINS,
    ) -> "PolicyShape":
        """The shape for a method.

        Args:
          method: see Method.
          proprioception: entries of an observation.
          parameters: entries of mu.
          privileged: entries of what the value function sees besides.
          joints: actuated joints.
          bins: values an action may take at a joint.
        """
        seen = parameters if method in (Method.PUP, Method.UP) else 0
        latent = LATENT if method == Method.PUP else 0
        return cls(proprioception, seen, privileged, joints, latent, bins)

    @property
    def eta(self) -> int:
        """Entries of what the policy is conditioned on: eta, all of mu, or nothing."""
        return self.latent or self.parameters

    def document(self) -> dict[str, Any]:
        """The shape as JSON values."""
        return asdict(self)

    @classmethod
    def read(cls, told: dict[str, Any]) -> "PolicyShape":
        """The shape that `document` told."""
        layers = {name: tuple(told[name]) for name in ("hidden", "projection")}
        return cls(**(told | layers))

"""What a case is recorded with: drawn before what it conceals, so that it tells nothing of it."""

from dataclasses import dataclass

import numpy as np

STRATA = {
    "single": 0.38,
    "below_noise": 0.12,
    "weak": 0.08,
    "masked": 0.14,
    "unidentifiable": 0.08,
    "pair": 0.12,
    "unlisted": 0.08,
}
NULLS = {"noise": 0.24, "parameters": 0.2, "coloured": 0.2, "engine": 0.2, "nuisance": 0.16}

POWERED, PLAIN = 0.4, 0.4  # shares of cases with the torque on throughout, with one setup
FALLS, STEPS = 0.35, 0.4  # shares of cases on the ground with a fall, with steps
BESIDES = 0.1  # share of other nulls that have what makes one kind of null


@dataclass(frozen=True)
class Setting:
    """What a case is recorded with.

    Attributes:
      powered: no recording with the torque off.
      plain: one setup throughout.
      fall: a fall is among the training motions.
      walk: steps are among the training motions.
      rough: the sensors have a memory and lose samples.
      wide: the nominal parameters are far off.
    """

    powered: bool = False
    plain: bool = False
    fall: bool = False
    walk: bool = False
    rough: bool = False
    wide: bool = False


def setting(stratum: str, ground: bool, rng: np.random.Generator) -> Setting:
    """Draw what a case is recorded with.

    Args:
      stratum: of the case; it decides where a kind of null is made of nothing else, and otherwise
        omissions have that as often as all nulls together.
      ground: whether the robot stands on its feet in most recordings.
      rng: source of all that is random.
    """
    powered, plain, fall, walk, rough, wide = (float(share) for share in rng.uniform(size=6))
    return Setting(
        powered=powered < POWERED,
        plain=plain < PLAIN,
        fall=ground and fall < FALLS,
        walk=ground and walk < STEPS,
        rough=rough < _share(stratum, "coloured"),
        wide=wide < _share(stratum, "parameters"),
    )


def _share(stratum: str, kind: str) -> float:
    """How often a case has what makes a kind of null."""
    if stratum == f"null:{kind}":
        return 1.0
    if stratum.startswith("null:"):
        return BESIDES
    return NULLS[kind] + (1.0 - NULLS[kind]) * BESIDES

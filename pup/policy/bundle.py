"""A trained policy as files, and what runs it on a robot's computer: NumPy, without torch.

A bundle is a folder: `policy.json` tells what it is and the digests of the others, `weights.npz`
holds arrays without pickle, `policy.onnx` the same computation from `obs` and `eta`.
"""

import hashlib
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.files import MISTAKES, read_json, write_atomic, write_json
from pup.policy.scale import UnitScale
from pup.policy.shape import Method, PolicyShape
from pup.robot import Gait, Harmonics, RobotDescription

Array = NDArray[np.float64]
Weights = Mapping[str, NDArray[Any]]

SCHEMA = 1
CARD, WEIGHTS, GRAPH = "policy.json", "weights.npz", "policy.onnx"
WEIGHTS_LIMIT = 64 * 2**20  # bytes
CLIP, FLOOR = 5.0, 1e-6
"""As in `pup.policy.network`, whose import would be torch's."""
EDGE = 1 + 1e-6
"""Largest size of what a tanh gives, and what rounding makes of it."""
NAMED = 3
"""Differences of a robot from the one of the training that a refusal names."""


@dataclass(frozen=True)
class PolicyCard:
    """What a policy is made for, and how its actions become targets.

    Attributes:
      robot: name of the robot.
      joints: in the order of actions and targets.
      lower: of the targets, rad, shape (n_joints,).
      upper: of the targets.
      method: see Method.
      direction: of the walk.
      shape: of the networks.
      observation: names of an observation's entries.
      parameters: names of mu, on whose unit scale `project` works.
      parameter_lower: of the bounds, physical; 0 on the unit scale.
      parameter_upper: of the bounds; 1 on the unit scale.
      eta_lower: least values of eta over the bounds, shape (n_eta,).
      eta_upper: largest values.
      rates: slowest and fastest control rate of the training, Hz.
      reach: largest change of a target by the policy, delta in the paper, rad.
      smoothing: actions whose mean is applied.
      gait: the reference motion.
      bounds_sha256: of the file whose bounds it was trained on.
      robot_digest: of the robot it was trained on.
      provenance: how it came about.
    """

    robot: str
    joints: tuple[str, ...]
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    method: Method
    direction: str
    shape: PolicyShape
    observation: tuple[str, ...]
    parameters: tuple[str, ...]
    parameter_lower: tuple[float, ...]
    parameter_upper: tuple[float, ...]
    eta_lower: tuple[float, ...]
    eta_upper: tuple[float, ...]
    rates: tuple[float, float]
    reach: float
    smoothing: int
    gait: Gait
    bounds_sha256: str
    robot_digest: str
    provenance: dict[str, Any]

    @property
    def scale(self) -> UnitScale:
        """The unit scale of its parameters."""
        return UnitScale(np.array(self.parameter_lower), np.array(self.parameter_upper))

    def check_rate(self, rate: float) -> None:
        """Refuse a control rate that it was not trained for, but for what rounding makes of one.

        Args:
          rate: Hz.

        Raises:
          InputError: the message says for which it was.
        """
        low, high = self.rates
        if not low * 0.99 <= rate <= high * 1.01:
            raise InputError(f"the policy was trained for {low:g} to {high:g} Hz, not {rate:g}")

    def check_eta(self, eta: Sequence[float]) -> None:
        """Refuse an eta that nothing projects to: no agent walks it.

        Raises:
          InputError: it is one, or of another length.
        """
        if len(eta) != self.shape.eta:
            raise InputError(
                f"{len(eta)} numbers, but the policy is conditioned on {self.shape.eta}"
            )
        if not self.projected(eta):
            told = ",".join(f"{x:g}" for x in eta)
            raise InputError(f"{told} is outside -1 to 1, where all projections lie")

    def projected(self, eta: Sequence[float]) -> bool:
        """Whether something may project to an eta, where etas are projections.

        The card's box is of a sample of projections; a fitted robot's may lie beyond it.
        """
        return not self.shape.latent or all(abs(x) <= EDGE for x in eta)

    def document(self) -> dict[str, Any]:
        """The card as JSON values."""
        told = {f.name: getattr(self, f.name) for f in fields(self)}
        told |= {"shape": self.shape.document(), "gait": asdict(self.gait)}
        told["gait"]["joints"] = {n: s._asdict() for n, s in self.gait.joints.items()}
        return {"schema": SCHEMA, **json.loads(json.dumps(told, allow_nan=False))}

    @classmethod
    def read(cls, told: dict[str, Any]) -> "PolicyCard":
        """The card that `document` told."""
        left = {k: v for k, v in told.items() if k != "schema"}
        series = {
            n: Harmonics(s["c0"], tuple(s["a"]), tuple(s["b"]))
            for n, s in left["gait"]["joints"].items()
        }
        gait = Gait(**(_tuples(left["gait"]) | {"joints": series}))
        known = {"shape": PolicyShape.read(left["shape"]), "gait": gait}
        return cls(**(_tuples(left) | known | {"method": Method(left["method"])}))


def _tuples(told: dict[str, Any]) -> dict[str, Any]:
    return {k: tuple(v) if isinstance(v, list) else v for k, v in told.items()}


def write_bundle(folder: Path, card: PolicyCard, weights: Weights) -> None:
    """Write a bundle; the card last, so that a folder with one is whole.

    Args:
      folder: where to; made when absent.
      card: what the policy is.
      weights: of the ProjectedPolicy, by its names.
    """
    from pup.policy.graph import onnx_graph

    packed = io.BytesIO()
    np.savez(packed, allow_pickle=False, **dict(weights))
    contents = {WEIGHTS: packed.getvalue(), GRAPH: onnx_graph(card.shape, weights)}
    for name, content in contents.items():
        write_atomic(folder / name, content)
    document = card.document() | {
        "sha256": {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}
    }
    write_json(folder / CARD, document | {"digest": _digest(document)})


def read_bundle(folder: Path, robot: RobotDescription | None = None) -> tuple[PolicyCard, Weights]:
    """Read a bundle.

    Args:
      folder: of the bundle.
      robot: the robot it shall run.

    Raises:
      InputError: it is no bundle, a file of it was changed, or it is of another robot.
    """
    file = folder / CARD
    told = read_json(file)
    if not isinstance(told, dict) or told.get("schema") != SCHEMA:
        raise InputError(f"{file}: not a policy of schema {SCHEMA}; give the folder of a bundle")
    digest = told.pop("digest", None)
    if digest != _digest(told):
        raise InputError(f"{file}: was changed after it was written; take the bundle anew")
    try:
        digests = told.pop("sha256")
        known = {name: str(digests[name]) for name in (WEIGHTS, GRAPH)}
        card = PolicyCard.read(told)
    except (KeyError, TypeError, ValueError, AttributeError) as error:  # its digest is right
        raise InputError(
            f"{file}: written by a pup of another version; use that one, or train the policy anew"
        ) from error
    contents = {name: _content(folder / name, digest) for name, digest in known.items()}
    if robot is not None and (robot.name, robot.joint_names) != (card.robot, card.joints):
        raise InputError(
            f"{file}: the policy is of robot {card.robot!r} with {len(card.joints)} joints, not of "
            f"{robot.name!r} with {len(robot.joints)}; use a policy of that robot"
        )
    with np.load(io.BytesIO(contents[WEIGHTS]), allow_pickle=False) as packed:
        return card, {name: packed[name] for name in packed.files}


def _differences(card: PolicyCard, robot: RobotDescription) -> list[str]:
    """What a policy's targets and readings rely on and this robot has otherwise than in training.

    All else may differ: a diagnosis corrects parameters and terms.
    """
    limits = zip(robot.joints, card.lower, card.upper, strict=True)
    return [
        *(f"limits of {j.name}" for j, *trained in limits if [j.lower, j.upper] != trained),
        *(
            f"gait.{f.name}"
            for f in fields(Gait)
            if getattr(card.gait, f.name) != getattr(robot.gait, f.name, None)
        ),
    ]


def _content(file: Path, digest: str) -> bytes:
    try:
        if file.stat().st_size > WEIGHTS_LIMIT:
            raise InputError(f"{file}: larger than {WEIGHTS_LIMIT} bytes; take the bundle anew")
        content = file.read_bytes()
    except MISTAKES as error:
        raise InputError(f"{file}: cannot be read ({error.strerror})") from error
    if hashlib.sha256(content).hexdigest() != digest:
        raise InputError(f"{file}: does not match {CARD}; take the bundle anew")
    return content


def _digest(document: dict[str, Any]) -> str:
    canonical = json.dumps(document, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()


class NumpyPolicy:
    """Runs a policy in double precision, in which NumPy, torch and ONNX agree.

    Args:
      card: what it is.
      weights: by the names of ProjectedPolicy.
    """

    def __init__(self, card: PolicyCard, weights: Weights) -> None:
        self.card = card
        known = {name: np.asarray(value, dtype=np.float64) for name, value in weights.items()}
        self.mean = known["observations.mean"]
        self.scale = np.sqrt(np.maximum(known["observations.variance"], FLOOR))
        self.actor, self.projection = layers(known, "actor"), layers(known, "projection")

    @classmethod
    def load(cls, folder: Path, robot: RobotDescription | None = None) -> "NumpyPolicy":
        """Read a bundle to run it; whoever trains it further calls `read_bundle`.

        Args:
          folder: of the bundle.
          robot: the robot it shall run.

        Raises:
          InputError: as `read_bundle`, or the robot's joint limits or gait are not those that it
            was trained with.
        """
        card, weights = read_bundle(folder, robot)
        if robot is not None and (other := _differences(card, robot)):
            named = ", ".join(other[:NAMED]) + (" and more" if other[NAMED:] else "")
            raise InputError(
                f"{folder / CARD}: trained on a description of {robot.name!r} with other {named}; "
                "use that description, or train it further on this one (`pup train --start`)"
            )
        return cls(card, weights)

    def project(self, parameters: Array) -> Array:
        """Eta of mu.

        Args:
          parameters: on the unit scale of the bounds, shape (..., n_parameters).
        """
        centred = 2 * np.asarray(parameters, dtype=np.float64) - 1
        if self.card.shape.latent:
            return np.tanh(_through(self.projection, centred))
        return centred[..., : self.card.shape.eta]

    def logits(self, proprioception: Array, eta: Array) -> Array:
        """Logits of the bins, shape (..., bins, joints)."""
        seen = np.clip((np.asarray(proprioception, float) - self.mean) / self.scale, -CLIP, CLIP)
        eta = np.broadcast_to(eta, (*seen.shape[:-1], self.card.shape.eta))
        flat = _through(self.actor, np.concatenate([seen, eta], axis=-1))
        return flat.reshape(*flat.shape[:-1], self.card.shape.bins, self.card.shape.joints)

    def act(self, proprioception: Array, eta: Array) -> Array:
        """The mean of the bins of each joint, as the policy weighs them.

        Args:
          proprioception: observations as they were measured, shape (..., n_entries).
          eta: shape (n_eta,) or (..., n_eta).

        Returns:
          Actions between 0 and bins - 1, shape (..., n_joints).
        """
        logits = self.logits(proprioception, eta)
        weights = np.exp(logits - logits.max(axis=-2, keepdims=True))
        order = np.arange(self.card.shape.bins, dtype=np.float64)
        return np.asarray(order @ weights / weights.sum(axis=-2))

    def targets(self, time: float, actions: Array) -> Array:
        """Target positions, rad, shape (..., n_joints).

        Args:
          time: since the start of the walk, s.
          actions: those so far, the newest last, shape (n_actions, ..., n_joints), each between 0
            and bins - 1; those before what the smoothing takes are not looked at.
        """
        card = self.card
        middle = (card.shape.bins - 1) / 2
        mean = (np.asarray(actions)[-card.smoothing :] / middle - 1).mean(axis=0)
        target = self._reference(time) + card.reach * mean
        return np.asarray(np.clip(target, card.lower, card.upper))

    def _reference(self, time: float) -> Array:
        gait = self.card.gait
        angles = gait.angles(max(0.0, time - gait.blend) / gait.period)
        if gait.start is None or time >= gait.blend:
            return angles
        share = time / gait.blend
        return np.asarray((1 - share) * np.array(gait.start) + share * angles)


Layers = list[tuple[Array, Array]]


def layers(weights: Weights, network: str) -> Layers:
    """Weight matrices (outputs, inputs) and biases of a network, in order."""
    count = len([n for n in weights if n.startswith(f"{network}.") and n.endswith(".weight")])
    names = [f"{network}.{2 * i}" for i in range(count)]  # a tanh stands between two
    return [(weights[f"{n}.weight"], weights[f"{n}.bias"]) for n in names]


def _through(network: Layers, inputs: Array) -> Array:
    for weight, bias in network[:-1]:
        inputs = np.tanh(inputs @ weight.T + bias)
    weight, bias = network[-1]
    return np.asarray(inputs @ weight.T + bias)

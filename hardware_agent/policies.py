"""The policy bundles that lie on the robot's computer."""

import logging
from collections.abc import Iterator
from pathlib import Path

from pup.errors import InputError
from pup.files import sha256
from pup.policy.bundle import CARD, NumpyPolicy
from pup.robot import RobotDescription
from pup.wire import Policy

log = logging.getLogger("pup-agent")


def digest_of(bundle: Path) -> str:
    """What the gateway and the agent call a bundle: SHA-256 of its card, which holds the others'.

    Raises:
      InputError: there is no card.
    """
    try:
        return sha256(bundle / CARD)
    except OSError as error:
        raise InputError(f"{bundle / CARD}: cannot be read ({error.strerror})") from error


class Shelf:
    """A folder of bundles, or one that is a bundle itself; looked at anew when asked.

    Args:
      folder: which.
      robot: that they must be of.
    """

    def __init__(self, folder: Path, robot: RobotDescription) -> None:
        self._folder, self._robot = folder, robot
        self._loaded: tuple[str, NumpyPolicy] | None = None

    def policies(self) -> tuple[Policy, ...]:
        """All that are there and can be read, by name."""
        return tuple(Policy(path.name, digest) for path, digest in self._readable())

    def load(self, digest: str) -> NumpyPolicy:
        """A policy; the last one is kept.

        Raises:
          InputError: it is not there, or not of this robot as it is described here.
        """
        if self._loaded is not None and self._loaded[0] == digest:
            return self._loaded[1]
        for path, found in self._readable():
            if found == digest:
                policy = NumpyPolicy.load(path, self._robot)
                if policy.card.robot_digest != self._robot.digest:
                    log.info(
                        "policy %s: trained on another description of %s, a corrected one say; "
                        "limits and gait agree",
                        path.name,
                        self._robot.name,
                    )
                self._loaded = digest, policy
                return policy
        raise InputError(
            f"{self._folder}: no policy with digest {digest[:16]}; copy its bundle here"
        )

    def _readable(self) -> Iterator[tuple[Path, str]]:
        for path in self._bundles():
            try:
                yield path, digest_of(path)
            except InputError as error:  # a file that was badly copied must end no walk
                log.warning("%s; left out", error)

    def _bundles(self) -> list[Path]:
        try:
            if (self._folder / CARD).is_file():
                return [self._folder]
            return sorted(file.parent for file in self._folder.glob(f"*/{CARD}"))
        except OSError as error:  # a folder that the service's user may not look into, say
            log.warning("%s: cannot be read (%s)", self._folder, error.strerror)
            return []

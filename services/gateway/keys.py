"""Who may do what: bearer tokens of people and programs, CURVE keys of the gateway and its agents.

Tokens stand hashed in `tokens.json`; what is hashed has 256 random bits, so that a plain hash
cannot be searched. Keys are files of ZeroMQ's format: `curve/gateway.key_secret`, and the public
key of each agent in `curve/agents/<name>.key`. The name of the file is the name of the agent.
"""

import hashlib
import hmac
import logging
import os
import secrets
from contextlib import suppress
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

import zmq
import zmq.auth

from pup.errors import InputError
from pup.files import read_json, write_atomic, write_json
from services.gateway.names import is_name

log = logging.getLogger(__name__)
Stamp = dict[str, tuple[int, int]]
"""When files were changed, in ns, and their sizes, by name."""

SCHEMA = 1
KEY = 40
"""Characters of a CURVE key in z85."""


class Role(IntEnum):
    """What a token allows; each also what the ones before allow.

    Attributes:
      VIEWER: read.
      OPERATOR: make studies, release, retry and cancel trials, stop robots, submit jobs.
      ADMIN: all of the service, others' jobs too.
    """

    VIEWER = 1
    OPERATOR = 2
    ADMIN = 3


@dataclass(frozen=True)
class User:
    """Whose token it is."""

    name: str
    role: Role


class Tokens:
    """The tokens of a service; the file is read again when it changes.

    Args:
      file: `tokens.json`.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        self._read_at: tuple[int, int] | None = None
        self._known: list[tuple[bytes, User]] = []
        self._trouble = ""

    def user(self, token: str) -> User | None:
        """Whose token it is; all are compared, each in constant time."""
        self._refresh()
        digest, found = hashlib.sha256(token.encode()).digest(), None
        for known, user in self._known:
            if hmac.compare_digest(known, digest):
                found = user
        return found

    def create(self, name: str, role: Role) -> str:
        """A new token, which is told but this once; an older one of this name ends."""
        check_name(name)
        token = "pup_" + secrets.token_urlsafe(32)
        entry = {"role": role.name.lower(), "sha256": hashlib.sha256(token.encode()).hexdigest()}
        self._write(self._stored() | {name: entry})
        return token

    def revoke(self, name: str) -> None:
        """End a token."""
        stored = self._stored()
        if name not in stored:
            raise InputError(f"there is no token {name}; there are {', '.join(stored) or 'none'}")
        del stored[name]
        self._write(stored)

    def __len__(self) -> int:
        return len(self._stored())

    def _stored(self) -> dict[str, dict[str, str]]:
        if not self.file.exists():
            return {}
        told = read_json(self.file)
        try:
            if told["schema"] != SCHEMA:
                raise InputError(f"{self.file}: schema is not {SCHEMA}")
            stored: dict[str, dict[str, str]] = told["tokens"]
            for entry in stored.values():
                Role[entry["role"].upper()], bytes.fromhex(entry["sha256"])
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise InputError(f"{self.file}: not a file of tokens") from error
        return stored

    def _write(self, stored: dict[str, dict[str, str]]) -> None:
        write_json(self.file, {"schema": SCHEMA, "tokens": stored})
        self.file.chmod(0o600)

    def _refresh(self) -> None:
        """Read the file if it changed; while it cannot be read, who was let in still is."""
        try:
            status = self.file.stat()
            if (at := (status.st_mtime_ns, status.st_ino)) != self._read_at:
                self._known = [
                    (bytes.fromhex(e["sha256"]), User(name, Role[e["role"].upper()]))
                    for name, e in self._stored().items()
                ]
                self._read_at = at
            self._trouble = ""
        except FileNotFoundError:
            self._known, self._read_at = [], None
        except (InputError, OSError) as error:
            if (why := str(error)) != self._trouble:
                log.error("tokens cannot be read; those of before hold", extra={"why": why})
            self._trouble = why


@dataclass(frozen=True)
class KeyRing:
    """The CURVE keys of a service.

    Attributes:
      folder: `curve/`.
      agents_elsewhere: folder of the agents' public keys; None for `curve/agents/`.
    """

    folder: Path
    agents_elsewhere: Path | None = None

    @property
    def agents_folder(self) -> Path:
        """The folder with the agents' public keys."""
        return self.agents_elsewhere or self.folder / "agents"

    def gateway(self) -> tuple[bytes, bytes]:
        """Public and secret key of the gateway; made at the first time."""
        file = self.folder / "gateway.key_secret"
        if not file.exists():
            _create(self.folder, "gateway")
        return _pair(file)

    def stamp(self) -> Stamp:
        """Tells whether the agents' keys changed."""
        found = {}
        for file in self.agents_folder.glob("*.key"):
            with suppress(OSError):  # one that is gone or cannot be read keeps nobody else out
                status = file.stat()
                found[file.name] = (status.st_mtime_ns, status.st_size)
        return found

    def agents(self) -> dict[bytes, str]:
        """Names of the agents that are let in, by their public keys."""
        known = {}
        for file in sorted(self.agents_folder.glob("*.key")):
            if not is_name(file.stem):
                log.warning("no name of an agent", extra={"file": str(file)})
                continue
            try:
                known[zmq.auth.load_certificate(file)[0]] = file.stem
            except (OSError, ValueError) as error:  # being copied, say; others go on
                log.warning("no CURVE key", extra={"file": str(file), "why": str(error)})
        return known

    def create_agent(self, name: str, out: Path) -> tuple[Path, Path]:
        """Make the keys of an agent: the public one is let in, the secret one goes to the robot.

        Returns:
          Files with the agent's secret key and the gateway's public key.
        """
        check_name(name)
        if (self.agents_folder / f"{name}.key").exists():
            raise InputError(f"there is an agent {name}; revoke it first to give it a new key")
        secret, public = out / f"{name}.key_secret", out / "gateway.key"
        if secret.exists():
            raise InputError(f"{secret}: exists; use another folder")
        if out.resolve() == self.agents_folder.resolve():
            raise InputError(f"{out}: is where agents are let in; use another folder")
        self.gateway()
        _create(out, name)
        made, known = out / f"{name}.key", self.agents_folder / f"{name}.key"
        try:
            public.write_bytes((self.folder / "gateway.key").read_bytes())
            write_atomic(known, made.read_bytes())  # a copy: it may be another file system
        except OSError:
            secret.unlink()  # else it would be in the way when this is repeated
            raise
        made.unlink()
        return secret, public

    def revoke_agent(self, name: str) -> None:
        """Let an agent in no more; a connection that stands is cut at its next message."""
        check_name(name)
        file = self.agents_folder / f"{name}.key"
        if not file.exists():
            raise InputError(f"there is no agent {name}")
        file.unlink()


def check_name(name: str) -> None:
    """Refuse names that are no file's.

    Raises:
      InputError: it is none.
    """
    if not is_name(name):
        raise InputError(f"{name[:70]!r} is no name: use 1 to 63 letters, digits, '-', '_' and '.'")


def _create(folder: Path, name: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    before = os.umask(0o077)
    try:
        zmq.auth.create_certificates(folder, name)
    finally:
        os.umask(before)


def _pair(file: Path) -> tuple[bytes, bytes]:
    try:
        public, secret = zmq.auth.load_certificate(file)
    except (OSError, ValueError) as error:
        raise InputError(f"{file}: no CURVE key") from error
    if secret is None:
        raise InputError(f"{file}: holds no secret key")
    if not len(public) == len(secret) == KEY:
        raise InputError(f"{file}: no CURVE key; keys have {KEY} characters")
    return public, secret

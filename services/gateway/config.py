"""How a gateway is set up: a TOML file, and environment variables that win over it."""

import os
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from pup.errors import InputError
from services.gateway.keys import KeyRing, Tokens

PREFIX = "PUP_"
DATABASE_FILE = "PUP_DATABASE_FILE"
NUMBERS = {"port": (0, 65535), "jobs_at_once": (1, 1000), "ray_cores": (0, 1_000_000)}
"""Settings that are numbers, with the least and the most."""


@dataclass(frozen=True)
class Config:
    """Where a gateway listens and keeps things.

    Attributes:
      data: folder for the database, tokens, keys and recordings.
      host: that REST and pages are served at; loopback unless told otherwise.
      port: likewise.
      link: ZeroMQ address for agents.
      database: URL of SQLAlchemy; empty for SQLite in `data`. `PUP_DATABASE_FILE` names a file that
        holds it, for one with a password.
      tokens: file of the tokens; empty for `tokens.json` in `data`.
      curve: folder of the gateway's CURVE keys; empty for `curve` in `data`.
      agents: folder of the agents' public keys; empty for `agents` in that of the CURVE keys.
      certificate: file with the certificate of TLS; empty for none.
      key: file with its secret key.
      ray: URL of the dashboard of the Ray cluster that jobs run on; empty for no jobs.
      ray_token: file with the token of its authentication; empty for what Ray itself reads.
      shared: folder that the gateway and all nodes of that cluster have at the same path.
      jobs_at_once: jobs that Ray is asked for together; more would take each other the cores that
        their tasks need.
      ray_cores: of that cluster, where it does not grow by itself; 0 where it does.
      recordings: folder of recordings that pages show beside those that robots sent.
      log: least level that is logged, `debug`, `info`, `warning` or `error`.
    """

    data: Path = Path("pup-service")
    host: str = "127.0.0.1"
    port: int = 8470
    link: str = "tcp://127.0.0.1:8471"
    database: str = ""
    tokens: str = ""
    curve: str = ""
    agents: str = ""
    certificate: str = ""
    key: str = ""
    ray: str = ""
    ray_token: str = ""
    shared: str = ""
    jobs_at_once: int = 1
    ray_cores: int = 0
    recordings: str = ""
    log: str = "info"

    @classmethod
    def read(cls, file: Path | None, environment: Mapping[str, str] = os.environ) -> "Config":
        """Read the file, if there is one, then the variables `PUP_<ATTRIBUTE>`.

        Raises:
          InputError: a key is unknown or a value cannot be.
        """
        told: dict[str, Any] = {}
        if file is not None:
            try:
                told = tomllib.loads(file.read_text(encoding="utf-8"))
            except OSError as error:
                raise InputError(f"{file}: cannot be read ({error.strerror})") from error
            except ValueError as error:
                raise InputError(f"{file}: not TOML ({error})") from error
        names = {f.name for f in fields(cls)}
        if unknown := sorted(set(told) - names):
            known = ", ".join(sorted(names))
            raise InputError(f"{file}: {unknown[0]} is unknown; there are {known}")
        if held := environment.get(DATABASE_FILE):
            told["database"] = _held(Path(held))
        for name in names & {n.removeprefix(PREFIX).lower() for n in environment}:
            if PREFIX + name.upper() in environment:
                told[name] = environment[PREFIX + name.upper()]
        return cls()._with(told, file)

    @property
    def url(self) -> str:
        """Of the database."""
        return self.database or f"sqlite:///{(self.data / 'gateway.db').absolute()}"

    @property
    def token_store(self) -> Tokens:
        """Who may ask."""
        return Tokens(Path(self.tokens) if self.tokens else self.data / "tokens.json")

    @property
    def key_ring(self) -> KeyRing:
        """The CURVE keys."""
        folder = Path(self.curve) if self.curve else self.data / "curve"
        return KeyRing(folder, Path(self.agents) if self.agents else None)

    @property
    def shelves(self) -> dict[str, Path]:
        """Folders of recordings that pages show."""
        told = {"lab": Path(self.recordings)} if self.recordings else {}
        return told | {"robots": self.data / "recordings"}

    @property
    def loopback(self) -> bool:
        """Whether REST and pages are for this computer alone."""
        return self.host in ("127.0.0.1", "::1", "localhost")

    def _with(self, told: Mapping[str, Any], file: Path | None) -> "Config":
        read: dict[str, Any] = {}
        for name, value in told.items():
            if name in NUMBERS:
                read[name] = _number(name, value)
            elif not isinstance(value, str):
                raise InputError(f"{name}: {str(value)[:40]!r} is no text")
            else:
                read[name] = value
        if "data" in read:
            base = file.parent if file and PREFIX + "DATA" not in os.environ else Path()
            read["data"] = base / _home("data", read["data"])
        if read.get("recordings"):
            read["recordings"] = str(_home("recordings", read["recordings"]))
        config = replace(self, **read)
        if not config.link.startswith("tcp://"):
            raise InputError(f"link: {config.link[:40]!r} is no address such as {Config.link}")
        if config.log not in ("debug", "info", "warning", "error"):
            raise InputError(f"log: {config.log[:40]!r}; use debug, info, warning or error")
        if bool(config.ray) != bool(config.shared):
            raise InputError("ray and shared belong together; give both or none")
        if config.ray and not config.ray.startswith(("http://", "https://")):
            raise InputError(f"ray: {config.ray[:60]!r} is no address such as http://ray-head:8265")
        if config.shared and not Path(config.shared).is_absolute():
            raise InputError(f"shared: {config.shared[:60]!r} is no absolute path")
        if bool(config.certificate) != bool(config.key):
            raise InputError("certificate and key belong together; give both or none")
        return config


def _home(name: str, value: str) -> Path:
    """A path that may begin with `~`."""
    try:
        return Path(value).expanduser()
    except RuntimeError as error:
        raise InputError(
            f"{name}: {value[:60]!r} begins with nobody's home folder here; give it in full"
        ) from error


def _number(name: str, value: Any) -> int:
    least, most = NUMBERS[name]
    try:
        number = least - 1 if isinstance(value, bool | float) else int(value)
    except (TypeError, ValueError):
        number = least - 1
    if not least <= number <= most:
        raise InputError(f"{name}: {str(value)[:40]!r} is none; use {least} to {most}")
    return number


def _held(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{DATABASE_FILE}: {file} cannot be read ({error})") from error

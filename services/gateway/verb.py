"""What `pup serve` does: run a gateway, or make and end tokens and keys."""

import argparse
from pathlib import Path
from typing import Any

from pup.errors import InputError
from services.gateway.config import Config
from services.gateway.keys import Role


def serve(options: argparse.Namespace) -> dict[str, Any]:
    """Do what the options say.

    Raises:
      InputError: something cannot be done so.
    """
    return ACTIONS[options.action](Config.read(options.config), options)


def _run(config: Config, _: argparse.Namespace) -> dict[str, Any]:
    from services.gateway import server

    return server.serve(config)


def _token(config: Config, options: argparse.Namespace) -> dict[str, Any]:
    name, role = _name(options), Role[options.role.upper()]
    token = config.token_store.create(name, role)
    return {"name": name, "role": options.role, "token": token}


def _revoke_token(config: Config, options: argparse.Namespace) -> dict[str, Any]:
    name = _name(options)
    config.token_store.revoke(name)
    return {"revoked": name}


def _agent(config: Config, options: argparse.Namespace) -> dict[str, Any]:
    name = _name(options)
    if options.out is None:
        raise InputError("agent: give --out DIR, the folder for the files that go to the robot")
    files = config.key_ring.create_agent(name, Path(options.out))
    return {"name": name, "key": str(files[0]), "gateway_key": str(files[1])}


def _revoke_agent(config: Config, options: argparse.Namespace) -> dict[str, Any]:
    name = _name(options)
    config.key_ring.revoke_agent(name)
    return {"revoked": name}


def _name(options: argparse.Namespace) -> str:
    if not options.who:
        raise InputError(f"{options.action}: give a NAME")
    return str(options.who)


def show(shown: dict[str, Any]) -> None:
    """Print the outcome for people."""
    if "token" in shown:
        print(shown["token"])
    elif "key" in shown:
        print(f"{shown['key']}: to the robot, and nowhere else\n{shown['gateway_key']}: likewise")
    elif "revoked" in shown:
        print(f"revoked: {shown['revoked']}")


ACTIONS = {
    "run": _run,
    "token": _token,
    "revoke-token": _revoke_token,
    "agent": _agent,
    "revoke-agent": _revoke_agent,
}

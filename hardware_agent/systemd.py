"""What systemd is told of the agent, and how it is kept alive: sd_notify(3)."""

import os
import socket


def notify(*assignments: str) -> None:
    """Tell systemd; nothing happens where nobody listens.

    Args:
      assignments: such as `READY=1`.
    """
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    if address.startswith("@"):
        address = "\0" + address[1:]
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as line:
        line.sendto("\n".join(assignments).encode(), address)

"""What systemd is told of the agent, and how it is kept alive: sd_notify(3)."""

import os
import socket
from contextlib import suppress


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
    kind = socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK
    with socket.socket(socket.AF_UNIX, kind) as line, suppress(OSError):  # a robot does not wait
        line.sendto("\n".join(assignments).encode(), address)

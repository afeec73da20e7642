"""The link in a thread of its own: what the gateway says is heard while the agent writes files."""

import os
import queue
import threading
from collections.abc import Callable
from contextlib import suppress

import zmq

from hardware_agent.link import Link
from pup.wire import Body, Message

TURN = 0.05  # s, the longest sleep


class LinkThread(threading.Thread):
    """Has a link to itself.

    Args:
      link: used, its `greet` called, and closed from this thread.
      deliver: told each message, likewise; must not block.
    """

    def __init__(self, link: Link, deliver: Callable[[Message], None]) -> None:
        super().__init__(name="link", daemon=True)
        self._link, self._deliver = link, deliver
        self._out: queue.SimpleQueue[tuple[Body, ...]] = queue.SimpleQueue()
        self._bell = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._ending = False

    @property
    def connected(self) -> bool:
        """See Link."""
        return self._link.connected

    def send(self, *bodies: Body) -> None:
        """See Link; from any thread."""
        self._out.put(bodies)
        self._ring()

    def close(self) -> None:
        """Send what is to be sent, and end."""
        self._ending = True
        self._ring()
        self.join()
        os.close(self._bell)

    def run(self) -> None:
        """Until it is closed."""
        while not self._ending:
            self._sleep()
            for message in self._link.receive():
                self._deliver(message)
            self._forward()
            self._link.tend()
        self._forward()
        self._link.close()

    def _forward(self) -> None:
        while not self._out.empty():
            self._link.send(*self._out.get())

    def _sleep(self) -> None:
        poller = zmq.Poller()
        for socket in (self._bell, *self._link.sockets):
            poller.register(socket, zmq.POLLIN)
        poller.poll(round(TURN * 1000))
        with suppress(BlockingIOError):
            os.eventfd_read(self._bell)

    def _ring(self) -> None:
        with suppress(BlockingIOError):
            os.eventfd_write(self._bell, 1)

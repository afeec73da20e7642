"""A stop while Ray starts, in a process that is connected to no other."""

import os
import signal
import threading
import time

import pytest
import ray

from workers.cluster import connected


@pytest.mark.ray
@pytest.mark.parametrize("seconds", [0.1, 0.3, 0.6, 0.9, 1.2])
def test_a_stop_while_ray_starts_is_kept(seconds: float) -> None:
    """Ray's own answer to SIGTERM can be lost where its start raises it."""
    usual = signal.signal(signal.SIGTERM, signal.default_int_handler)
    timer = threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGTERM))
    timer.start()
    try:
        with pytest.raises(KeyboardInterrupt), connected(cores=1):
            time.sleep(60)
        assert signal.getsignal(signal.SIGTERM) is signal.default_int_handler
    finally:
        timer.cancel()
        signal.signal(signal.SIGTERM, usual)
    assert not ray.is_initialized()

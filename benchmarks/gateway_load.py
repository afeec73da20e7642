"""A gateway under load: 200 agents with heartbeats, and 1,000 reads a second over REST.

All on this computer: the gateway, the agents and the reader share its cores. Reads are sent at
their times, whether or not earlier ones were answered; latency counts from when a read was due.

    python -m benchmarks.gateway_load --seconds 20
"""

import argparse
import asyncio
import json
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import psutil
import zmq
import zmq.auth

from pup.wire import AgentState, Heartbeat, Hello, Message, encode

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
import gateways

PATHS = ("/v1/studies/load", "/v1/studies/load/trials", "/v1/studies", "/v1/studies/load/posterior")


class Agents(threading.Thread):
    """Agents that greet and send a heartbeat a second each."""

    def __init__(self, service: gateways.Service, count: int) -> None:
        super().__init__(daemon=True)
        self.pairs = [service.agent_keys(f"load-{i}") for i in range(count)]
        self.address, self.done, self.answered, self.sent = service.link, threading.Event(), 0, 0

    def run(self) -> None:
        """Until `done`."""
        context = zmq.Context()
        context.max_sockets = 4096
        sockets, poller = [], zmq.Poller()
        for secret, gateway in self.pairs:
            socket = context.socket(zmq.DEALER)
            socket.linger = 0
            socket.curve_publickey, socket.curve_secretkey = zmq.auth.load_certificate(secret)
            socket.curve_serverkey = zmq.auth.load_certificate(gateway)[0]
            socket.connect(self.address)
            socket.send(encode(Message(Hello("load", "darwin_op2", "1"))))
            sockets.append(socket)
            poller.register(socket, zmq.POLLIN)
        period, turn = 1.0 / len(sockets), 0
        due = time.monotonic()
        while not self.done.is_set():
            for socket, _ in poller.poll(1):
                socket.recv()
                self.answered += 1
            while time.monotonic() > due:
                beat = Heartbeat("load", AgentState.DISABLED, {"voltage": 12.0, "temperature": 40})
                sockets[turn % len(sockets)].send(encode(Message(beat)), zmq.DONTWAIT)
                turn, due, self.sent = turn + 1, due + period, self.sent + 1
        for socket in sockets:
            socket.close()
        context.term()


async def read(
    service: gateways.Service, rate: int, seconds: float, connections: int
) -> list[float]:
    """Latencies of reads at a rate, s."""
    pool: asyncio.Queue[tuple[asyncio.StreamReader, asyncio.StreamWriter]] = asyncio.Queue()
    for _ in range(connections):
        pool.put_nowait(await asyncio.open_connection("127.0.0.1", service.port))
    head = f" HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {service.tokens['viewer']}\r\n\r\n"
    spent: list[float] = []

    async def one(path: str, due: float) -> None:
        reader, writer = await pool.get()
        writer.write(f"GET {path}{head}".encode())
        answer = await reader.readuntil(b"\r\n\r\n")
        assert answer.startswith(b"HTTP/1.1 200"), answer
        lengths = [h for h in answer.lower().split(b"\r\n") if h.startswith(b"content-length:")]
        await reader.readexactly(int(lengths[0].split(b":")[1]))
        spent.append(time.monotonic() - due)
        pool.put_nowait((reader, writer))

    began, tasks = time.monotonic(), []
    for number in range(int(rate * seconds)):
        due = began + number / rate
        await asyncio.sleep(max(0.0, due - time.monotonic()))
        tasks.append(asyncio.create_task(one(PATHS[number % len(PATHS)], due)))
    await asyncio.gather(*tasks)
    return spent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--agents", type=int, default=200)
    parser.add_argument("--rate", type=int, default=1000, help="reads a second")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    with (
        tempfile.TemporaryDirectory() as folder,
        gateways.running(Path(folder) / "data") as service,
    ):
        with service.client() as http:
            asked = gateways.STUDY | {"name": "load", "gate": "operator"}
            http.post("/v1/studies", json=asked).raise_for_status()
            agents = Agents(service, options.agents)
            agents.start()
            time.sleep(10)
            told = http.get("/v1/agents").json()["agents"]
            present = sum(a["present"] for a in told)
        process = psutil.Process(service.process.pid if service.process else None)
        before = sum(process.cpu_times()[:2])
        spent = np.array(asyncio.run(read(service, options.rate, options.seconds, 32)))
        busy = sum(process.cpu_times()[:2]) - before
        with service.client() as http:
            after = sum(a["present"] for a in http.get("/v1/agents").json()["agents"])
        agents.done.set()
        agents.join()
    report = {
        "schema": 1,
        "agents_present": [present, after],
        "heartbeats": agents.sent,
        "answered": agents.answered,
        "reads": len(spent),
        "gateway_cpu_ms_per_read": 1000 * busy / len(spent),
        "p50_ms": 1000 * float(np.quantile(spent, 0.5)),
        "p99_ms": 1000 * float(np.quantile(spent, 0.99)),
        "max_ms": 1000 * float(spent.max()),
    }
    print(json.dumps(report, indent=1))
    if options.out:
        options.out.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()

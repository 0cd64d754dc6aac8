"""Services of one run in one process, each on a thread of its own, over real Zenoh on loopback."""

import re
import socket
import threading
import urllib.request
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field

from common.comms.transport import Transport, TransportError
from common.comms.zenoh_config import ZenohConfig
from common.comms.zenoh_transport import open_zenoh
from common.policy.config import NetworkConfig
from common.service.metrics import Metrics
from common.service.settings import new_incarnation
from services.actor.config import ActorConfig
from services.actor.service import ActorService
from services.evaluator.config import EvaluatorConfig
from services.evaluator.service import EvaluatorService
from services.generator.config import GeneratorConfig
from services.generator.service import GeneratorService
from services.learner.config import CurriculumConfig, IntakeConfig, LearnerConfig, PPOConfig
from services.learner.service import LearnerService

NETWORK = NetworkConfig(units=(32, 16))
PPO = PPOConfig(minibatch=128, mini_epochs=2, refit_frames=1)
ENVS, HORIZON = 16, 16
DATASET = 2 * ENVS * HORIZON  # frames
CURRICULUM = CurriculumConfig(stage_1=3 * DATASET, stage_2=2 * DATASET, stage_3=3 * DATASET)
LONG = CURRICULUM.model_copy(update={"stage_3": 500 * DATASET})


def free_endpoint():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def progress(learner):
    """Return how far a learner in this process has trained."""
    return learner.service.training.progress


@dataclass
class Running:
    """A service on its thread."""

    service: object
    metrics: Metrics
    port: int
    transport: Transport
    stop: threading.Event = field(default_factory=threading.Event)
    thread: threading.Thread | None = None
    error: BaseException | None = None

    def start(self):
        def work():
            try:
                self.service.run(self.stop)
            except BaseException as error:
                self.error = error

        self.thread = threading.Thread(target=work, daemon=True)
        self.thread.start()
        return self

    def join(self, timeout_s=30.0):
        self.thread.join(timeout_s)
        assert not self.thread.is_alive(), f"{type(self.service).__name__} did not end"
        if self.error is not None:
            raise self.error

    def end(self):
        self.stop.set()
        self.join()

    def scrape(self):
        """Return the metrics as Prometheus reads them, over HTTP; without the labels that all of a service's have."""
        with urllib.request.urlopen(f"http://127.0.0.1:{self.port}/metrics", timeout=5) as answer:
            lines = answer.read().decode().splitlines()
        pairs = (line.rsplit(" ", 1) for line in lines if line and not line.startswith("#"))
        own = re.compile(r'(run|role|id)="[^"]*",?')
        return {
            own.sub("", name).replace(",}", "}").removesuffix("{}"): float(value) for name, value in pairs
        }

    def metric(self, name, **labels):
        """Return one metric, 0 if it was never set."""
        return self.metrics.value(name, **labels) or 0.0


class LocalRun:
    """Services of one run that a test starts; everything is closed at the end."""

    def __init__(self, folder, **learner):
        self.folder = folder
        self.endpoint = free_endpoint()
        self.opened = []
        self.running = []
        self.peers = []
        self.learner_settings = {
            "network": NETWORK,
            "ppo": PPO,
            "curriculum": CURRICULUM,
            "intake": IntakeConfig(dataset_rollouts=2),
        } | learner

    def common(self):
        return {"run": "test", "endpoint": self.endpoint, "status_interval_s": 0.1, "connect_timeout_s": 10.0}

    def start(self, make, config, role, *more, run=True):
        transport = open_zenoh(config)
        metrics = Metrics(role, config.id)
        self.opened.append((transport, metrics))
        entry = Running(make(config, transport, metrics, *more), metrics, metrics.serve(0), transport)
        self.running.append(entry)
        return entry.start() if run else entry

    def take_down(self, entry):
        """End a service and its connection, as at the end of its process."""
        entry.end()
        entry.transport.close()
        entry.metrics.close()

    def cut_off(self, entry):
        """Close a service's connection while it runs: the others see it die without a last report."""
        entry.transport.close()
        with suppress(TransportError):
            entry.join()

    def peer(self):
        """Return the connection of a peer that may send anything."""
        transport = open_zenoh(ZenohConfig(endpoint=self.endpoint, connect_timeout_s=10.0))
        self.peers.append(transport)
        return transport

    def learner(self, run=True, **settings):
        values = self.common() | self.learner_settings | {"folder": str(self.folder)} | settings
        return self.start(LearnerService, LearnerConfig(**values), "learner", run=run)

    def actor(self, index=0, run=True, **settings):
        values = self.common() | {
            "network": NETWORK,
            "envs": ENVS,
            "horizon": HORIZON,
            "id": str(index),
            "index": index,
            "shards": 2,
        }
        return self.start(
            ActorService, ActorConfig(**(values | settings)), "actor", new_incarnation(), run=run
        )

    def generator(self, **settings):
        values = self.common() | {"shards": 2, "batch": 32}
        return self.start(
            GeneratorService, GeneratorConfig(**(values | settings)), "generator", new_incarnation()
        )

    def evaluator(self, run=True, **settings):
        values = self.common() | {
            "network": NETWORK,
            "rallies": 20,
            "envs": 10,
            "interval_s": 0.2,
            "folder": str(self.folder),
        }
        return self.start(
            EvaluatorService, EvaluatorConfig(**(values | settings)), "evaluator", new_incarnation(), run=run
        )


@contextmanager
def local_run(folder, **learner):
    """Yield a run; stop and close all that was started in it, the hub last."""
    run = LocalRun(folder, **learner)
    try:
        yield run
    except BaseException as error:
        for entry in run.running:
            if entry.error is not None:
                error.add_note(f"{type(entry.service).__name__} had failed: {entry.error!r}")
        raise
    finally:
        for transport in run.peers:
            transport.close()
        for entry in reversed(run.running):
            entry.stop.set()
            if entry.thread is not None:
                entry.thread.join(30.0)
        for transport, metrics in reversed(run.opened):
            transport.close()
            metrics.close()

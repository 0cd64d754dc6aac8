"""A run whose services connect to a router, the learner too: `python -m deploy.router`."""

from contextlib import contextmanager
from threading import Event, Thread

from deploy.router import main
from tests.integration.in_process_run import LONG, free_endpoint, local_run, progress
from tests.waiting import wait_until


@contextmanager
def router_at(endpoint):
    stop = Event()
    thread = Thread(target=main, args=(["--endpoint", endpoint, "--metrics-port", "0"], stop), daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(30.0)


def test_behind_a_router_a_learner_that_starts_again_costs_no_other_service_its_link(tmp_path):
    endpoint = free_endpoint()
    with router_at(endpoint), local_run(tmp_path, curriculum=LONG) as s:
        s.endpoint = endpoint
        learner = s.learner(mode="client")
        others = [s.generator(), s.actor(0), s.actor(1)]
        wait_until(lambda: progress(learner).epoch >= 4, 60, "training")
        s.take_down(learner)
        before = progress(learner).epoch
        again = s.learner(mode="client", resume=True)
        wait_until(lambda: progress(again).epoch >= before + 4, 60, "training to go on")
        reconnects = [entry.transport.reconnect_count for entry in others]
        for actor in others[1:]:
            actor.end()
        again.end()
        ledger = again.service.ledger()

    assert reconnects == [0, 0, 0]
    assert (ledger.lost, ledger.balance) == (0, 0)

import io
from dataclasses import replace

from rich.console import Console

from common.comms.messages import Status
from deploy.panel import MOST_SERVICES, View, clock, render, share_done, time_left_s


def make_status(role, id_="0", counters=None, gauges=None, state="playing"):
    return Status(role, id_, 1, 1.8e9, state, counters or {}, gauges or {})


def shown(view, now=10.0, width=100):
    console = Console(file=io.StringIO(), width=width, force_terminal=False)
    console.print(render(view, now))
    return console.file.getvalue()


def full_view():
    view = View("night", minutes=10.0)
    gauges = {
        "stage": 3,
        "epoch": 12,
        "epochs": 100,
        "seconds": 300.0,
        "version": 12,
        "frames_per_s": 21_000.0,
    }
    rates = {"catch_rate": 0.913, "return_rate": 0.42, "target_error": 0.51, "reward": 33.3, "lag": 0.5}
    counts = {"frames": 5.2e6, "published": 24.0, "trained": 22.0, "in_flight": 1.0, "lost": 1.0}
    view.hear(make_status("learner", counters=counts, gauges=gauges | rates), 9.0)
    view.hear(make_status("actor", "1", {"frames": 2.6e6}, {"version": 12.0, "metrics_port": 9103.0}), 9.5)
    view.hear(make_status("generator", "0", {"published": 4096.0, "drawn": 300.0, "valid": 87.0}), 3.0)
    view.hear(make_status("evaluator", "0", {"evaluations": 3.0}, {"catch_rate": 0.95, "frames": 5.0e6}), 9.0)
    view.restarts = {"actor-1": 2}
    return view


def test_it_is_drawn_before_the_first_heartbeat():
    text = shown(View("night"))

    assert "Topspin night" in text
    assert "-:--" in text
    assert "reward -" in text  # and not 0.0, which would be a value


def test_it_shows_the_state_of_the_run():
    text = shown(full_view())

    for part in (
        "stage 3 aim",
        "5.20 M frames",
        "21,000 frames/s",
        "91.3 %",
        "0.51 m",
        "95.0 %",
        "29 % valid",
        "lost 1",
    ):
        assert part in text, part
    actor = next(line for line in text.splitlines() if "actor-1" in line)
    assert actor.rstrip(" │").split()[-2:] == ["2", "9103"]
    assert all(len(line) <= 100 for line in text.splitlines())


def test_names_are_shown_as_text_and_not_read_as_markup():
    view = View("night")
    view.hear(make_status("actor", "[/red]", state="[bold"), 1.0)

    assert "actor-[/red]" in shown(view)


def test_the_budget_that_ends_first_decides_the_time_left():
    view = full_view()

    assert share_done(view) == 0.5  # 300 s of 10 min; 12 of 100 epochs
    assert time_left_s(view) == 300.0
    assert clock(3725.0) == "1:02:05"
    assert clock(None) == "-:--"
    assert time_left_s(View("night")) is None


def test_without_a_number_of_epochs_the_frames_decide_the_time_left():
    view = full_view()
    status = view.statuses["learner", "0"]
    gauges = {**status.gauges, "epochs": 0.0, "epoch": 900.0}
    view.statuses["learner", "0"] = replace(status, gauges=gauges, counters={"frames": 30.0})
    view.minutes, view.frames = 0.0, 100

    assert share_done(view) == 0.3


def test_a_peer_of_many_names_does_not_fill_the_panel():
    view = View("night")
    for number in range(MOST_SERVICES + 10):
        view.hear(make_status("actor", str(number)), 0.0)

    assert len(view.statuses) == MOST_SERVICES


def test_actors_of_another_contract_are_shown():
    view = full_view()
    assert "another contract" not in shown(view)
    view.hear(make_status("learner", gauges={"misfits": 2.0}), 9.0)

    assert "2 actors of another contract" in shown(view)

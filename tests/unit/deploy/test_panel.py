import io
import math
from dataclasses import replace

import pytest
from rich.console import Console

from common.comms.messages import Status
from deploy.history import Point, points_of, sparkline, stage_starts
from deploy.panel import MOST_SERVICES, View, clock, render, share_done, time_left_s, written


def make_status(role, id_="0", counters=None, gauges=None, state="playing"):
    return Status(role, id_, 1, 1.8e9, state, counters or {}, gauges or {})


def shown(view, now=10.0, width=80):
    console = Console(file=io.StringIO(), width=width, force_terminal=False)
    console.print(render(view, now))
    return console.file.getvalue()


def full_view():
    view = View("night", minutes=10.0, folder="runs/night", metrics_host="127.0.0.1")
    gauges = {
        "stage": 3,
        "epoch": 12,
        "curriculum_frames": 120e6,
        "seconds": 300.0,
        "version": 12,
        "frames_per_s": 21_000.0,
        "metrics_port": 9100.0,
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
    assert "nan" not in text
    assert text.count(" - ") >= 8  # and not 0.0, which would be a value


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
        "runs/night/tb",
        "http://127.0.0.1:9100/metrics",
    ):
        assert part in text, part
    actor = next(line for line in text.splitlines() if "actor-1" in line)
    assert actor.rstrip(" │").split()[-2:] == ["2", "9103"]


def test_names_are_shown_as_text_and_not_read_as_markup():
    view = View("night")
    view.hear(make_status("actor", "[/red]", state="[bold"), 1.0)

    assert "actor-[/red]" in shown(view)


def test_the_budget_that_ends_first_decides_the_time_left():
    view = full_view()

    assert share_done(view) == 0.5  # 300 s of 10 min; 5.2 of 120 M frames
    assert time_left_s(view) == 300.0
    assert clock(3725.0) == "1:02:05"
    assert clock(None) == "-:--"
    assert time_left_s(View("night")) is None


@pytest.mark.parametrize(("curriculum", "frames", "share"), [(0, 100, 0.3), (120, 0, 0.25), (120, 60, 0.5)])
def test_the_curriculums_frames_or_the_runs_decide_the_time_left(curriculum, frames, share):
    view = full_view()
    status = view.statuses["learner", "0"]
    gauges = {**status.gauges, "curriculum_frames": float(curriculum)}
    view.statuses["learner", "0"] = replace(status, gauges=gauges, counters={"frames": 30.0})
    view.minutes, view.frames = 0.0, frames

    assert share_done(view) == share


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


def long_run(actors=1, frames=53.2e6, run="night"):
    """A run of millions of frames, each number as wide as it gets."""
    view = View(run, frames=120_000_000, folder=f"runs/{run}", metrics_host="127.0.0.1")
    view.history = [
        Point(8192.0 * k, 1 if k < 244 else 2 if k < 366 else 3, min(k / 7000, 1.0)) for k in range(1, 6494)
    ]
    counts = {name: 64_980.0 * actors for name in ("published", "trained")} | {"in_flight": 2.0 * actors}
    rates = {"catch_rate": 1.0, "return_rate": 1.0, "target_error": 0.51, "reward": -133.3, "lag": 1.5}
    update = {"kl": 0.0123, "learning_rate": 1.3e-4, "explained_variance": -0.95, "frames_per_s": 128_103.0}
    gauges = {"stage": 3.0, "epoch": 14_000.0, "seconds": 259_200.0, "version": 14_000.0, "queued": 256.0}
    learner = rates | update | gauges | {"metrics_port": 9100.0}
    view.hear(make_status("learner", counters=counts | {"frames": frames}, gauges=learner), 9.0)
    for k in range(actors):
        numbers = {"version": 14_000.0, "metrics_port": 9103.0 + k}
        view.hear(make_status("actor", str(k), {"frames": frames / actors}, numbers), 9.5)
    generated = {"published": 5.16e7, "drawn": 300.0, "valid": 87.0}
    view.hear(make_status("generator", "0", generated, {"metrics_port": 9102.0}, "publishing"), 9.0)
    measured = {"catch_rate": 1.0, "return_rate": 1.0, "target_error_mean": 0.16, "frames": 5.3e7}
    view.hear(make_status("evaluator", "0", {"evaluations": 4_000.0}, measured), 9.0)
    return view


def just_resumed():
    view = long_run()
    view.statuses.clear()
    view.hear(
        make_status("learner", counters={"frames": 5.32e7}, gauges={"stage": 3.0, "return_rate": math.nan}),
        9.9,
    )
    return view


@pytest.mark.parametrize(
    ("view", "rows"),
    [
        (View("night", frames=60_000_000, folder="runs/night"), 16),
        (full_view(), 23),
        (long_run(), 23),
        (just_resumed(), 19),
        (long_run(actors=2), 24),
        (long_run(actors=100), 23),
        (long_run(run="a-name-of-a-run-as-long-as-a-person-may-well-choose-it-for-a-comparison-0"), 23),
    ],
    ids=["start", "mid", "long", "resumed", "two actors", "hundred actors", "long name"],
)
def test_no_row_wraps_in_80_columns_and_24_rows_are_enough(view, rows):
    lines = shown(view).splitlines()

    assert len(lines) == rows <= 24
    assert {len(line) for line in lines} == {80}
    assert "nan" not in "".join(lines)


def test_numbers_are_whole_at_80_columns():
    text = shown(long_run(actors=100))

    assert "…" not in text.replace("9103 …", "")
    assert "actor × 100 100 playing 53.20 M frames, policy 14000" in text


def test_a_silent_one_of_many_is_named():
    view = long_run(actors=100)
    view.heard["actor", "42"] = 1.0

    assert "actor-42" in shown(view)
    assert "actor-41" not in shown(view)


def test_the_past_of_a_run_is_a_sparkline_and_its_stages():
    text = shown(long_run())

    (line,) = (row for row in text.splitlines() if "return  ▁" in row)
    assert line.index("▁▁▁▂▂▂") < line.index("▆▆▆▇▇▇")  # as the rate rises from 0 to 93 %
    assert "1 catch from 0   2 hit from 1.99 M   3 aim from 2.99 M" in text


def test_a_sparkline_waits_for_rates_and_fills_gaps():
    def points(*rates):
        return [Point(10.0 * k, 1, rate) for k, rate in enumerate(rates, 1)]

    assert sparkline([], 4) == ""
    assert sparkline(points(math.nan, math.nan), 4) == ""
    assert sparkline(points(0.0, 0.5, 1.0), 3) == "▁▅█"
    assert sparkline(points(0.0, 1.0, math.nan, 1.0), 4) == "▁███"
    assert sparkline(points(math.nan, 1.0), 4) == "   █"


def test_a_learner_that_went_back_to_a_checkpoint_takes_its_past_back():
    view = View("night")
    for frames, stage in ((1e6, 1), (2e6, 2), (3e6, 3), (1.5e6, 1), (2.5e6, 2)):
        view.hear(make_status("learner", counters={"frames": frames}, gauges={"stage": stage}), 0.0)

    assert stage_starts(view.history) == [(1, 0.0), (2, 1.5e6)]


def test_the_past_of_a_resumed_run_is_read_from_its_table():
    rows = [
        {"frames": "8192", "stage": "1", "return_rate": "nan"},
        {"frames": "16384", "stage": "2", "return_rate": "0.5"},
    ]

    first, second = points_of(rows)
    assert (first.frames, first.stage, math.isnan(first.return_rate)) == (8192.0, 1, True)
    assert second == Point(16384.0, 2, 0.5)
    assert points_of([{"epoch": "1"}]) == []


def test_a_value_that_is_not_there_yet_is_a_dash():
    assert written({"x": 0.25}, "x", ".1f", " %", 100.0) == "25.0 %"
    assert written({"x": math.nan}, "x", ".1f", " %") == written({}, "x", ".1f") == "-"

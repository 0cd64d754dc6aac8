"""The report's tables beside the paper's."""

from dataclasses import replace

import pytest

from common.evaluation.measures import measures
from common.task.observation import PAPER_OBSERVATION, ObservationConfig
from tests.unit.evaluation.played import MISSED, OUT, RETURNED, make_played
from tests.unit.topspin.report.runs import make_policy, make_result, make_run
from topspin.report.config import ReportConfig
from topspin.report.results import GroupResult, Results, spread
from topspin.report.tables import PAPER, Table, headline, markdown


def test_a_table_is_markdown():
    table = Table("t", ("bin", "rate"), (("a|b", "1 %"), ("ours", "2 %")), frozenset({1}))

    assert markdown(table) == "| bin | rate |\n|---|---:|\n| a\\|b | 1 % |\n| **ours** | 2 % |\n"


def test_the_headline_has_the_papers_rows_and_ours_with_spread_and_interval():
    run = replace(make_run(), policy=make_policy(ObservationConfig()))
    results = [
        make_result(run, [RETURNED] * 8 + [OUT, MISSED]),
        make_result(run, [RETURNED] * 6 + [OUT] * 4, seed=1),
    ]
    rows = [RETURNED] * 14 + [OUT] * 5 + [MISSED]
    names = ("catch_rate", "return_rate", "return_after_catch", "target_error_mean")
    one = GroupResult(
        "stages 1+2+3", "", tuple(results), make_played(rows), measures(make_played(rows)),
        {name: spread(results, name) for name in names}, {}, {},
    )  # fmt: skip
    table = headline(Results((one,), ReportConfig(), {}, {}, ()))

    assert table.rows[: len(PAPER)] == PAPER
    # returned: 0.8 and 0.6, sample deviation 0.1414; 14 of 20; after catch 8/9 and 6/10; 14 of 19
    assert table.rows[len(PAPER) :] == (
        (
            "Topspin, stages 1+2+3 (2 seeds)",
            "no",
            "70.0 ± 14.1 % [48.1, 85.5]",
            "74.4 ± 20.4 % [51.2, 88.2]",
            "0.200 ± 0.000 m [0.200, 0.200]",
        ),
    )


@pytest.mark.parametrize(
    ("observations", "said"),
    [
        ([PAPER_OBSERVATION], "yes"),
        ([PAPER_OBSERVATION.model_copy(update={"history": 4, "age": True})], "yes"),
        ([ObservationConfig()], "no"),
        ([PAPER_OBSERVATION, ObservationConfig()], "no"),
        ([], "–"),
    ],
)
def test_end_to_end_is_what_the_contracts_of_a_row_say(observations, said):
    runs = [replace(make_run(), policy=make_policy(one)) for one in observations] or [make_run()]
    results = [make_result(run, [RETURNED]) for run in runs]
    played = make_played([RETURNED])
    one = GroupResult("ours", "", tuple(results), played, measures(played), {}, {}, {})

    assert headline(Results((one,), ReportConfig(), {}, {}, ())).rows[-1][1] == said


def test_the_papers_rows_name_the_right_works():
    rows = {row[0]: row[3:] for row in PAPER}

    assert rows["Hu et al. 2025, stages 1+2+3"] == ("90 %", "0.31 m")
    assert rows["Focused player (Koç et al. 2018)"] == ("–", "0.25 m")
    assert rows["8dof + GCBC + SSP (GoalsEye, Ding et al. 2022)"] == ("–", "0.84 m")

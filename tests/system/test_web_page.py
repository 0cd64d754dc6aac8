"""A page of `topspin export --web` as a person has it: the real command, any file server, a real browser."""

import json
import re
import shutil

import numpy as np
import pytest

from common.evaluation.match import evaluation_rallies, match_task
from common.evaluation.rally_recorder import record_rallies
from common.policy.box import policy_folder
from common.policy.folder import load_policy
from common.task.config import MatchConditions
from tests.system import browser as browsers
from tests.system.commands import running
from tests.waiting import wait_until
from topspin.web.folder import BALLS, SEED

pytestmark = [
    pytest.mark.skipif(browsers.CHROMIUM is None, reason="no Chromium here"),
    pytest.mark.skipif(shutil.which("npm") is None, reason="no npm here, which fetches the page's libraries"),
]

PLAYED = 40
PLAY = f"""(async () => {{
    const {{ Match }} = await import('./match.js');
    const match = await Match.load(async name => (await fetch(name)).arrayBuffer());
    const balls = await match.balls('paper'), found = [];
    for (let k = 0; k < {PLAYED}; k++) {{
        const {{ outcome, landingError, caught, time }} = await match.play(balls.of(k));
        found.push([outcome, landingError || 0, caught, time]);
    }}
    return found;
}})()"""
BALL = """(() => {
    let found = null;
    for (const scene of scenes) scene.traverse(o => { if (o.name === 'ball') found = o });
    return found && found.position.toArray();
})()"""


@pytest.fixture
def site(tmp_path):
    """The address of an exported page."""
    with running(tmp_path, "topspin", "export", "--web", "page", "--json") as command:
        status, said, errors = command.wait(240)
    if "npm can't fetch" in errors:
        pytest.skip(f"the page's libraries can't be had here: {errors}")
    assert status == 0, errors
    assert json.loads(said)["parity_max"] <= 1e-5
    where = ("--bind", "127.0.0.1", "--directory", tmp_path / "page")
    with running(tmp_path, "http.server", "0", *where, environ={"PYTHONUNBUFFERED": "1"}) as server:
        yield wait_until(lambda: re.findall(r"http://[\d.:]+/", server.out.read_text()), 30, "the server")[0]


def test_a_browser_plays_the_policy_alone_and_as_we_do(site):
    with browsers.browser() as opened:
        tab = opened(site)

        # the ball moves, and pause holds it
        first = tab.wait(BALL, "the ball")
        tab.wait(f"String({BALL}) !== {','.join(map(str, first))!r}", "the ball's motion")
        tab.click("Pause")
        tab.wait("document.getElementById('pause').innerText === 'Play'", "the pause")
        still = tab.value(BALL)
        assert tab.value(f"new Promise(r => setTimeout(() => r({BALL}), 300))") == still

        # the next ball, and another kind of ball, whose score begins again
        tab.click("Next ball")
        tab.wait("document.getElementById('number').innerText === '2'", "another ball")
        assert tab.value("document.getElementById('returned').innerText") in ("0 %", "100 %")
        tab.value(
            "(k => { k.value = 'elite'; k.dispatchEvent(new Event('change')) })(document.getElementById('kind'))"
        )
        tab.wait("document.getElementById('number').innerText === '1'", "the first ball of another kind")
        assert tab.value("document.getElementById('returned').innerText") == "–"
        tab.wait("parseFloat(document.getElementById('flight').innerText) > 12", "a fast ball")

        # the same balls end as they do here
        outcomes, landing_errors, caught, times = np.array(tab.value(PLAY)).T
        policy = load_policy(policy_folder("default"))
        task = match_task(policy.contract, MatchConditions())
        balls = evaluation_rallies(BALLS, task, SEED).of(np.arange(PLAYED))
        ours = record_rallies(policy.act, balls, task)
        same = outcomes == [rally.outcome for rally in ours]
        assert same.mean() >= 0.95
        # MuJoCo of the browser is another version: its robot differs by a tenth of a millimetre
        theirs = np.nan_to_num([rally.landing_error for rally in ours])
        assert np.median(np.abs(landing_errors - theirs)[same]) < 0.001
        assert abs((outcomes == 1).mean() - np.mean([rally.outcome == 1 for rally in ours])) <= 0.05
        assert caught.mean() > 0.9
        assert times.min() > 0.5

        assert tab.errors == []
        assert all(address.startswith((site, "data:", "blob:")) for address in tab.requests)

"""`topspin view` as a person has it: the real command, in a real browser."""

import re
import signal

import pytest

from tests.system import browser as browsers
from tests.system.commands import running
from tests.waiting import wait_until

pytest.importorskip("viser", reason="viser is missing: pip install -e '.[view]'")
pytestmark = pytest.mark.skipif(browsers.CHROMIUM is None, reason="no Chromium here")

BALL = """(() => {
    let found = null;
    for (const scene of scenes) scene.traverse(o => { if (o.isMesh && /^geometry/.test(o.name)) found = o });
    return found && [...found.matrixWorld.elements].slice(12, 15);
})()"""
MESHES = "(() => { let n = 0; for (const s of scenes) s.traverse(o => { n += !!o.isMesh }); return n })()"
FRAMES = "new Promise(r => { let n = 8; const f = () => n-- ? requestAnimationFrame(f) : r(true); f() })"


def number_of(tab):
    """Return the number of the ball in play."""
    return int(tab.wait("(document.body.innerText.match(/Ball (\\d+)/) || [])[1]", "the ball's number"))


def test_a_person_watches_pauses_and_asks_for_balls(tmp_path):
    with running(tmp_path, "topspin", "view", "--port", "0") as command, browsers.browser() as opened:
        url = wait_until(lambda: re.findall(r"http://\S+", command.out.read_text()), 240, "the page")[0]
        tab = opened(url)

        # robot and ball are there, and the ball moves
        first = tab.wait(BALL, "the ball")
        assert tab.value(MESHES) > 60
        tab.wait(f"String({BALL}) !== {','.join(map(str, first))!r}", "the ball's motion")
        tab.wait("/plays at \\d\\.\\d\\d x real time/.test(document.body.innerText)", "the pace")

        # pause: nothing moves any more
        tab.click("Pause")
        tab.wait("/paused/.test(document.body.innerText)", "the pause")
        tab.value(FRAMES)
        still = tab.value(BALL)
        tab.value(FRAMES)
        assert tab.value(BALL) == still

        # next ball
        before = number_of(tab)
        tab.click("Next ball")
        tab.wait(f"(document.body.innerText.match(/Ball (\\d+)/) || [])[1] > {before}", "another ball")

        # slow motion
        tab.write("Playback", "0.5")
        tab.wait("/slow motion 0.5 x/.test(document.body.innerText)", "slow motion")

        # another launch preset has other balls: elite ones are faster than all of paper
        tab.click("paper")
        tab.click("elite")
        tab.wait("/Ball \\d+ elite/.test(document.body.innerText)", "an elite ball")
        tab.wait("(document.body.innerText.match(/([\\d.]+) m\\/s/) || [])[1] > 12", "a fast ball")

        # a ball of one's own: refused with its reason, or played
        tab.click("Serve")
        tab.wait("/valid: a ball of a rally/.test(document.body.innerText)", "the judgement")
        tab.write("Speed [m/s]", "2")
        tab.wait("/not valid: it bounces twice on its own court/.test(document.body.innerText)", "a refusal")
        tab.write("Speed [m/s]", "7.5")
        tab.wait("!/not valid/.test(document.body.innerText)", "a valid ball")
        tab.click("Serve this ball")
        tab.wait("/Ball \\d+ your ball/.test(document.body.innerText)", "the ball that was asked for")
        tab.wait("/\\b7\\.5 m\\/s/.test(document.body.innerText)", "its speed")

        # another tab sees the same game
        other = opened(url)
        tab.click("Pause")
        tab.wait("/paused/.test(document.body.innerText)", "the pause")
        other.wait("/paused/.test(document.body.innerText)", "the same pause in another tab")
        assert number_of(other) == number_of(tab)

        for each in (tab, other):
            assert each.errors == []
            assert all(address.startswith((url, "data:", "blob:")) for address in each.requests)
        command.process.send_signal(signal.SIGINT)
        status, _, errors = command.wait(60)
        assert (status, errors) == (0, "")

"""Chromium without a display, driven by its DevTools protocol: one tab, clicked and read as a person would."""

import contextlib
import itertools
import json
import shutil
import subprocess
import tempfile
from pathlib import Path

from websockets.sync.client import connect

from tests.waiting import wait_until

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-quic", "--disable-sync"),
    *(
        "--use-gl=angle",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--force-device-scale-factor=0.4",
    ),
    *("--disable-background-networking", "--disable-component-update", "--remote-debugging-port=0"),
)
SIZE = (820, 560)  # [pixels] of the page; few of the screen, because a processor draws them

# three.js shows its scenes to whoever listens here; the tests read them
WATCH_SCENES = """
window.scenes = []; window.__THREE_DEVTOOLS__ = new EventTarget();
window.__THREE_DEVTOOLS__.addEventListener('observe', e => { if (e.detail.isScene) scenes.push(e.detail) });
"""


class Tab:
    """One tab of a browser.

    Attributes:
        errors: What the page wrote to its console as errors, and its exceptions.
        requests: Addresses that it asked for.
    """

    def __init__(self, port, path, url):
        self.errors, self.requests = [], []
        self._numbers = itertools.count(1)
        with connect(f"ws://127.0.0.1:{port}{path}", max_size=None) as browser:
            browser.send(
                json.dumps({"id": 1, "method": "Target.createTarget", "params": {"url": "about:blank"}})
            )
            target = json.loads(browser.recv(30))["result"]["targetId"]
        self._socket = connect(f"ws://127.0.0.1:{port}/devtools/page/{target}", max_size=None)
        for domain in ("Runtime", "Log", "Network", "Page"):
            self.call(f"{domain}.enable")
        self.call("Page.addScriptToEvaluateOnNewDocument", source=WATCH_SCENES)
        self.call("Page.navigate", url=url)

    def call(self, method, **params):
        """Return a command's result."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            message = json.loads(self._socket.recv(60))
            if message.get("id") == number:
                assert "error" not in message, message
                return message["result"]
            self._note(message)

    def value(self, script):
        """Return the value of an expression in the page; a promise is awaited."""
        found = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def wait(self, script, what, timeout_s=60):
        """Return the first true value of an expression."""
        return wait_until(lambda: self.value(script), timeout_s, f"{what}; the page says: {self.text()}")

    def text(self):
        """Return the page's text."""
        return self.value("document.body ? document.body.innerText : ''")

    def click(self, text):
        """Click on the last visible element with exactly this text or value, once it is there."""
        where = self.wait(
            f"""(() => {{
                const all = [...document.querySelectorAll('button, [role=option], [role=tab], label, input')];
                const says = e => (e.innerText || e.value || '').trim() === {json.dumps(text)};
                const found = all.filter(e => says(e) && e.offsetWidth && !e.disabled).pop();
                if (!found) return null;
                found.scrollIntoView({{block: 'center'}});
                const box = found.getBoundingClientRect();
                return [box.x + box.width / 2, box.y + box.height / 2];
            }})()""",
            f"{text!r} to click on",
        )
        for kind in ("mousePressed", "mouseReleased"):
            self.call(
                "Input.dispatchMouseEvent", type=kind, x=where[0], y=where[1], button="left", clickCount=1
            )

    def write(self, label, text):
        """Write into the field beside a label."""
        self.wait(
            f"""(() => {{
                const label = [...document.querySelectorAll('label')].find(e => e.innerText === {json.dumps(label)});
                if (!label) return false;
                let around = label;
                while (around && !around.querySelector('input[type=text], input:not([type=hidden])'))
                    around = around.parentElement;
                const field = [...around.querySelectorAll('input')].pop();
                field.focus(); field.select();
                return document.activeElement === field;
            }})()""",
            f"a field beside {label!r}",
        )
        self.call("Input.insertText", text=text)
        for kind in ("keyDown", "keyUp"):
            self.call(
                "Input.dispatchKeyEvent", type=kind, key="Enter", code="Enter", windowsVirtualKeyCode=13
            )

    def close(self):
        self._socket.close()

    def _note(self, message):
        method, params = message.get("method"), message.get("params", {})
        if method == "Runtime.exceptionThrown":
            self.errors.append(params["exceptionDetails"])
        elif method == "Runtime.consoleAPICalled" and params["type"] in ("error", "assert"):
            self.errors.append(params["args"])
        elif method == "Log.entryAdded" and params["entry"]["level"] == "error":
            self.errors.append(params["entry"])
        elif method == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])


@contextlib.contextmanager
def browser():
    """Yield a function that opens a tab of a browser of its own."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        size = "--window-size={},{}".format(*SIZE)
        process = subprocess.Popen(
            [CHROMIUM, *FLAGS, size, f"--user-data-dir={profile}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        tabs = []
        try:
            file = Path(profile) / "DevToolsActivePort"
            port, path = wait_until(
                lambda: file.exists() and len(lines := file.read_text().splitlines()) == 2 and lines,
                30,
                "the browser",
            )

            def opened(url):
                tabs.append(Tab(port, path, url))
                return tabs[-1]

            yield opened
        finally:
            for tab in tabs:
                tab.close()
            process.kill()  # a friendly end takes it 20 s
            process.wait()

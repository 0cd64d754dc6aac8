import logging
import os
import signal
import subprocess
import sys
import threading
import warnings

import pytest

from common.comms.transport import TransportError
from common.config import ConfigError, HelpRequest
from common.errors import ReportedError
from common.log import set_up_logging
from common.process import run_service


@pytest.fixture(autouse=True)
def _restored():
    """Signals, log handlers and the way warnings go are the process's own."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    root = logging.getLogger()
    before, level = list(root.handlers), root.level
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)
    for handler in set(root.handlers) - set(before):
        handler.close()
    root.handlers[:], root.level = before, level
    logging.captureWarnings(False)


def raising(error: BaseException):
    def main(_stop: threading.Event) -> int:
        raise error

    return main


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (ConfigError("unknown flag --x"), 2, "learner: unknown flag --x\n"),
        (TransportError("no hub answered"), 1, "learner: no hub answered\n"),
    ],
)
def test_a_known_error_is_one_line_and_a_status(capsys, error, status, line):
    assert run_service("learner", raising(error)) == status
    assert capsys.readouterr().err == line


def test_a_service_may_have_reported_errors_of_its_own(capsys):
    class CheckpointError(ReportedError):
        pass

    assert run_service("learner", raising(CheckpointError("checkpoint x is not readable"))) == 1
    assert capsys.readouterr().err == "learner: checkpoint x is not readable\n"


def test_help_goes_to_stdout_and_is_no_error(capsys):
    assert run_service("learner", raising(HelpRequest("usage: learner\n"))) == 0
    assert capsys.readouterr().out == "usage: learner\n"


def test_a_bug_keeps_its_traceback(caplog):
    assert run_service("learner", raising(ZeroDivisionError("1/0"))) == 1
    assert "stopped by a bug" in caplog.text
    assert "ZeroDivisionError: 1/0" in caplog.text


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_asks_the_service_to_stop(number):
    def main(stop: threading.Event) -> int:
        os.kill(os.getpid(), number)
        return 0 if stop.wait(5.0) else 1

    assert run_service("learner", main) == 0


def run_python(program: str, *, until: str) -> subprocess.Popen[str]:
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == until
    return process


@pytest.mark.parametrize("first", ["SIGINT", "SIGTERM"])
@pytest.mark.parametrize(
    ("then", "patience_s", "status"),
    [
        (["SIGINT"], 60.0, 130),  # a person insists
        (["SIGTERM"], 0.0, 130),  # told again, and long enough ago
        (["SIGTERM"] * 3, 60.0, 7),  # a service manager told the whole group, then deploy.local its own
    ],
)
def test_who_is_told_again_to_stop_leaves_at_once_unless_it_is_an_echo_of_the_first(
    first, then, patience_s, status
):
    program = f"""
import os, signal, sys
import common.process
common.process.INSISTS_AFTER_S[signal.SIGTERM] = {patience_s}
def main(stop):
    os.kill(os.getpid(), signal.{first})
    stop.wait(5.0)
    print("asked", flush=True)
    for name in {then}:
        os.kill(os.getpid(), getattr(signal, name))
    return 7  # all that was to be done has been done
sys.exit(common.process.run_service("learner", main))
"""
    with run_python(program, until="asked\n") as process:
        assert process.wait(timeout=10) == status


def test_a_thread_that_nobody_stopped_does_not_keep_the_process():
    program = """
import sys, threading, common.process
common.process._EXIT_WITHIN_S = 0.1
def main(stop):
    threading.Thread(target=threading.Event().wait).start()
    print("started", flush=True)
    return 3
sys.exit(common.process.run_service("learner", main))
"""
    with run_python(program, until="started\n") as process:
        assert process.wait(timeout=10) == 3


def test_log_lines_tell_time_level_who_and_where(capsys, tmp_path):
    file = tmp_path / "logs" / "learner.log"
    set_up_logging("info", "learner/0", file)
    logging.getLogger("services.learner").info("policy published version=%d", 3)
    logging.getLogger("services.learner").debug("unseen")
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        logging.captureWarnings(True)
        warnings.warn("odd", UserWarning, stacklevel=1)

    for text in (capsys.readouterr().err, file.read_text()):
        first, second, *_ = text.splitlines()
        assert first.endswith("Z INFO    learner/0 services.learner policy published version=3")
        assert "odd" in second


def test_logging_set_up_again_replaces_what_was_there(capsys):
    set_up_logging("info", "a")
    set_up_logging("error", "b")
    logging.getLogger("x").error("once")
    logging.getLogger("x").info("unseen")

    assert capsys.readouterr().err.count("\n") == 1

import errno
import logging
import os
import signal
import subprocess
import sys
import threading
import warnings

import pytest

from common.comms.transport import TransportError
from common.errors import ConfigError, HelpRequest, ReportedError, StoppedError
from common.policy.contract import NoPolicyError
from common.service.log import set_up_logging
from common.service.process import run_service


@pytest.fixture(autouse=True)
def _restored():
    """Restore signals, log handlers and warnings, which belong to the process."""
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
        (StoppedError("stopped before it was done"), 130, "learner: stopped before it was done\n"),
        (NoPolicyError("no policy 'x'"), 2, "learner: no policy 'x'\n"),
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


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (PermissionError(errno.EACCES, "Permission denied", "runs/a"), "runs/a: Permission denied"),
        (OSError(errno.EINVAL, "Invalid argument", "/mnt/x"), "/mnt/x: Invalid argument"),
        (OSError(errno.ENOSPC, "No space left on device"), "No space left on device"),
        (BrokenPipeError(errno.EPIPE, "Broken pipe"), "Broken pipe"),
        (MemoryError("Unable to allocate 9 TiB"), "Unable to allocate 9 TiB"),
        (MemoryError(), "Cannot allocate memory"),
    ],
)
def test_a_fault_of_the_machine_is_one_line_and_no_bug(capsys, caplog, error, line):
    assert run_service("learner", raising(error)) == 1
    assert capsys.readouterr().err == f"learner: {line}\n"
    assert caplog.records == []


DRAWS = """
import sys
from common.service.process import run_service
def main(_stop):
    from matplotlib.figure import Figure
    Figure().savefig("/dev/null", format="png")
    print("\u2713")
    return 0
sys.exit(run_service("p", main))
"""


def test_a_persons_environment_does_not_reach_our_programs():
    done = subprocess.run(
        [sys.executable, "-c", DRAWS],
        env=os.environ
        | {"PYTHONIOENCODING": "ascii", "MPLBACKEND": "module://matplotlib_inline.backend_inline"},
        capture_output=True,
        text=True,
        check=False,
    )

    assert (done.returncode, done.stdout) == (0, "\\u2713\n"), done.stderr


def test_help_goes_to_stdout_and_is_no_error(capsys):
    assert run_service("learner", raising(HelpRequest("usage: learner\n"))) == 0
    assert capsys.readouterr().out == "usage: learner\n"


def test_a_bug_keeps_its_traceback(caplog):
    assert run_service("learner", raising(ZeroDivisionError("1/0"))) == 1
    assert "stopped by a bug" in caplog.text
    assert "ZeroDivisionError: 1/0" in caplog.text


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_sets_the_stop_event(number):
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
        (["SIGINT"], 60.0, 130),  # a person's second Ctrl-C
        (["SIGTERM"], 0.0, 130),  # a second signal after the patience
        (["SIGTERM"] * 3, 60.0, 7),  # signals from a service manager and from deploy.local
    ],
)
def test_a_second_signal_ends_the_process_at_once_unless_it_repeats_the_first(
    first, then, patience_s, status
):
    program = f"""
import os, signal, sys
import common.service.process
common.service.process.SECOND_SIGNAL_AFTER_S[signal.SIGTERM] = {patience_s}
def main(stop):
    os.kill(os.getpid(), signal.{first})
    stop.wait(5.0)
    print("stopping", flush=True)
    for name in {then}:
        os.kill(os.getpid(), getattr(signal, name))
    return 7  # all work is done
sys.exit(common.service.process.run_service("learner", main))
"""
    with run_python(program, until="stopping\n") as process:
        assert process.wait(timeout=10) == status


def test_a_thread_that_was_not_stopped_does_not_keep_the_process():
    program = """
import sys, threading, common.service.process
common.service.process._EXIT_WITHIN_S = 0.1
def main(stop):
    threading.Thread(target=threading.Event().wait).start()
    print("started", flush=True)
    return 3
sys.exit(common.service.process.run_service("learner", main))
"""
    with run_python(program, until="started\n") as process:
        assert process.wait(timeout=10) == 3


def test_log_lines_have_time_level_service_and_module(capsys, tmp_path):
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


def test_a_second_set_up_of_logging_replaces_the_first(capsys):
    set_up_logging("info", "a")
    set_up_logging("error", "b")
    logging.getLogger("x").error("once")
    logging.getLogger("x").info("unseen")

    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("value", ["", "EGL", "osmesa ", "disable", "glfw"])
def test_a_graphics_library_that_mujoco_knows_is_left_alone(monkeypatch, value):
    monkeypatch.setenv("MUJOCO_GL", value)

    assert run_service("topspin evaluate", lambda _stop: 0) == 0


def test_a_graphics_library_that_mujoco_cant_be_imported_with_is_one_line(monkeypatch, capsys):
    monkeypatch.setenv("MUJOCO_GL", "bogus")

    assert run_service("topspin evaluate", lambda _stop: pytest.fail("it runs")) == 2
    assert capsys.readouterr().err == (
        "topspin evaluate: MUJOCO_GL = 'bogus'; allowed: egl, osmesa, glfw, disable, or unset\n"
    )

from contextlib import closing

import pytest

from common.service.metrics import Metrics
from deploy.ask import main


def test_the_status_is_0_while_a_service_is_well_and_otherwise_1_with_its_reason(capsys):
    with closing(Metrics("actor", "0")) as metrics:
        url = f"http://127.0.0.1:{metrics.serve(0)}/healthz"
        before = main([url])
        metrics.health.turn()
        after = main([url])
    gone = main([url])

    assert (before, after, gone) == (1, 0, 1)
    assert "503: the main loop has not begun" in capsys.readouterr().err


@pytest.mark.parametrize("argv", [[], ["file:///etc/passwd"], ["http://a", "http://b"]])
def test_anything_but_one_url_is_refused(argv, capsys):
    assert main(argv) == 2
    assert "allowed: one URL http://..." in capsys.readouterr().err

"""Runs on machines that are not their author's: file systems without links, and somebody else's environment."""

import shutil

from tests.no_links import refuse_links, skip_without_filter
from tests.system.commands import TINY, last_json, run

DATASET = 16 * 32  # frames
STAGES = ["--learner.curriculum.stage-1", str(DATASET), "--learner.curriculum.stage-2", str(DATASET)]
FLAGS = ["--run", "r", *TINY, *STAGES, "--final-rallies", "10"]
SOMEBODYS = {
    "PYTHONWARNINGS": "error",
    "MPLBACKEND": "module://matplotlib_inline.backend_inline",
    "TERM": "dumb",
    "FORCE_COLOR": "1",
    "TZ": "Asia/Kathmandu",
    "LC_ALL": "C",
    "OMP_NUM_THREADS": "7",
}


def test_a_run_on_a_file_system_without_links_is_copied_as_plain_files_and_goes_on(tmp_path):
    skip_without_filter()
    how = {"environ": SOMEBODYS, "before": refuse_links}
    status, _, err = run(tmp_path, "deploy.local", *FLAGS, "--learner.curriculum.stage-3", DATASET, **how)

    assert status == 0, err
    assert "no link to the newest run" in err
    assert "Traceback" not in err
    assert "\x1b" not in err
    assert not any(path.is_symlink() for path in tmp_path.rglob("*"))
    copy = tmp_path / "copy"
    shutil.copytree(tmp_path / "runs", copy / "runs")
    shutil.copytree(copy / "runs" / "r", copy / "runs" / "latest")  # as a copy that followed the link
    resumed = [
        "--run",
        "r",
        "--resume",
        "--learner.curriculum.stage-3",
        2 * DATASET,
        "--evaluate",
        "false",
        "--json",
    ]
    status, out, err = run(copy, "deploy.local", *resumed, **how)

    assert status == 0, err
    assert last_json(out)["frames"] == 4 * DATASET

"""Curves in other programs' files: with the libraries where they are installed, and one clear line where not."""

import sys

import pytest

from common.errors import ConfigError, ReportedError
from services.learner.trackers import MlflowWriter, WandbWriter


def test_mlflow_keeps_the_curves_and_a_resumed_run_goes_on(tmp_path, monkeypatch):
    mlflow = pytest.importorskip("mlflow", reason="MLflow is an extra of its own")
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    with pytest.raises(ConfigError, match="needs MLFLOW_TRACKING_URI"):
        MlflowWriter("night", tmp_path)
    where = (tmp_path / "kept").as_uri()
    monkeypatch.setenv("MLFLOW_TRACKING_URI", where)
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    for frames, rate in ((8192, 0.25), (16_384, 0.5)):  # the second life of a run
        writer = MlflowWriter("night", tmp_path)
        writer.write(frames, {"play/return_rate": rate, "progress/stage": 3.0})
        writer.close()

    client = mlflow.MlflowClient(tracking_uri=where)
    (experiment,) = [found for found in client.search_experiments() if found.name == "topspin"]
    (run,) = client.search_runs([experiment.experiment_id])
    history = client.get_metric_history(run.info.run_id, "play/return_rate")
    assert [(point.step, point.value) for point in history] == [(8192, 0.25), (16_384, 0.5)]
    assert run.info.run_name == "night"


def test_weights_and_biases_keeps_the_curves_without_a_network(tmp_path, monkeypatch):
    pytest.importorskip("wandb", reason="Weights & Biases is an extra of its own")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    writer = WandbWriter("night", tmp_path)
    writer.write(8192, {"play/return_rate": 0.25})
    writer.close()

    (file,) = tmp_path.glob("wandb/offline-run-*-topspin-night/run-topspin-night.wandb")
    assert b"play/return_rate" in file.read_bytes()
    assert b"0.25" in file.read_bytes()


@pytest.mark.parametrize(("writer", "name"), [(WandbWriter, "wandb"), (MlflowWriter, "mlflow")])
def test_a_library_that_is_missing_is_named(writer, name, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ReportedError, match=rf"--writers {name} needs {name}: pip install -e '\.\[{name}\]'"):
        writer("night", tmp_path)

"""A run reads its tables again after they changed, and a worker gets its configuration and folder alone."""

import pickle
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import pyarrow as pa
import pytest
from short_demonstrations import BOWL
from short_runs import run_in

from pipeline.config import RenderConfig, ReplayConfig, load
from pipeline.libero.demonstrations import DemoEntry
from pipeline.planning import plan
from pipeline.run import manifest
from pipeline.run.run import Run


@pytest.fixture
def rows() -> list[plan.Row]:
    """Two clean twins."""
    demos = [DemoEntry(BOWL, key, "test", "human", "0", steps=100) for key in ("demo_0", "demo_1")]
    return plan.twins(demos, 0, ReplayConfig())


def write_manifest(rows: Sequence[plan.Row], run: Run) -> None:
    table = pa.Table.from_pylist([asdict(row) for row in rows], schema=manifest.schema())
    settings = manifest.Settings(source="starter", replay=ReplayConfig(), render=RenderConfig())
    manifest.write(table, run.manifest_file, settings)


def test_a_plan_is_read_again_after_its_file_changed(rows: list[plan.Row], tmp_path: Path) -> None:
    run = run_in(tmp_path / "mine")
    plan.write(rows, run.plan_file)
    assert run.plan == rows
    plan.write(rows[1:], run.plan_file)
    assert run.plan == rows[1:]


def test_a_manifest_is_read_again_after_its_file_changed(rows: list[plan.Row], tmp_path: Path) -> None:
    run = run_in(tmp_path / "mine")
    write_manifest(rows, run)
    assert [row["episode_id"] for row in run.manifest] == [row.episode_id for row in rows]
    write_manifest(rows[1:], run)
    assert [row["episode_id"] for row in run.manifest] == [rows[1].episode_id]


def test_a_worker_gets_the_configuration_and_the_folder_alone(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(finished.parents[1])
    run = Run(load(Path("configs/tiny.yaml")))
    before = len(pickle.dumps(run))
    kept = run.outcome.kept
    assert kept
    assert len(pickle.dumps(run)) == before
    sent: Run = pickle.loads(pickle.dumps(run))
    assert (sent.folder, sent.config, sent.outcome.kept) == (run.folder, run.config, kept)


def test_a_link_to_a_folder_of_another_name_is_resolved(tmp_path: Path) -> None:
    """As a run's folder that was moved to another disk."""
    disk = tmp_path.resolve() / "disk" / "moved"
    disk.mkdir(parents=True)
    (tmp_path / "mine").symlink_to(disk)
    run = run_in(tmp_path / "mine").resolved()
    sent: Run = pickle.loads(pickle.dumps(run))
    assert run.folder == sent.folder == disk

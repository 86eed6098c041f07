"""Stages that are started again do nothing where nothing has changed, and notice what has."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from checkout import dvc
from faults import rot
from short_runs import run_in
from synthetic import episodes, write_rlds

from pipeline import identity, stages
from pipeline.config import Config, load
from pipeline.formats.rlds import Rlds
from pipeline.run import dataset_basis, export
from pipeline.run.dataset_files import is_unchanged
from pipeline.run.finished import StageRecord, previews_record, report_record, summary_record, validate_record
from pipeline.run.run import Run
from pipeline.stores.store import TABLE

RECORDS: tuple[Callable[[Run], StageRecord], ...] = (validate_record, summary_record, report_record, previews_record)


@pytest.fixture
def clone(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of a finished run, which the process works in."""
    folder = shutil.copytree(finished.parent.parent, tmp_path / "clone", symlinks=True)
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture
def config(clone: Path) -> Config:
    return load(Path("configs/tiny.yaml"))


def hold(config: Config) -> list[bool]:
    """Whether ``validate``, ``summary`` and ``report`` would do nothing, and ``summary`` would leave the previews."""
    return [of(Run(config)).is_up_to_date() for of in RECORDS]


def largest(folder: Path) -> Path:
    return max((file for file in folder.rglob("*") if file.is_file()), key=lambda file: file.stat().st_size)


def test_a_finished_run_is_remembered_until_something_changes(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    assert hold(config) == [True, True, True, True]
    elsewhere = config.model_copy(update={"compute": config.compute.model_copy(update={"workers": 3})})
    assert hold(elsewhere) == [True, True, True, True], "where it is computed changes nothing"
    cases: dict[identity.Step, list[bool]] = {
        "checks": [False, True, True, True],
        "pictures": [True, False, False, False],
    }
    for step, expected in cases.items():
        with monkeypatch.context() as patch:
            identity._parts.cache_clear()
            patch.setitem(identity.RECIPES, step, identity.RECIPES[step] + 1)
            assert hold(config) == expected
        identity._parts.cache_clear()


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("rlds", [False, True, True, True]),
        ("lerobot", [False, True, True, True]),
        ("frames", [False, False, False, True]),
        ("trajectories", [False, True, True, True]),
        ("manifest.parquet", [False, False, False, True]),
        ("counts.json", [False, True, True, True]),
        ("validation.json", [False, True, True, True]),
        ("sheets", [True, False, False, True]),
        ("previews", [True, False, False, False]),
        ("report.html", [True, True, False, True]),
    ],
)
def test_a_changed_file_is_noticed(config: Config, name: str, expected: list[bool]) -> None:
    file = config.run_folder / name
    changed = largest(file) if file.is_dir() else file
    changed.write_bytes(changed.read_bytes() + b"\n")
    assert hold(config) == expected


def test_previews_are_rendered_again_for_other_views(tmp_path: Path) -> None:
    previews_record(run_in(tmp_path)).write()
    assert previews_record(run_in(tmp_path)).is_up_to_date()
    smaller = run_in(tmp_path, render={"size_px": 128})
    assert previews_record(smaller).is_up_to_date(), "previews have a size of their own"
    further = run_in(tmp_path, render={"views": ["frontview"]})
    assert not previews_record(further).is_up_to_date()
    previews_record(further).write()
    assert previews_record(further).is_up_to_date()
    assert not previews_record(run_in(tmp_path, render={"views": ["birdview"]})).is_up_to_date()


@pytest.mark.parametrize(
    ("name", "stage"),
    [
        ("datasets.json", "export_rlds"),
        ("rlds", "export_rlds"),
        ("lerobot", "export_lerobot"),
        ("frames", "render"),
        ("trajectories", "replay"),
    ],
)
def test_a_lost_file_is_named(config: Config, name: str, stage: str) -> None:
    lost = config.run_folder / name
    if lost.is_dir():
        lost = max(lost.rglob("*.*"), key=lambda file: (file.is_file() and file.name != TABLE, file.stat().st_size))
    assert stages.reason_to_run(stage, Run(config)) is None
    lost.unlink()
    reason = f"{lost.relative_to(config.run_folder).as_posix()} is missing"
    assert stages.reason_to_run(stage, Run(config)) == reason
    if name != "datasets.json":
        assert validate_record(Run(config)).reason_to_run() == reason


def test_what_found_something_off_is_not_remembered(config: Config) -> None:
    rot(largest(config.run_folder / "rlds"))
    (config.run_folder / "validation.json").unlink()
    assert not validate_record(Run(config)).is_up_to_date(), "so everything is read again, also what looks unchanged"


def test_a_dataset_with_a_lost_or_changed_file_counts_as_not_there(config: Config) -> None:
    for one in config.export.datasets(config.run_folder, config.render.content):
        content = {name: (one.folder / name).read_bytes() for name in one.record().files}
        name = max(content, key=lambda name: len(content[name]))
        # As in a copy that has the time of the copying.
        (one.folder / name).write_bytes(content[name])
        export.notice_changes(one)
        assert is_unchanged(one)
        (one.folder / name).write_bytes(content[name][:-1])
        export.notice_changes(one)
        assert not one.record_file.exists()


def test_a_finished_dataset_is_generated_again_only_where_that_was_allowed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target, same = write_rlds(tmp_path), episodes()
    assert not dataset_basis.outdated(target, same)
    number = Rlds.recipe + 1
    monkeypatch.setattr(Rlds, "recipe", number)
    assert not dataset_basis.is_up_to_date(target, same)
    files = len(target.record().files)
    reason = f"files, generated with recipe of rlds {number - 1}, here {number}"
    assert dataset_basis.outdated(target, same) == {reason: files}
    assert not dataset_basis.outdated(target, episodes(content="other episodes")), "which somebody asked for"


def test_a_lost_shard_is_made_again_and_a_damaged_trajectory_once_it_is_moved_away(clone: Path, config: Config) -> None:
    shard = largest(config.run_folder / "rlds")
    trajectory = next((config.run_folder / "trajectories").glob("*.npz"))
    before = shard.read_bytes(), trajectory.read_bytes()
    shard.unlink()
    trajectory.write_bytes(before[1][: len(before[1]) // 2])
    stopped = dvc(clone, "repro", "exports")
    assert stopped.returncode != 0
    assert f"{trajectory.name}: the file is damaged" in stopped.stdout + stopped.stderr
    assert len(trajectory.read_bytes()) == len(before[1]) // 2
    trajectory.rename(clone / trajectory.name)
    done = dvc(clone, "repro", "exports")
    assert done.returncode == 0, done.stdout + done.stderr
    assert (shard.read_bytes(), trajectory.read_bytes()) == before

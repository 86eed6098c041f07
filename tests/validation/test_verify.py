"""A flipped bit in a file of any part is found, and what is damaged is not read any further."""

import shutil
from contextlib import chdir
from pathlib import Path

import pytest
from faults import rot

from pipeline.compute.pool import loop
from pipeline.config import load
from pipeline.run.run import Run
from pipeline.validation.validate import validate
from pipeline.validation.verify import verify


@pytest.mark.parametrize("part", ["trajectories", "frames", "rlds", "lerobot"])
def test_verify_finds_a_flipped_bit(part: str, finished: Path, tmp_path: Path) -> None:
    data = tmp_path / "data" / "tiny"
    shutil.copytree(finished, data)
    config = load(finished.parent.parent / "configs" / "tiny.yaml")
    with chdir(tmp_path):
        assert all(result["checked"] and not result["damaged"] for result in verify(Run(config), loop).values())
        # The largest: a file that holds data.
        file = max((path for path in (data / part).rglob("*") if path.is_file()), key=lambda path: path.stat().st_size)
        rot(file)
        results = verify(Run(config), loop)
    (told,) = results.pop(part)["damaged"]
    assert str(file.relative_to(data)) in told
    assert "move" in told
    assert not any(result["damaged"] for result in results.values())


@pytest.mark.parametrize("part", ["trajectories", "frames"])
def test_check_finds_a_deleted_file(part: str, finished: Path, tmp_path: Path) -> None:
    data = tmp_path / "data" / "tiny"
    shutil.copytree(finished, data)
    config = load(finished.parent.parent / "configs" / "tiny.yaml")
    files = sorted((data / part).rglob("*.[!p]*"))  # All but the table.
    stored = [file for file in files if file.is_file()]
    stored[0].unlink()
    with chdir(tmp_path):
        with_table = verify(Run(config), loop)[part]
        (data / part / "index.parquet").unlink()
        without_table = verify(Run(config), loop)
    (told,) = with_table["damaged"]
    assert (with_table["checked"], told.partition(":")[0]) == (len(stored), str(stored[0].relative_to(tmp_path)))
    assert "it is missing" in told
    assert [what for result in without_table.values() for what in result["damaged"]]


@pytest.mark.parametrize(
    ("path", "part", "told"),
    [
        ("finetune/finetune.yaml", "finetune", "1 files differ from the generated ones: finetune.yaml (changed)"),
        ("finetune/run_openvla_oft.py", "finetune", "run_openvla_oft.py (changed)"),
        ("card/rlds/README.md", "card", "rlds/README.md (changed)"),
        ("lerobot/tiny/data/chunk-000/episode_000007.parquet", "lerobot", "no record of an export lists it"),
        ("lerobot.json", "lerobot", "not the record that the export wrote"),
    ],
)
def test_check_finds_edits_and_additions(path: str, part: str, told: str, finished: Path, tmp_path: Path) -> None:
    data = tmp_path / "data" / "tiny"
    shutil.copytree(finished, data)
    with (data / path).open("a") as file:
        file.write("\n")
    with chdir(tmp_path):
        results = verify(Run(load(finished.parent.parent / "configs" / "tiny.yaml")), loop)
    (found,) = results.pop(part)["damaged"]
    assert told in found
    assert not any(result["damaged"] for result in results.values())


@pytest.mark.parametrize("name", ["finetune", "card"])
def test_check_finds_a_deleted_folder(name: str, finished: Path, tmp_path: Path) -> None:
    data = tmp_path / "data" / "tiny"
    shutil.copytree(finished, data)
    shutil.rmtree(data / name)
    with chdir(tmp_path):
        results = verify(Run(load(finished.parent.parent / "configs" / "tiny.yaml")), loop)
    (told,) = results.pop(name)["damaged"]
    assert "is missing or empty" in told
    assert not any(result["damaged"] for result in results.values())


def test_check_finds_a_deleted_report_of_the_checks(finished: Path, tmp_path: Path) -> None:
    data = tmp_path / "data" / "tiny"
    shutil.copytree(finished, data)
    (data / "validation.json").unlink()
    with chdir(tmp_path):
        results = verify(Run(load(finished.parent.parent / "configs" / "tiny.yaml")), loop)
    (told,) = results.pop("validation")["damaged"]
    assert "validation.json: the file is missing" in told
    assert "episodes" in results
    assert not any(result["damaged"] for result in results.values())


@pytest.mark.parametrize("name", ["plan.parquet", "manifest.parquet", "counts.json", "dataset_statistics.json"])
def test_check_finds_a_deleted_table(name: str, finished: Path, tmp_path: Path) -> None:
    data = tmp_path / "data" / "tiny"
    shutil.copytree(finished, data)
    (data / name).unlink()
    with chdir(tmp_path):
        results = verify(Run(load(finished.parent.parent / "configs" / "tiny.yaml")), loop)
    assert any(name in what for what in results["tables"]["damaged"])


def test_check_finds_a_damaged_list_of_records(finished: Path, tmp_path: Path) -> None:
    data = tmp_path / "data" / "tiny"
    shutil.copytree(finished, data)
    (data / "datasets.json").write_text("{")
    with chdir(tmp_path):
        results = verify(Run(load(finished.parent.parent / "configs" / "tiny.yaml")), loop)
    (told,) = results.pop("tables")["damaged"]
    assert "datasets.json" in told
    assert not any(result["damaged"] for result in results.values())


def test_a_changed_dataset_is_not_read_any_further(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = tmp_path / "data" / "tiny"
    monkeypatch.setattr("pipeline.validation.validate.choose_rerendered", lambda rows: [])
    shutil.copytree(finished, data)
    for name in ("rlds", "lerobot"):
        rot(max((data / name).rglob("*.json"), key=lambda path: path.stat().st_size))
    with chdir(tmp_path):
        report = validate(Run(load(finished.parent.parent / "configs" / "tiny.yaml")), loop)
    assert {finding["dataset"] for finding in report["checksums"]["findings"]} == {"rlds", "lerobot"}
    assert not any(result["findings"] for check, result in report.items() if check != "checksums")

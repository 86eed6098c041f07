"""DVC and the stages leave edits of card and recipe as they are; the configuration is the place of corrections."""

import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from card_of_run import NAME, metadata_of, write_files, written
from checkout import IN_SCRIPTS, REPOSITORY, in_a_clone

from pipeline.errors import PipelineError
from pipeline.publish_config import PublishConfig

CONFIG: dict[str, object] = {
    "name": "tiny",
    "demos": {"tasks": ["libero_goal/turn_on_the_stove"]},
    "plan": {"episodes": {"camera": 1}},
    "export": {"rlds": {"name": NAME, "shards": 1}, "lerobot": None},
}


def call(clone: Path, *command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *command],
        cwd=clone,
        env=IN_SCRIPTS | {"PYTHONPATH": str(clone)},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )


def repro(clone: Path, stage: str) -> subprocess.CompletedProcess[str]:
    return call(clone, "-m", "dvc", "repro", "--single-item", stage)


@pytest.mark.slow
def test_dvc_and_the_stage_leave_an_edit_as_it_is(tmp_path: Path) -> None:
    clone, data = tmp_path, tmp_path / "data" / "tiny"
    in_a_clone(CONFIG, clone)
    assert repro(clone, "inputs").returncode == 0
    write_files(data)
    (data / "finetune" / "finetune.yaml").unlink()
    first = repro(clone, "recipe")
    assert first.returncode == 0, first.stdout + first.stderr
    recipe = data / "finetune" / "finetune.yaml"
    edited = recipe.read_bytes() + b"# mine\n"
    recipe.write_bytes(edited)
    second = repro(clone, "recipe")
    assert second.returncode != 0
    assert "finetune.yaml (changed)" in second.stderr
    assert recipe.read_bytes() == edited
    told = call(clone, "-m", "pipeline", "status", "configs/tiny.yaml").stdout
    assert "finetune.yaml (changed)" in told
    assert "REMAKE=1" in told
    cleaned = call(clone, "-m", "pipeline", "clean", "--only", "uploads", "--yes", "configs/tiny.yaml")
    assert cleaned.returncode == 1
    assert "1 edited files would be deleted: finetune.yaml (changed)" in cleaned.stderr
    assert recipe.read_bytes() == edited


def test_a_correction_of_the_card_is_not_undone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("REMAKE", raising=False)
    write_files(tmp_path)
    generated = written(tmp_path, "rlds")
    assert metadata_of(generated)["license"] == "cc-by-4.0"
    card = tmp_path / "card" / "rlds" / "README.md"
    card.write_text(generated.replace("license: cc-by-4.0", "license: cc-by-nc-4.0"))
    with pytest.raises(PipelineError, match=r"rlds/README\.md \(changed\)"):
        written(tmp_path, "rlds")
    assert metadata_of(card.read_text())["license"] == "cc-by-nc-4.0"
    card.write_text(generated)
    for _ in range(2):
        written(tmp_path, "rlds", publish=PublishConfig(licence="CC-BY-NC-4.0", author="Jane Doe"))
        assert metadata_of(card.read_text())["license"] == "cc-by-nc-4.0"
        assert "Jane Doe" in card.read_text()


def test_the_shipped_stages_keep_what_dvc_would_delete() -> None:
    """DVC deletes an output before its stage runs, unless it is said to persist."""
    stages = yaml.safe_load((REPOSITORY / "dvc.yaml").read_text())["stages"]
    for stage in ("recipe", "card"):
        (options,) = stages[stage]["outs"][0].values()
        assert options["persist"] is True

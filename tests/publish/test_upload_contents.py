"""What would be sent is the dataset as it was written and validated, with its card, and nothing else."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from checkout import REPOSITORY, dvc
from conftest import Once
from faults import rot
from lerobot.datasets.lerobot_dataset import CODEBASE_VERSION
from synthetic import SET
from validated_run import NAME, RUN, prepare, write_card, write_run

from pipeline.errors import PipelineError
from pipeline.files import checksum, replaced
from pipeline.run.layout import REPORTS


@pytest.fixture(scope="module")
def made(once: Once) -> Path:
    return once(RUN, write_run)


@pytest.fixture
def data(made: Path, tmp_path: Path) -> Path:
    """A copy to spoil, with the times of its files."""
    return Path(shutil.copytree(made, tmp_path / RUN))


@pytest.mark.slow
def test_dry_run_says_what_would_go(made: Path) -> None:
    upload = prepare(made, "rlds")
    folder = f"rlds/{SET}/1.0.0"
    assert list(upload.files) == sorted(
        [
            *("README.md", "pictures/camera.png", "manifest.parquet", *REPORTS, "finetune/finetune.yaml"),
            *(f"{folder}/{file.name}" for file in (made / folder).iterdir()),
        ]
    )
    size = sum(file.stat().st_size for file in upload.files.values())
    summary = upload.summary()
    assert re.search(rf"6 files .* MB  {folder}/", summary)
    assert re.search(rf"{len(upload.files)} files +{size / 1e6:.1f} MB  in all", summary)
    assert "tag: none" in summary
    assert f"tag: {CODEBASE_VERSION}" in prepare(made, "lerobot").summary()


def unvalidated(data: Path) -> None:
    (data / "validation.json").unlink()


def failed(data: Path) -> None:
    (data / "validation.json").write_text(json.dumps({"gripper": {"checked": 6, "findings": ["episode-1 is turned"]}}))


def vacuous(data: Path) -> None:
    (data / "validation.json").write_text("{}")


def exported_since(data: Path) -> None:
    with replaced(data / "lerobot" / NAME / "meta" / "info.json") as file:
        file.write_bytes((data / "lerobot" / NAME / "meta" / "info.json").read_bytes())


def validated_since(data: Path) -> None:
    (data / "validation.json").write_bytes((data / "validation.json").read_bytes() + b"\n")


def without_card(data: Path) -> None:
    (data / "card" / "lerobot" / "README.md").unlink()


def foreign(data: Path) -> None:
    (data / "lerobot" / NAME / "meta" / "passwords.txt").write_text("secret")


def hidden(data: Path) -> None:
    (data / "lerobot" / NAME / ".cache").mkdir()
    (data / "lerobot" / NAME / ".cache" / "note").write_text("")


def elsewhere(data: Path) -> None:
    file = data / "lerobot" / NAME / "meta" / "stats.json"
    file.rename(data / "secret.json")
    file.symlink_to(data / "secret.json")


def folder_elsewhere(data: Path) -> None:
    (data / "lerobot" / NAME / "more").symlink_to(data / "rlds")


def key_in_card(data: Path) -> None:
    (data / "card" / "lerobot" / ".env").write_text("HF_TOKEN=secret")


def key_in_finetune(data: Path) -> None:
    (data / "finetune" / "wandb_key.json").write_text("secret")


def repository_in_card(data: Path) -> None:
    (data / "card" / "lerobot" / ".git").mkdir()
    (data / "card" / "lerobot" / ".git" / "config").write_text("secret")


def link_in_card(data: Path) -> None:
    (data.parent / "id_rsa").write_text("secret")
    (data / "card" / "lerobot" / "pictures" / "key.png").symlink_to(data.parent / "id_rsa")


def picture_elsewhere(data: Path) -> None:
    picture = data / "card" / "lerobot" / "pictures" / "camera.png"
    picture.rename(data.parent / "camera.png")
    picture.symlink_to(data.parent / "camera.png")


def folder_in_finetune(data: Path) -> None:
    (data / "finetune" / "assets").symlink_to(data.parent)


def edited_card(data: Path) -> None:
    with (data / "card" / "lerobot" / "README.md").open("a") as card:
        card.write("mine")


def edited_recipe(data: Path) -> None:
    (data / "finetune" / "finetune.yaml").write_text("mine: {}")


def report_exchanged(data: Path) -> None:
    (data / "leakage.json").write_text("{}")


def report_elsewhere(data: Path) -> None:
    (data / "leakage.json").rename(data.parent / "leakage.json")
    (data / "leakage.json").symlink_to(data.parent / "leakage.json")


def incomplete(data: Path) -> None:
    next((data / "lerobot" / NAME / "videos").rglob("*.mp4")).unlink()


def rotten(data: Path) -> None:
    rot(next((data / "lerobot" / NAME / "videos").rglob("*.mp4")))


@pytest.mark.parametrize(
    ("spoil", "complaint"),
    [
        (rotten, r"\.mp4: has changed since it was written"),
        (unvalidated, r"validation\.json: the file is missing"),
        (failed, r"1 of 1 checks failed: gripper \(episode-1 is turned\)"),
        (vacuous, "at least one check"),
        (exported_since, r"validation\.json: the report is older than .*info\.json"),
        (validated_since, r"validation\.json: the file is a link, or has changed"),
        (without_card, r"README\.md: the card is missing"),
        (foreign, r"1 foreign files and 0 links.*passwords\.txt"),
        (hidden, r"1 foreign files.*\.cache/note"),
        (elsewhere, r"1 links to files elsewhere, such as tiny/meta/stats\.json"),
        (folder_elsewhere, "such as tiny/more"),
        (key_in_card, r"card: 1 files differ from the generated ones: lerobot/\.env \(added\)"),
        (key_in_finetune, r"finetune: .*: wandb_key\.json \(added\)"),
        (repository_in_card, r"lerobot/\.git/config \(added\)"),
        (link_in_card, r"lerobot/pictures/key\.png \(a link\)"),
        (picture_elsewhere, r"lerobot/pictures/camera\.png \(a link\)"),
        (folder_in_finetune, r"finetune: .*: assets \(a link\)"),
        (edited_card, r"lerobot/README\.md \(changed\)"),
        (edited_recipe, r"finetune\.yaml \(changed\)"),
        (report_exchanged, r"leakage\.json: the file is a link, or has changed"),
        (report_elsewhere, r"leakage\.json: the file is a link, or has changed"),
        (incomplete, r"1 files are missing, such as tiny/videos/.*\.mp4"),
    ],
)
def test_an_incomplete_or_foreign_upload_is_rejected(data: Path, spoil: Callable[[Path], None], complaint: str) -> None:
    assert prepare(data, "lerobot").files
    spoil(data)
    with pytest.raises(PipelineError, match=complaint):
        prepare(data, "lerobot")


def test_a_run_that_repeats_its_checks_with_the_same_result_may_be_uploaded(data: Path) -> None:
    """A finished run that is performed again writes no new card."""
    files = prepare(data, "lerobot").files
    (data / "validation.json").touch()
    assert prepare(data, "lerobot").files == files


def test_the_card_of_an_earlier_dataset_is_rejected(data: Path) -> None:
    """As after a change of the format's options, where the stage ``card`` stopped because of another card's edits."""
    write_card(data, checksums=True)
    assert "SHA256SUMS" in prepare(data, "lerobot").others
    info, record_file = data / "lerobot" / NAME / "meta" / "info.json", data / "lerobot.json"
    info.write_bytes(info.read_bytes() + b"\n")
    record = json.loads(record_file.read_text())
    record["files"][f"{NAME}/meta/info.json"] = checksum(info)
    record_file.write_text(json.dumps(record))
    (data / "validation.json").touch()
    with pytest.raises(PipelineError, match=r"describes another dataset: 1 files differ, such as meta/info\.json"):
        prepare(data, "lerobot")
    write_card(data, checksums=True)
    assert prepare(data, "lerobot").files


@pytest.mark.parametrize(
    ("sections", "changed"),
    [
        ({"publish": {"licence": "CC-BY-NC-4.0", "author": "Jane Doe"}}, r"changed publish\.licence, publish\.author"),
        ({"export": {"where": {"axis": ["clean"]}}}, r"changed export\.where"),
        ({"finetune": {"rewrite_probability": 0.5}}, r"changed finetune\.rewrite_probability"),
        ({"render": {"jpeg_quality": 80}}, r"changed render\.jpeg_quality"),
    ],
)
def test_a_card_of_another_configuration_is_rejected(data: Path, sections: dict[str, Any], changed: str) -> None:
    with pytest.raises(
        PipelineError, match=rf"card: the card and the dataset are of another .*: {changed}\n"
    ) as caught:
        prepare(data, "lerobot", **sections)
    assert "try: python -m pipeline run CONFIG" in str(caught.value)
    assert prepare(data, "lerobot", compute={"workers": 1}).files, "the place of the computation changes nothing"


def test_a_card_without_settings_is_rejected(data: Path) -> None:
    """Earlier versions recorded none; the next run generates the card again."""
    record_file = data / "card" / ".generated.json"
    record = json.loads(record_file.read_text())
    del record["settings"]
    record_file.write_text(json.dumps(record))
    with pytest.raises(PipelineError, match="of another configuration"):
        prepare(data, "lerobot")


def test_files_next_to_the_card_of_another_format_stop_nothing(data: Path) -> None:
    (data / "card" / "rlds" / "notes.txt").write_text("mine")
    assert "notes.txt" not in prepare(data, "lerobot").files


def test_passes_by_the_statistics_that_openvla_oft_leaves_in_rlds(data: Path) -> None:
    files = prepare(data, "rlds").files
    statistics = f"{SET}/1.0.0/dataset_statistics_{'0a' * 32}.json"
    (data / "rlds" / statistics).write_text("{}")
    assert prepare(data, "rlds").files == files
    # Nor does DVC see a changed output.
    assert dvc(REPOSITORY, "check-ignore", f"data/starter/rlds/{statistics}").returncode == 0


def test_files_that_training_left_in_rlds_are_rejected(data: Path) -> None:
    (data / "rlds" / SET / "1.0.0" / "loss.csv").write_text("1,2")
    with pytest.raises(PipelineError, match=r"1 foreign files.*loss\.csv") as caught:
        prepare(data, "rlds")
    assert "move them to another folder" in str(caught.value)

"""An upload is whole or not there, sends nothing twice, and says what is wrong with the network or the token."""

import hashlib
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import Once, served
from lerobot.datasets.lerobot_dataset import CODEBASE_VERSION
from stand_in_hub import LARGE, REPOSITORY, Hub
from synthetic import SET, write_lerobot
from validated_run import NAME, prepare, write_run

from pipeline.errors import PipelineError
from pipeline.formats import lerobot_check
from pipeline.publish.push import Upload, send


@pytest.fixture(scope="module")
def made(once: Once) -> Path:
    return once("validated_run", write_run)


@pytest.fixture
def data(made: Path, tmp_path: Path) -> Path:
    """A copy to spoil, with the times of its files."""
    return Path(shutil.copytree(made, tmp_path / "data"))


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setenv("HF_TOKEN", "writer")
    # A broken transfer is tried again five times, after 23 s in all.
    monkeypatch.setattr("huggingface_hub.utils._http.time.sleep", lambda _: None)
    # The server speaks the older of the hub's two ways to send large files.
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_DISABLE_XET", True)
    hub = Hub()
    monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", hub.endpoint)
    with served(hub.server):
        yield hub


def expected(upload: Upload) -> dict[str, bytes]:
    content = {path: file.read_bytes() for path, file in upload.files.items()}
    return content | {"README.md": content["README.md"].replace(b"OWNER/NAME", REPOSITORY.encode())}


def large(upload: Upload) -> set[str]:
    return {
        hashlib.sha256(file.read_bytes()).hexdigest()
        for path, file in upload.files.items()
        if path.endswith(LARGE) or "tfrecord" in path
    }


def with_images(data: Path) -> Upload:
    """The same episodes exported anew, with images in place of videos."""
    write_lerobot(data, name=NAME, frames="images")
    for later in (data / "validation.json", data / "card" / "lerobot" / "README.md"):
        later.write_bytes(later.read_bytes())
    return prepare(data, "lerobot")


@pytest.mark.parametrize("kind", ["rlds", "lerobot", "lerobot_v21"])
def test_what_arrives_is_the_dataset_and_a_second_time_nothing(hub: Hub, made: Path, kind: str) -> None:
    upload = prepare(made, kind)
    address = send(upload, REPOSITORY, private=True)
    assert address == f"{hub.endpoint}/datasets/{REPOSITORY}/commit/1"
    assert hub.files == expected(upload)
    assert (kind == "lerobot") == ("meta/info.json" in hub.files)
    assert (kind == "lerobot_v21") == (f"lerobot_v21/{SET}/meta/info.json" in hub.files)
    assert hub.private is True
    assert hub.tags == ({CODEBASE_VERSION: 1} if kind == "lerobot" else {})
    assert set(hub.sent) == large(upload)

    hub.sent.clear()
    send(upload, "tiny")
    assert (hub.sent, hub.commits) == ([], 1)
    assert hub.files == expected(upload)
    assert set(hub.tags) == ({CODEBASE_VERSION} if kind == "lerobot" else set())


def test_the_hub_is_in_reach_after_a_dataset_was_found_damaged(hub: Hub, data: Path, tmp_path: Path) -> None:
    """lerobot looks on the hub for the files that a dataset lacks; ``validate`` keeps it off, and nothing else."""
    upload = prepare(data, "rlds")
    root = data / "lerobot" / NAME
    shutil.rmtree(root / "meta" / "episodes")
    lerobot_check.forget_sessions()  # as in a process that has not spoken with the hub
    with pytest.raises(PipelineError, match=re.escape(str(root))):
        list(lerobot_check.check(root, tmp_path / "cache", {}, {}))
    send(upload, REPOSITORY)
    assert hub.files == expected(upload)


def test_goes_on_after_the_network_broke(hub: Hub, made: Path) -> None:
    upload = prepare(made, "lerobot")
    hub.allowed, hub.cuts = 2, 1000
    with pytest.raises(PipelineError, match=r"stopped.*Error while uploading") as caught:
        send(upload, REPOSITORY)
    assert "run it again" in str(caught.value)
    assert (hub.files, hub.tags) == ({}, {})
    arrived = list(hub.sent)
    assert 0 < len(arrived) < len(large(upload))

    hub.sent.clear()
    hub.cuts = 0
    send(upload, REPOSITORY)
    assert hub.files == expected(upload)
    assert set(hub.sent) == large(upload) - set(arrived)
    assert hub.tags == {CODEBASE_VERSION: 1}


def test_a_short_break_is_not_noticed(hub: Hub, made: Path) -> None:
    hub.cuts = 2
    upload = prepare(made, "rlds")
    send(upload, REPOSITORY)
    assert hub.files == expected(upload)


def test_goes_on_after_the_hub_failed_to_commit(hub: Hub, made: Path) -> None:
    upload = prepare(made, "rlds")
    hub.failing = 1
    with pytest.raises(PipelineError, match=r"stopped.*500"):
        send(upload, REPOSITORY)
    assert hub.files == {}
    hub.sent.clear()
    send(upload, REPOSITORY)
    assert hub.files == expected(upload)
    assert hub.sent == []


def test_what_the_dataset_no_longer_has_goes(hub: Hub, made: Path) -> None:
    hub.files = {
        "data/chunk-000/file-007.parquet": b"of an earlier upload",
        ".gitattributes": b"",
        "mine/notes.md": b"",
    }
    upload = prepare(made, "lerobot")
    send(upload, REPOSITORY)
    assert hub.files == {".gitattributes": b"", "mine/notes.md": b"", **expected(upload)}


@pytest.mark.slow
def test_videos_go_with_the_commit_that_brings_images(hub: Hub, data: Path) -> None:
    """A whole folder that the dataset no longer has; other folders are somebody's own."""
    mine = {".gitattributes": b"", "mine/notes.md": b"", "demo.mp4": b""}
    hub.files |= mine
    send(prepare(data, "lerobot"), REPOSITORY)
    assert any(path.startswith("videos/") for path in hub.files)
    upload = with_images(data)
    assert {path.partition("/")[0] for path in upload.files if path.count("/") > 1} == {"data", "meta"}
    send(upload, REPOSITORY)
    assert hub.files == {**mine, **expected(upload)}
    assert hub.commits == 2


def test_asks_for_a_token(hub: Hub, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("HF_TOKEN")
    monkeypatch.setattr("huggingface_hub.constants.HF_TOKEN_PATH", str(tmp_path / "none"))
    with pytest.raises(PipelineError, match="no token") as caught:
        send(prepare(made, "rlds"), REPOSITORY)
    assert "hf auth login" in str(caught.value)
    assert hub.private is None


def test_a_token_that_may_not_write_is_told_apart(hub: Hub, made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_TOKEN", "reader")
    with pytest.raises(PipelineError, match="does not let you write"):
        send(prepare(made, "rlds"), REPOSITORY)


def test_an_unreachable_hub_and_a_wrong_name_are_told_apart(
    hub: Hub, made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    upload = prepare(made, "rlds")
    with pytest.raises(PipelineError, match="refused"):
        send(upload, "not a name")
    monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", "http://127.0.0.1:9")
    with pytest.raises(PipelineError, match="stopped"):
        send(upload, REPOSITORY)

"""An upload is whole or not there, sends nothing twice, and deletes nothing but an earlier upload of the same."""

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from checkout import REPOSITORY as CHECKOUT
from conftest import Once
from faults import served
from lerobot.datasets.lerobot_dataset import CODEBASE_VERSION
from stand_in_hub import ATTRIBUTES, REPOSITORY, Hub, is_large
from synthetic import SET, write_lerobot
from validated_run import NAME, RUN, prepare, write_card, write_run

from pipeline.config import load
from pipeline.episode_schema import STANDARD
from pipeline.errors import PipelineError
from pipeline.formats.lerobot import check
from pipeline.formats.lerobot.columns import CONVENTIONS, Layout
from pipeline.publish.push import Upload, compare, send
from pipeline.publish.repository import UPLOAD


@pytest.fixture(scope="module")
def made(once: Once) -> Path:
    return once(RUN, write_run)


@pytest.fixture
def data(made: Path, tmp_path: Path) -> Path:
    """A copy to spoil, with the times of its files."""
    return Path(shutil.copytree(made, tmp_path / RUN))


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
    template = f"{hub.endpoint}/{{repo_id}}/resolve/{{revision}}/{{filename}}"
    for module in ("constants", "file_download"):  # The second has its own only before huggingface-hub 1.
        monkeypatch.setattr(f"huggingface_hub.{module}.HUGGINGFACE_CO_URL_TEMPLATE", template, raising=False)
    with served(hub.server):
        yield hub


def expected(upload: Upload) -> dict[str, bytes]:
    content = {path: file.read_bytes() for path, file in upload.files.items()}
    card = content["README.md"].replace(b"OWNER/NAME", REPOSITORY.encode())
    return content | {"README.md": card, ".gitattributes": ATTRIBUTES}


def uploaded(hub: Hub) -> dict[str, bytes]:
    """The repository without the record of the upload, which is looked at by itself."""
    return {path: content for path, content in hub.files.items() if path != UPLOAD}


def large(upload: Upload) -> set[str]:
    return {hashlib.sha256(file.read_bytes()).hexdigest() for path, file in upload.files.items() if is_large(path)}


def with_images(data: Path) -> Upload:
    """The same episodes exported again, with images in place of videos."""
    write_lerobot(data, name=NAME, frames="images")
    (data / "validation.json").write_bytes((data / "validation.json").read_bytes())
    write_card(data)
    return prepare(data, "lerobot")


@pytest.mark.parametrize("kind", ["rlds", "lerobot", "lerobot_v21"])
def test_what_arrives_is_the_dataset_and_a_second_time_nothing(hub: Hub, made: Path, kind: str) -> None:
    upload = prepare(made, kind)
    address = send(upload, REPOSITORY, private=True)
    assert address == f"{hub.endpoint}/datasets/{REPOSITORY}/commit/1"
    assert uploaded(hub) == expected(upload)
    assert (kind == "lerobot") == ("meta/info.json" in hub.files)
    assert (kind == "lerobot_v21") == (f"lerobot_v21/{SET}/meta/info.json" in hub.files)
    assert hub.private is True
    assert hub.tags == ({CODEBASE_VERSION: 1} if kind == "lerobot" else {})
    assert set(hub.sent) == large(upload)

    hub.sent.clear()
    send(upload, "tiny")
    assert (hub.sent, hub.commits) == ([], 1)
    assert uploaded(hub) == expected(upload)
    assert set(hub.tags) == ({CODEBASE_VERSION} if kind == "lerobot" else set())


def test_the_hub_is_in_reach_after_a_dataset_was_found_damaged(hub: Hub, data: Path, tmp_path: Path) -> None:
    """lerobot looks on the hub for the files that a dataset lacks; ``validate`` keeps it off, and nothing else."""
    upload = prepare(data, "rlds")
    root = data / "lerobot" / NAME
    shutil.rmtree(root / "meta" / "episodes")
    layout = Layout(STANDARD, CONVENTIONS["libero"], "video")
    check.forget_sessions()  # as in a process that has not spoken with the hub
    with pytest.raises(PipelineError, match=re.escape(str(root))):
        list(check.check(root, tmp_path / "cache", {}, layout))
    send(upload, REPOSITORY)
    assert uploaded(hub) == expected(upload)


def test_goes_on_after_the_network_broke(hub: Hub, made: Path) -> None:
    upload = prepare(made, "lerobot")
    hub.allowed, hub.cuts = 2, 1000
    with pytest.raises(PipelineError, match=r"stopped.*Error while uploading") as caught:
        send(upload, REPOSITORY)
    assert "run the command again" in str(caught.value)
    assert (hub.files, hub.tags) == ({".gitattributes": ATTRIBUTES}, {})
    arrived = list(hub.sent)
    assert 0 < len(arrived) < len(large(upload))

    hub.sent.clear()
    hub.cuts = 0
    send(upload, REPOSITORY)
    assert uploaded(hub) == expected(upload)
    assert set(hub.sent) == large(upload) - set(arrived)
    assert hub.tags == {CODEBASE_VERSION: 1}


def test_a_short_break_is_not_noticed(hub: Hub, made: Path) -> None:
    hub.cuts = 2
    upload = prepare(made, "rlds")
    send(upload, REPOSITORY)
    assert uploaded(hub) == expected(upload)


def test_goes_on_after_the_hub_failed_to_commit(hub: Hub, made: Path) -> None:
    upload = prepare(made, "rlds")
    hub.failing = 1
    with pytest.raises(PipelineError, match=r"stopped.*500"):
        send(upload, REPOSITORY)
    assert hub.files == {".gitattributes": ATTRIBUTES}
    hub.sent.clear()
    send(upload, REPOSITORY)
    assert uploaded(hub) == expected(upload)
    assert hub.sent == []


@pytest.mark.slow
def test_videos_go_with_the_commit_that_brings_images(hub: Hub, data: Path) -> None:
    """A whole folder that the dataset no longer has; other folders are somebody's own."""
    send(prepare(data, "lerobot"), REPOSITORY)
    mine = {"mine/notes.md": b"", "demo.mp4": b""}
    hub.files |= mine
    assert any(path.startswith("videos/") for path in hub.files)
    upload = with_images(data)
    assert {path.partition("/")[0] for path in upload.files if path.count("/") > 1} == {"data", "meta"}
    send(upload, REPOSITORY)
    assert uploaded(hub) == {**mine, **expected(upload)}
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
    with pytest.raises(PipelineError, match="your token may not write to"):
        send(prepare(made, "rlds"), REPOSITORY)


def test_an_unreachable_hub_and_a_wrong_name_are_told_apart(
    hub: Hub, made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    upload = prepare(made, "rlds")
    with pytest.raises(PipelineError, match="the hub rejected the upload"):
        send(upload, "not a name")
    monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", "http://127.0.0.1:9")
    with pytest.raises(PipelineError, match="stopped"):
        send(upload, REPOSITORY)


def of_another_run(hub: Hub, made: Path) -> None:
    send(replace(prepare(made, "rlds"), run="another"), REPOSITORY)


def of_another_format(hub: Hub, made: Path) -> None:
    send(prepare(made, "lerobot"), REPOSITORY)


def of_an_unknown_tool(hub: Hub, made: Path) -> None:
    hub.files |= {"data/train-00000.parquet": b"rows", "README.md": b"theirs"}


def with_a_card_alone(hub: Hub, made: Path) -> None:
    """As the hub's form writes it when a licence is chosen."""
    hub.files["README.md"] = b"---\nlicense: mit\n---\n"


def with_a_damaged_record(hub: Hub, made: Path) -> None:
    send(prepare(made, "rlds"), REPOSITORY)
    hub.files[UPLOAD] = b"{"


OTHERS: dict[Callable[[Hub, Path], None], tuple[str, str]] = {
    of_another_run: ("the upload of run another, format rlds", "upload.json"),
    of_another_format: ("the upload of run tiny_run, format lerobot", "meta/info.json"),
    of_an_unknown_tool: ("files of unknown origin", "data/train-00000.parquet"),
    with_a_card_alone: ("files of unknown origin", "README.md"),
    with_a_damaged_record: ("files of unknown origin", "README.md"),
}


@pytest.mark.parametrize("occupy", OTHERS)
def test_another_dataset_stays_until_it_is_to_be_replaced(
    hub: Hub, made: Path, occupy: Callable[[Hub, Path], None]
) -> None:
    hub.create(b"{}")
    occupy(hub, made)
    before, commits = dict(hub.files), hub.commits
    upload = prepare(made, "rlds")
    for attempt in (compare, send):
        with pytest.raises(PipelineError) as caught:
            attempt(upload, REPOSITORY)
        assert all(words in str(caught.value) for words in (*OTHERS[occupy], "--replace", "run tiny_run, format rlds"))
    assert (hub.files, hub.commits) == (before, commits)

    told = compare(upload, REPOSITORY, replace=True).splitlines()
    gone = before.keys() - upload.files.keys() - {UPLOAD, ".gitattributes"}
    assert told == [f"{REPOSITORY} (public) has {len(before) - 1} files; the upload would delete {len(gone)}"] + [
        f"  {path}" for path in sorted(gone)
    ]
    assert hub.files == before
    send(upload, REPOSITORY, replace=True)
    assert uploaded(hub) == expected(upload)


def card_edited(hub: Hub) -> str:
    hub.files["README.md"] += b"mine"
    return "README.md"


def meta_edited(hub: Hub) -> str:
    hub.files["meta/info.json"] = b"{}"
    return "meta/info.json"


def rows_exchanged(hub: Hub) -> str:
    path = next(path for path in hub.files if path.startswith("data/"))
    hub.files[path] = b"other rows"
    return path


def rows_added(hub: Hub) -> str:
    """lerobot and the hub's viewer would read them as a part of the dataset."""
    hub.files["data/chunk-000/file-007.parquet"] = b"rows"
    return "data/chunk-000/file-007.parquet"


@pytest.mark.parametrize("edit", [card_edited, meta_edited, rows_exchanged, rows_added])
def test_edits_on_the_hub_stay_until_they_are_to_be_replaced(hub: Hub, made: Path, edit: Callable[[Hub], str]) -> None:
    upload = prepare(made, "lerobot")
    send(upload, REPOSITORY)
    mine = {"mine/notes.md": b"", "LICENSE": b"mine"}
    hub.files |= mine
    path = edit(hub)
    before = dict(hub.files)
    with pytest.raises(PipelineError, match=rf"edited on the hub since the last upload: {re.escape(path)}\n"):
        send(upload, REPOSITORY)
    assert hub.files == before
    send(upload, REPOSITORY, replace=True)
    assert uploaded(hub) == {**mine, **expected(upload)}


def test_a_file_of_the_earlier_upload_goes_and_is_named_before(hub: Hub, made: Path) -> None:
    upload = prepare(made, "lerobot")
    further = made / "lerobot" / NAME / "meta" / "info.json"
    former = {**upload.dataset, "meta/former.json": further}
    send(
        replace(upload, dataset=former, sha256={**upload.sha256, "meta/former.json": upload.sha256["meta/info.json"]}),
        REPOSITORY,
    )
    assert "meta/former.json" in hub.files
    assert compare(upload, REPOSITORY).splitlines()[1:] == ["  meta/former.json"]
    send(upload, REPOSITORY)
    assert uploaded(hub) == expected(upload)


def test_a_public_repository_is_not_taken_for_a_private_one(hub: Hub, made: Path) -> None:
    upload = prepare(made, "rlds")
    send(upload, REPOSITORY)
    commits = hub.commits
    for attempt in (compare, send):
        with pytest.raises(PipelineError, match="is public, but --private"):
            attempt(upload, REPOSITORY, private=True)
    assert (hub.private, hub.commits) == (False, commits)


def test_a_commit_of_somebody_else_meanwhile_stops_the_upload(hub: Hub, made: Path) -> None:
    upload = prepare(made, "rlds")
    send(upload, REPOSITORY)

    def commit() -> None:
        hub.files["notes.md"] = b"theirs"
        hub.commits += 1

    hub.before_commit = commit
    with pytest.raises(PipelineError, match="has changed or was created since it was read"):
        send(replace(upload, run="tiny_run", tag="v1", others={"README.md": upload.others["README.md"]}), REPOSITORY)
    assert uploaded(hub) == {**expected(upload), "notes.md": b"theirs"}


@pytest.mark.parametrize("name", ["lerobot/tiny/meta/info.json", "card/lerobot/README.md", "finetune/finetune.yaml"])
def test_a_file_that_changes_before_it_is_sent_is_not_sent(hub: Hub, data: Path, name: str) -> None:
    upload = prepare(data, "lerobot")
    (data / name).write_text("a secret")
    with pytest.raises(PipelineError, match=rf"{re.escape(name)}: the file has changed since it was checked"):
        send(upload, REPOSITORY)
    assert (hub.commits, hub.sent) == (0, [])


@pytest.mark.parametrize("name", ["lerobot/tiny/meta/info.json", "lerobot/tiny/meta/tasks.parquet"])
def test_a_file_that_changes_while_it_is_sent_is_noticed(hub: Hub, data: Path, name: str) -> None:
    upload = prepare(data, "lerobot")

    def exchange() -> None:
        (data / name).write_bytes((data / name).read_bytes()[::-1])

    hub.before_transfer = exchange
    with pytest.raises(PipelineError, match=r"their record, such as meta/info\.json|file that does not exist"):
        send(upload, REPOSITORY)


@pytest.mark.slow
def test_the_command_says_all_of_it_and_sends_it_when_asked(hub: Hub, data: Path) -> None:
    config = data.parent / "mine.yaml"
    content = {
        "name": data.name,
        "folder": str(data.parent),
        "demos": {"tasks": ["libero_goal/turn_on_the_stove"]},
        "plan": {"episodes": {"camera": 1}},
        "export": {"rlds": None, "lerobot": {"name": NAME, "shards": 3}},
    }
    config.write_text(yaml.safe_dump(content))
    write_card(data, config=load(config))
    environment = {**os.environ, "HF_ENDPOINT": hub.endpoint, "HF_HUB_DISABLE_XET": "1"}

    def push(*options: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "pipeline", "dataset", "push", "lerobot", REPOSITORY, str(config), *options]
        return subprocess.run(command, cwd=CHECKOUT, env=environment, capture_output=True, text=True, check=False)

    told = push()
    assert told.returncode == 0, told.stderr
    assert hub.files == {}
    lines = told.stdout.splitlines()
    assert lines[0] == f"run {data.name}, format lerobot"
    outside = lines[lines.index("outside the dataset:") + 1 : -3]
    assert [line.strip() for line in outside] == sorted(
        [
            *("README.md", "pictures/camera.png", "finetune/finetune.yaml", "manifest.parquet", UPLOAD),
            *("leakage.json", "validation.json", "dataset_statistics.json"),
        ]
    )
    assert f"{REPOSITORY} does not exist or is hidden" in lines[-2]
    done = push("--really", "--private")
    assert done.returncode == 0, done.stderr
    assert (hub.private, json.loads(hub.files[UPLOAD])["format"]) == (True, "lerobot")
    hub.files["README.md"] += b"mine"
    rejected = push()
    assert rejected.returncode == 1
    assert "README.md" in rejected.stderr


def test_without_a_network_the_files_are_still_named(hub: Hub, made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", "http://127.0.0.1:9")
    assert "its deleted files are unknown" in compare(prepare(made, "rlds"), REPOSITORY)

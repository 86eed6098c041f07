"""An upload is whole or not there, sends nothing twice, and sends nothing that was not validated or not asked for."""

import base64
import hashlib
import json
import os
import re
import shutil
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from conftest import REPOSITORY as REPOSITORY_FOLDER
from conftest import dvc, rot, served
from lerobot.datasets.lerobot_dataset import CODEBASE_VERSION
from synthetic import SET, write_lerobot, write_lerobot_v21, write_rlds

from pipeline.errors import PipelineError
from pipeline.export_config import ExportConfig, LeRobotConfig, LeRobotV21Config, RldsConfig
from pipeline.files import replaced
from pipeline.formats import lerobot_check
from pipeline.formats.registry import formats_of
from pipeline.publish import push
from pipeline.publish.card import REPORTS
from pipeline.publish.push import Upload, send

NAME, REPOSITORY = "tiny", "somebody/tiny"
LARGE = (".parquet", ".mp4", ".png")


def prepare(data: Path, kind: str) -> Upload:
    options = ExportConfig(
        rlds=RldsConfig(name="synthetic", shards=3),
        lerobot=LeRobotConfig(name=NAME, shards=3),
        lerobot_v21=LeRobotV21Config(name="synthetic", convention="ipec"),
    )
    return push.prepare(next(target for target in formats_of(data, options) if target.name == kind))


class Hub:
    """A server on this machine that speaks as much of the hub's protocol as an upload needs.

    Attributes:
        files: path in the repository to content, once committed.
        private: of the repository, None until it is made.
        tags: name to the number of the commit.
        commits: how many there were.
        objects: large content that arrived, by SHA-256, committed or not.
        sent: SHA-256 of every object that was sent whole.
        cuts: how many more transfers of an object break off half way.
        allowed: how many transfers go well before that.
        failing: how many more commits are answered with an error of the server.
    """

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}
        self.private: bool | None = None
        self.tags: dict[str, int] = {}
        self.commits = 0
        self.objects: dict[str, bytes] = {}
        self.sent: list[str] = []
        self.cuts, self.allowed = 0, 0
        self.failing = 0
        self.lock = threading.Lock()
        hub = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self._route("GET")

            def do_POST(self) -> None:
                self._route("POST")

            def do_PUT(self) -> None:
                self._route("PUT")

            def do_DELETE(self) -> None:
                self._route("DELETE")

            def _route(self, method: str) -> None:
                if method == "PUT":
                    self._object(self.path.rpartition("/")[2])
                    return
                if self.headers.get("Authorization") != "Bearer writer":
                    self._answer(403, {"error": "this token may not write"})
                    return
                body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
                for pattern, answer in ROUTES.items():
                    if found := re.fullmatch(pattern, f"{method} {self.path.partition('?')[0]}"):
                        self._answer(*answer(hub, body, *found.groups()))
                        return
                self._answer(404, {"error": f"{method} {self.path}"})

            def _object(self, oid: str) -> None:
                size = int(self.headers["Content-Length"])
                with hub.lock:
                    broken = hub.allowed <= 0 < hub.cuts
                    hub.allowed -= 1
                    hub.cuts -= broken
                if broken:
                    self.rfile.read(size // 2)
                    self.close_connection = True
                    return
                content = self.rfile.read(size)
                hub.objects[hashlib.sha256(content).hexdigest()] = content
                hub.sent.append(oid)
                self._answer(200, {})

            def _answer(self, status: int, body: object) -> None:
                text = json.dumps(body).encode()
                self.send_response(status)
                if status == 404:
                    self.send_header("X-Error-Code", "RevisionNotFound")
                self.send_header("Content-Type", "application/json")
                self.send_header("Content-Length", str(len(text)))
                self.end_headers()
                self.wfile.write(text)

            def log_message(self, format: str, *args: object) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.endpoint = f"http://127.0.0.1:{self.server.server_port}"

    def create(self, body: bytes) -> tuple[int, object]:
        answer = {"url": f"{self.endpoint}/datasets/{REPOSITORY}"}
        if self.private is not None:
            return 409, answer
        asked = json.loads(body)
        self.private = asked.get("private", asked.get("visibility") == "private")  # the second since huggingface-hub 1
        return 200, answer

    def tree(self, body: bytes) -> tuple[int, object]:
        return 200, [{"type": "file", "path": path, "size": len(data), "oid": ""} for path, data in self.files.items()]

    def info(self, body: bytes) -> tuple[int, object]:
        return 200, {"id": REPOSITORY, "sha": f"{self.commits:040x}", "xetEnabled": False}

    def modes(self, body: bytes) -> tuple[int, object]:
        return 200, {"files": [self._mode(file["path"]) for file in json.loads(body)["files"]]}

    def _mode(self, path: str) -> dict[str, Any]:
        large = path.endswith(LARGE) or "tfrecord" in path
        mode = {"path": path, "uploadMode": "lfs" if large else "regular", "shouldIgnore": False}
        if path in self.files:
            content = self.files[path]
            blob = hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()
            mode["oid"] = hashlib.sha256(content).hexdigest() if large else blob
        return mode

    def batch(self, body: bytes) -> tuple[int, object]:
        wanted = json.loads(body)["objects"]
        for one in wanted:
            if one["oid"] not in self.objects:
                one["actions"] = {"upload": {"href": f"{self.endpoint}/objects/{one['oid']}"}}
        return 200, {"objects": wanted}

    def commit(self, body: bytes) -> tuple[int, object]:
        if self.failing:
            self.failing -= 1
            return 500, {"error": "out of order"}
        for line in body.splitlines():
            operation = json.loads(line)
            value = operation["value"]
            if operation["key"] == "file":
                self.files[value["path"]] = base64.b64decode(value["content"])
            elif operation["key"] == "lfsFile":
                self.files[value["path"]] = self.objects[value["oid"]]
            elif operation["key"] == "deletedFile":
                del self.files[value["path"]]
        self.commits += 1
        return 200, {
            "commitUrl": f"{self.endpoint}/datasets/{REPOSITORY}/commit/{self.commits}",
            "commitOid": f"{self.commits:040x}",
        }

    def tag(self, body: bytes) -> tuple[int, object]:
        self.tags[json.loads(body)["tag"]] = self.commits
        return 200, {}

    def untag(self, body: bytes, name: str) -> tuple[int, object]:
        return (200, {}) if self.tags.pop(name, None) is not None else (404, {"error": "no such tag"})

    def validate(self, body: bytes) -> tuple[int, object]:
        return 200, {}


ROUTES: dict[str, Callable[..., tuple[int, object]]] = {
    "POST /api/repos/create": Hub.create,
    "POST /api/validate-yaml": Hub.validate,
    f"GET /api/datasets/{REPOSITORY}/tree/main": Hub.tree,
    f"GET /api/datasets/{REPOSITORY}(?:/revision/main)?": Hub.info,
    f"POST /api/datasets/{REPOSITORY}/preupload/main": Hub.modes,
    f"POST /datasets/{REPOSITORY}.git/info/lfs/objects/batch": Hub.batch,
    f"POST /api/datasets/{REPOSITORY}/commit/main": Hub.commit,
    f"POST /api/datasets/{REPOSITORY}/tag/main": Hub.tag,
    f"DELETE /api/datasets/{REPOSITORY}/tag/(.+)": Hub.untag,
}


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


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run's folder with the datasets of six episodes, in the order in which the stages write it."""
    data = tmp_path_factory.mktemp("data")
    write_rlds(data)
    write_lerobot(data, name=NAME)
    write_lerobot_v21(data)
    pq.write_table(pa.Table.from_pylist([{"kept": True}, {"kept": False}]), data / "manifest.parquet")
    (data / "finetune" / "__pycache__").mkdir(parents=True)
    (data / "finetune" / "finetune.yaml").write_text("recipe: {}\n")
    (data / "finetune" / "__pycache__" / "run.pyc").write_bytes(b"compiled")
    for name in REPORTS:
        (data / name).write_text(json.dumps({"counts": {"checked": 6, "findings": []}}))
    for kind in ("rlds", "lerobot", "lerobot_v21"):
        (data / "card" / kind / "pictures").mkdir(parents=True)
        (data / "card" / kind / "README.md").write_text(f"---\nlicense: mit\n---\n{kind}: hf download OWNER/NAME\n")
        (data / "card" / kind / "pictures" / "camera.png").write_bytes(b"picture")
    return data


@pytest.fixture
def data(made: Path, tmp_path: Path) -> Path:
    """A copy to spoil, with the times of its files."""
    for file in made.rglob("*"):
        copy = tmp_path / "data" / file.relative_to(made)
        if file.is_file():
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(file.read_bytes())
            os.utime(copy, ns=(0, file.stat().st_mtime_ns))
    return tmp_path / "data"


def expected(upload: Upload) -> dict[str, bytes]:
    content = {path: file.read_bytes() for path, file in upload.files.items()}
    return content | {"README.md": content["README.md"].replace(b"OWNER/NAME", REPOSITORY.encode())}


def large(upload: Upload) -> set[str]:
    return {
        hashlib.sha256(file.read_bytes()).hexdigest()
        for path, file in upload.files.items()
        if path.endswith(LARGE) or "tfrecord" in path
    }


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


def with_images(data: Path) -> Upload:
    """The same episodes exported anew, with images in place of videos."""
    write_lerobot(data, name=NAME, frames="images")
    for later in (data / "validation.json", data / "card" / "lerobot" / "README.md"):
        later.write_bytes(later.read_bytes())
    return prepare(data, "lerobot")


@pytest.mark.slow
def test_a_set_with_images_has_no_videos(data: Path) -> None:
    folders = {path.partition("/")[0] for path in with_images(data).files if path.count("/") > 1}
    assert folders == {"data", "meta"}


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
    send(upload, REPOSITORY)
    assert hub.files == {**mine, **expected(upload)}
    assert hub.commits == 2


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
    (data / "validation.json").write_bytes((data / "validation.json").read_bytes())


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


def incomplete(data: Path) -> None:
    next((data / "lerobot" / NAME / "videos").rglob("*.mp4")).unlink()


def rotten(data: Path) -> None:
    rot(next((data / "lerobot" / NAME / "videos").rglob("*.mp4")))


@pytest.mark.parametrize(
    ("spoil", "complaint"),
    [
        (rotten, r"\.mp4: was changed since it was written"),
        (unvalidated, r"validation\.json: not there"),
        (failed, r"1 of 1 checks failed: gripper \(episode-1 is turned\)"),
        (vacuous, "at least one check"),
        (exported_since, r"validation\.json: older than .*info\.json"),
        (validated_since, r"README\.md: older than .*validation\.json"),
        (without_card, r"README\.md: not there"),
        (foreign, r"1 files that are not of the dataset.*passwords\.txt"),
        (hidden, r"not of the dataset.*\.cache/note"),
        (elsewhere, r"1 that lie elsewhere, such as tiny/meta/stats\.json"),
        (folder_elsewhere, "such as tiny/more"),
        (incomplete, r"lacks 1 files, such as tiny/videos/.*\.mp4"),
    ],
)
def test_refuses(data: Path, spoil: Callable[[Path], None], complaint: str) -> None:
    assert prepare(data, "lerobot").files
    spoil(data)
    with pytest.raises(PipelineError, match=complaint):
        prepare(data, "lerobot")


def test_passes_by_the_statistics_that_openvla_oft_leaves_in_rlds(data: Path) -> None:
    files = prepare(data, "rlds").files
    statistics = f"{SET}/1.0.0/dataset_statistics_{'0a' * 32}.json"
    (data / "rlds" / statistics).write_text("{}")
    assert prepare(data, "rlds").files == files
    # Nor does DVC see a changed output.
    assert dvc(REPOSITORY_FOLDER, "check-ignore", f"data/starter/rlds/{statistics}").returncode == 0


def test_refuses_what_else_training_left_in_rlds(data: Path) -> None:
    (data / "rlds" / SET / "1.0.0" / "loss.csv").write_text("1,2")
    with pytest.raises(PipelineError, match=r"not of the dataset.*loss\.csv") as caught:
        prepare(data, "rlds")
    assert "move them away" in str(caught.value)


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

"""Downloads are whole or named, resume where they stopped, and stay inside their folder."""

import errno
import hashlib
import json
import re
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.metadata import version
from pathlib import Path

import h5py
import numpy as np
import pytest
from faults import served

from pipeline.errors import PipelineError
from pipeline.libero import fetch as fetching
from pipeline.libero.fetch import REPOSITORY, REVISION, fetch
from pipeline.libero.tasks import tasks

LATER = "0123456789abcdef0123456789abcdef01234567"
"""What the repository has come to since."""


class Hub:
    """A server on this machine that speaks as much of the hub's protocol as a download needs.

    Attributes:
        files: path in the repository to content.
        breaks: paths whose transfer ends half way, however often it is tried.
        flips: paths whose first byte arrives with another bit.
        sent: path, first byte and number of bytes of every transfer.
    """

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {"README.md": b"not asked for"}
        self.breaks: set[str] = set()
        self.flips: set[str] = set()
        self.sent: list[tuple[str, int, int]] = []
        hub = self

        class Handler(BaseHTTPRequestHandler):
            def do_HEAD(self) -> None:
                self._answer(body=False)

            def do_GET(self) -> None:
                self._answer(body=True)

            def _answer(self, body: bool) -> None:
                commit = REVISION if REVISION in self.path else LATER
                if "/tree/" in self.path:  # since huggingface-hub 1
                    tree = [
                        {"type": "file", "path": name, "size": len(data), "oid": ""} for name, data in hub.files.items()
                    ]
                    self._send(json.dumps(tree).encode(), body)
                    return
                if self.path.startswith(f"/api/datasets/{REPOSITORY}"):
                    siblings = [_sibling(name, data) for name, data in hub.files.items()]
                    self._send(json.dumps({"id": REPOSITORY, "sha": commit, "siblings": siblings}).encode(), body)
                    return
                # The later commit has none of the files.
                name = self.path.removeprefix(f"/datasets/{REPOSITORY}/resolve/{REVISION}/")
                content = hub.files.get(name)
                if content is None:
                    self.send_error(404)
                    return
                span = re.fullmatch(r"bytes=(\d+)-", self.headers.get("Range", ""))
                first = int(span[1]) if span else 0
                part = content[first:]
                if name in hub.flips and not first:
                    part = bytes([part[0] ^ 1]) + part[1:]
                if body and name in hub.breaks:
                    part = part[: len(content) // 2 - first]
                if body:
                    hub.sent.append((name, first, len(part)))
                self._send(part, body, length=len(content) - first, of=content, first=first)

            def _send(
                self, part: bytes, body: bool, length: int | None = None, of: bytes = b"", first: int = 0
            ) -> None:
                self.send_response(206 if first else 200)
                self.send_header("Content-Length", str(len(part) if length is None else length))
                self.send_header("X-Repo-Commit", REVISION if REVISION in self.path else LATER)
                self.send_header("ETag", f'"{hashlib.sha256(of).hexdigest()}"')
                self.send_header("Accept-Ranges", "bytes")
                if first:
                    self.send_header("Content-Range", f"bytes {first}-{len(of) - 1}/{len(of)}")
                self.end_headers()
                if body:
                    self.wfile.write(part)

            def log_message(self, format: str, *args: object) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.endpoint = f"http://127.0.0.1:{self.server.server_port}"


def _sibling(name: str, data: bytes) -> dict[str, object]:
    """A file as the hub lists it."""
    sha256 = hashlib.sha256(data).hexdigest()
    return {
        "rfilename": name,
        "size": len(data),
        "blobId": "0" * 40,
        "lfs": {"sha256": sha256, "size": len(data), "pointerSize": 134},
    }


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    # The folders that the hub's library writes to unless told otherwise.
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "home"))
    hub = Hub()
    rng = np.random.default_rng(0)
    for suite in ("libero_goal", "libero_object"):
        for task in tasks(suite):
            hub.files[f"{suite}/{task.name}_demo.hdf5"] = rng.bytes(50_000)
    with served(hub.server):
        yield hub


def test_fetches_the_suites_asked_for(hub: Hub, tmp_path: Path) -> None:
    out = tmp_path / "demos"
    paths = fetch(out, ["libero_goal"], hub.endpoint)
    assert [path.relative_to(out).as_posix() for path in paths] == [
        f"libero_goal/{task.name}_demo.hdf5" for task in tasks("libero_goal")
    ]
    for path in paths:
        assert path.read_bytes() == hub.files[path.relative_to(out).as_posix()]
    assert sorted(entry.name for entry in out.iterdir()) == [".cache", "libero_goal"]
    assert not (tmp_path / "home").exists()

    hub.sent.clear()
    assert fetch(out, ["libero_goal"], hub.endpoint) == paths
    assert hub.sent == []


NAME = "libero_goal/turn_on_the_stove_demo.hdf5"


@pytest.mark.parametrize("kind", ["recording", "expansion", "as long as the hub's", "folder", "link to nothing"])
def test_a_file_that_is_not_the_hubs_is_named_and_stays(kind: str, hub: Hub, tmp_path: Path) -> None:
    file = tmp_path / NAME
    file.parent.mkdir()
    if kind == "folder":
        file.mkdir()
    elif kind == "link to nothing":
        file.symlink_to(tmp_path / "unmounted" / "mine.hdf5")
    elif kind == "as long as the hub's":
        file.write_bytes(bytes(len(hub.files[NAME])))
    else:
        with h5py.File(file, "w") as content:
            demo = content.create_group("data/demo_0")
            if kind == "expansion":
                demo.attrs["expanded_from"] = "libero_goal/turn_on_the_stove/demo_0"
    before = file.read_bytes() if file.is_file() else file.lstat()
    with pytest.raises(PipelineError, match=rf"1 files are not the hub's.*{NAME}"):
        fetch(tmp_path, ["libero_goal"], hub.endpoint)
    assert (file.read_bytes() if file.is_file() else file.lstat()) == before
    assert hub.sent == []
    assert sorted(entry.name for entry in file.parent.iterdir()) == [file.name]


def test_a_copy_of_the_hubs_file_from_elsewhere_is_not_downloaded_again(hub: Hub, tmp_path: Path) -> None:
    file = tmp_path / NAME
    file.parent.mkdir()
    file.write_bytes(hub.files[NAME])
    fetch(tmp_path, ["libero_goal"], hub.endpoint)
    assert sorted(name for name, _, _ in hub.sent) == sorted(
        f"libero_goal/{task.name}_demo.hdf5" for task in tasks("libero_goal") if task.name != "turn_on_the_stove"
    )


def test_goes_on_where_it_stopped(hub: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # What was received is put on disk chunk by chunk, and a chunk has 10 MB.
    monkeypatch.setattr("huggingface_hub.constants.DOWNLOAD_CHUNK_SIZE", 5_000)
    # Since huggingface-hub 1 it tries five times more.
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    out, name = tmp_path / "demos", "libero_goal/turn_on_the_stove_demo.hdf5"
    hub.breaks = {name}
    with pytest.raises(PipelineError, match="stopped") as caught:
        fetch(out, ["libero_goal"], hub.endpoint)
    assert "starter" in str(caught.value)
    assert not (out / name).exists()

    hub.breaks.clear()
    hub.sent.clear()
    fetch(out, ["libero_goal"], hub.endpoint)
    assert (out / name).read_bytes() == hub.files[name]
    # Since huggingface-hub 1 the file that it stopped in comes again.
    first = 25_000 if version("huggingface-hub") < "1" else 0
    assert [sent for sent in hub.sent if sent[0] == name] == [(name, first, 50_000 - first)]


def test_a_file_that_arrives_damaged_is_named_and_comes_again(hub: Hub, tmp_path: Path) -> None:
    hub.flips = {NAME}
    with pytest.raises(PipelineError, match=rf"1 of 10 files .* arrived damaged, such as {NAME}"):
        fetch(tmp_path, ["libero_goal"], hub.endpoint)
    assert not (tmp_path / NAME).exists()
    hub.flips.clear()
    fetch(tmp_path, ["libero_goal"], hub.endpoint)
    assert (tmp_path / NAME).read_bytes() == hub.files[NAME]


def test_a_file_that_the_hub_lacks_is_named(hub: Hub, tmp_path: Path) -> None:
    del hub.files["libero_goal/turn_on_the_stove_demo.hdf5"]
    with pytest.raises(PipelineError, match=r"1 of 10 files .*turn_on_the_stove"):
        fetch(tmp_path / "demos", ["libero_goal"], hub.endpoint)


@pytest.mark.parametrize("folder_in_use", [False, True])
def test_an_unreachable_hub_names_the_starter_set(tmp_path: Path, folder_in_use: bool) -> None:
    if folder_in_use:
        (tmp_path / "libero_goal").mkdir()
        for task in tasks("libero_goal"):
            (tmp_path / "libero_goal" / f"{task.name}_demo.hdf5").write_bytes(b"another's")
    with pytest.raises(PipelineError, match="starter set") as caught:
        fetch(tmp_path, ["libero_goal"], "http://127.0.0.1:9")
    assert REPOSITORY in str(caught.value)


def test_errors_of_the_transfer_and_of_the_disk_have_their_own_remedies(
    hub: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """hf_xet raises a ``RuntimeError``. A full disk is no fault of the network."""

    def fail(error: Exception) -> Callable[..., str]:
        def download(*arguments: object, **options: object) -> str:
            raise error

        return download

    monkeypatch.setattr(fetching, "snapshot_download", fail(RuntimeError("CAS service error")))
    with pytest.raises(PipelineError, match=r"stopped \(CAS service error\)\n  try: check the network"):
        fetch(tmp_path / "demos", ["libero_goal"], hub.endpoint)
    monkeypatch.setattr(fetching, "snapshot_download", fail(OSError(errno.ENOSPC, "No space left on device")))
    with pytest.raises(OSError, match="No space left"):
        fetch(tmp_path / "demos", ["libero_goal"], hub.endpoint)


def test_an_unknown_suite_is_rejected_before_any_request(hub: Hub, tmp_path: Path) -> None:
    with pytest.raises(PipelineError, match="unknown suite 'libero_kitchen'"):
        fetch(tmp_path, ["libero_goal", "libero_kitchen"], hub.endpoint)
    assert hub.sent == []

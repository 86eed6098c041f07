"""Local server with the part of the hub's protocol that an upload needs."""

import base64
import hashlib
import json
import re
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import PurePosixPath
from typing import Any

REPOSITORY = "somebody/tiny"
ATTRIBUTES = b"*.parquet filter=lfs diff=lfs merge=lfs -text\n"
"""Content of the file .gitattributes in a new repository of the hub."""
LARGE = (".parquet", ".mp4", ".png")


class Hub:
    """State and behaviour of the server.

    Attributes:
        files: path in the repository to committed content.
        private: visibility of the repository, ``None`` before its creation.
        tags: name to the number of the commit.
        commits: number of commits.
        objects: received large content, by SHA-256, committed or not.
        sent: SHA-256 of every completely sent object.
        cuts: number of further transfers of an object that break off half way.
        allowed: number of successful transfers before these.
        before_transfer: called before the answer about the transfer of files; simulates a simultaneous local event.
        before_commit: called before a commit is checked; simulates a simultaneous commit by another client.
        failing: number of further commits that are answered with a server error.
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
        self.before_transfer: Callable[[], None] = lambda: None
        self.before_commit: Callable[[], None] = lambda: None
        self.lock = threading.Lock()
        hub = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self._route("GET")

            def do_HEAD(self) -> None:
                self._route("HEAD")

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
                token = self.headers.get("Authorization")
                if method not in ("GET", "HEAD") and token != "Bearer writer":
                    self._answer(403, {"error": "this token may not write"})
                    return
                of_repository = f"/{REPOSITORY}" in self.path
                if of_repository and (hub.private is None or (hub.private and token is None)):
                    self._answer(404 if token else 401, {"error": "Repository not found"}, "RepoNotFound")
                    return
                body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
                request = f"{method} {self.path.partition('?')[0]}"
                for pattern, answer in ROUTES.items():
                    route_match = re.fullmatch(pattern, request)
                    if route_match:
                        status, content = answer(hub, body, *route_match.groups())
                        self._answer(status, content)
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

            def _answer(self, status: int, body: object, code: str = "RevisionNotFound") -> None:
                text = body if isinstance(body, bytes) else json.dumps(body).encode()
                self.send_response(status)
                if status in (401, 404):
                    self.send_header("X-Error-Code", code)
                self.send_header("Content-Type", "application/json")
                self.send_header("Content-Length", str(len(text)))
                self.send_header("X-Repo-Commit", hub.head())
                self.send_header("ETag", f'"{hashlib.sha1(text).hexdigest()}"')
                self.end_headers()
                if self.command != "HEAD":
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
        self.files[".gitattributes"] = ATTRIBUTES
        return 200, answer

    def head(self) -> str:
        """Return the id of the last commit."""
        return f"{self.commits:040x}"

    def whoami(self, body: bytes) -> tuple[int, object]:
        return 200, {"type": "user", "name": REPOSITORY.partition("/")[0]}

    def tree(self, body: bytes, revision: str) -> tuple[int, object]:
        if revision not in ("main", self.head()):
            return 404, {"error": "no such revision"}
        folders: set[str] = set()
        for path in self.files:
            folders |= {str(parent) for parent in PurePosixPath(path).parents}
        folders -= {"."}
        listed = [{"type": "directory", "path": folder, "size": 0, "oid": "0" * 40} for folder in sorted(folders)]
        return 200, listed + [self._entry(path, content) for path, content in self.files.items()]

    def _entry(self, path: str, content: bytes) -> dict[str, Any]:
        entry = {"type": "file", "path": path, "size": len(content), "oid": git_oid(content)}
        if is_large(path):
            oid = hashlib.sha256(content).hexdigest()
            pointer = f"version https://git-lfs.github.com/spec/v1\noid sha256:{oid}\nsize {len(content)}\n".encode()
            entry |= {"oid": git_oid(pointer), "lfs": {"oid": oid, "size": len(content), "pointerSize": len(pointer)}}
        return entry

    def resolve(self, body: bytes, revision: str, path: str) -> tuple[int, object]:
        if revision not in ("main", self.head()) or path not in self.files:
            return 404, {"error": "no such file"}
        return 200, self.files[path]

    def info(self, body: bytes) -> tuple[int, object]:
        return 200, {"id": REPOSITORY, "sha": self.head(), "private": self.private, "xetEnabled": False}

    def modes(self, body: bytes) -> tuple[int, object]:
        self.before_transfer()
        return 200, {"files": [self._mode(file["path"]) for file in json.loads(body)["files"]]}

    def _mode(self, path: str) -> dict[str, Any]:
        large = is_large(path)
        mode = {"path": path, "uploadMode": "lfs" if large else "regular", "shouldIgnore": False}
        if path in self.files:
            content = self.files[path]
            mode["oid"] = hashlib.sha256(content).hexdigest() if large else git_oid(content)
        return mode

    def batch(self, body: bytes) -> tuple[int, object]:
        wanted = json.loads(body)["objects"]
        for entry in wanted:
            if entry["oid"] not in self.objects:
                entry["actions"] = {"upload": {"href": f"{self.endpoint}/objects/{entry['oid']}"}}
        return 200, {"objects": wanted}

    def commit(self, body: bytes) -> tuple[int, object]:
        if self.failing:
            self.failing -= 1
            return 500, {"error": "out of order"}
        self.before_commit()
        operations = [json.loads(line) for line in body.splitlines()]
        if operations[0]["value"].get("parentCommit", self.head()) != self.head():
            return 412, {"error": "A commit has happened since. Please refresh and try again."}
        pointers = [operation["value"]["oid"] for operation in operations if operation["key"] == "lfsFile"]
        if any(oid not in self.objects for oid in pointers):
            return 400, {"error": "LFS pointer pointed to a file that does not exist"}
        for operation in operations:
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
            "commitOid": self.head(),
        }

    def tag(self, body: bytes, commit: str) -> tuple[int, object]:
        self.tags[json.loads(body)["tag"]] = int(commit, 16)
        return 200, {}

    def untag(self, body: bytes, name: str) -> tuple[int, object]:
        return (200, {}) if self.tags.pop(name, None) is not None else (404, {"error": "no such tag"})

    def validate(self, body: bytes) -> tuple[int, object]:
        return 200, {}


def is_large(path: str) -> bool:
    """Check if the hub stores the file outside of git."""
    return path.endswith(LARGE) or "tfrecord" in path


def git_oid(content: bytes) -> str:
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()


ROUTES: dict[str, Callable[..., tuple[int, object]]] = {
    "POST /api/repos/create": Hub.create,
    "POST /api/validate-yaml": Hub.validate,
    "GET /api/whoami-v2": Hub.whoami,
    f"GET /api/datasets/{REPOSITORY}/tree/([^/]+)": Hub.tree,
    f"(?:GET|HEAD) /datasets/{REPOSITORY}/resolve/([^/]+)/(.+)": Hub.resolve,
    f"GET /api/datasets/{REPOSITORY}(?:/revision/main)?": Hub.info,
    f"POST /api/datasets/{REPOSITORY}/preupload/main": Hub.modes,
    f"POST /datasets/{REPOSITORY}.git/info/lfs/objects/batch": Hub.batch,
    f"POST /api/datasets/{REPOSITORY}/commit/main": Hub.commit,
    f"POST /api/datasets/{REPOSITORY}/tag/([0-9a-f]{{40}})": Hub.tag,
    f"DELETE /api/datasets/{REPOSITORY}/tag/(.+)": Hub.untag,
}

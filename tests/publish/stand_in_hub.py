"""A server on this machine that speaks as much of the hub's protocol as an upload needs."""

import base64
import hashlib
import json
import re
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

REPOSITORY = "somebody/tiny"
LARGE = (".parquet", ".mp4", ".png")


class Hub:
    """What the server has and does.

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

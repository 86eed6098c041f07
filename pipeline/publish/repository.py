"""A repository on the hub: its files, its last upload, and the files that another upload would delete or overwrite."""

import hashlib
from collections.abc import Mapping, Set
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from huggingface_hub import HfApi
from huggingface_hub.errors import RepositoryNotFoundError
from huggingface_hub.hf_api import RepoFile
from pydantic import ValidationError

from pipeline.errors import PipelineError
from pipeline.types import Frozen

UPLOAD = "upload.json"
"""File of a repository that records the last upload."""

OF_THE_HUB = ".gitattributes"
"""File that the hub writes when a repository is created; uploads keep it."""

MAX_NAMED = 20
BLOCK_BYTES = 2**20


class Checksums(Frozen):
    """Two checksums of a file: the hub states ``sha256`` for large files and ``blob`` for small files.

    Attributes:
        sha256: SHA-256 of the content.
        blob: SHA-1 by which git names the content, as ``git hash-object`` prints it.
    """

    sha256: str
    blob: str

    def is_of(self, file: RepoFile) -> bool:
        """Return whether a file on the hub has this content."""
        return file.lfs.sha256 == self.sha256 if file.lfs else file.blob_id == self.blob


class LastUpload(Frozen):
    """The content of ``upload.json``.

    Attributes:
        run: name of the run.
        format: name of the dataset's format.
        files: path in the repository to content, of all other uploaded files.
    """

    run: str
    format: str
    files: dict[str, Checksums]


@dataclass(frozen=True)
class Repository:
    """The current state of a dataset repository.

    Attributes:
        name: ``owner/name``.
        commit: the last one.
        private: True if only its owner may see it.
        files: path to the hub's description of the file, without ``OF_THE_HUB``.
        upload: the last upload; `None` without an upload, or if its record cannot be read.
    """

    name: str
    commit: str
    private: bool
    files: Mapping[str, RepoFile]
    upload: LastUpload | None


def compute_checksums(file: Path | bytes) -> Checksums:
    """Compute the checksums of a file, or of its content.

    Raises:
        OSError: if the file cannot be read.
    """
    size = len(file) if isinstance(file, bytes) else file.stat().st_size
    sha256, blob = hashlib.sha256(), hashlib.sha1(b"blob %d\0" % size, usedforsecurity=False)
    if isinstance(file, bytes):
        sha256.update(file)
        blob.update(file)
    else:
        with file.open("rb") as content:
            while block := content.read(BLOCK_BYTES):
                sha256.update(block)
                blob.update(block)
    return Checksums(sha256=sha256.hexdigest(), blob=blob.hexdigest())


def read(api: HfApi, name: str) -> Repository | None:
    """Read the state of a dataset repository; return `None` if it does not exist, or the token may not see it.

    Raises:
        HfHubHTTPError: and other errors of the network.
    """
    try:
        info = api.repo_info(name, repo_type="dataset")
    except RepositoryNotFoundError:
        return None
    commit = str(info.sha)
    files = files_of(api, name, commit)
    upload = _last_upload(api, name, commit) if UPLOAD in files else None
    return Repository(name, commit, bool(info.private), files, upload)


def files_of(api: HfApi, name: str, commit: str) -> dict[str, RepoFile]:
    """List the files of a commit, without ``OF_THE_HUB``.

    Raises:
        HfHubHTTPError: and other errors of the network.
    """
    entries = api.list_repo_tree(name, recursive=True, repo_type="dataset", revision=commit)
    return {entry.path: entry for entry in entries if isinstance(entry, RepoFile) and entry.path != OF_THE_HUB}


def _last_upload(api: HfApi, name: str, commit: str) -> LastUpload | None:
    with TemporaryDirectory() as folder:
        file = api.hf_hub_download(name, UPLOAD, repo_type="dataset", revision=commit, cache_dir=folder)
        try:
            return LastUpload.model_validate_json(Path(file).read_bytes())
        except ValidationError:
            return None


def deletions(there: Repository, new: LastUpload, folders: Set[str], *, replace: bool) -> list[str]:
    """List the paths that an upload deletes.

    Files next to an earlier upload of the same run and format stay, unless they are in folders of the dataset.

    Args:
        there: the repository.
        new: the upload.
        folders: top folders of the repository that may contain only the dataset.
        replace: accept uploads that are rejected otherwise; a dataset of another origin is then deleted completely.

    Raises:
        PipelineError: if the repository has files that are not of an earlier upload of the same run and format, and
            that would be deleted, overwritten or mixed with the dataset.
    """
    mine = {*new.files, UPLOAD}
    old = there.upload
    if old is None or (old.run, old.format) != (new.run, new.format):
        origin = "files of unknown origin" if old is None else f"the upload of run {old.run}, format {old.format}"
        if there.files and not replace:
            _reject(there, f"the repository has {origin}", list(there.files), new)
        return sorted(there.files.keys() - mine)

    foreign: list[str] = []
    for path, file in there.files.items():
        same = path in new.files and new.files[path].is_of(file)
        uploaded = path in old.files and old.files[path].is_of(file)
        in_the_way = path in old.files or path in mine or path.partition("/")[0] in folders
        if in_the_way and not same and not uploaded and path != UPLOAD:
            foreign.append(path)
    if foreign and not replace:
        _reject(there, "the repository was edited on the hub since the last upload", foreign, new)
    return sorted((there.files.keys() & old.files.keys() | {*foreign}) - mine)


def _reject(there: Repository, what: str, paths: list[str], new: LastUpload) -> None:
    paths = sorted(paths)
    further = f" and {len(paths) - MAX_NAMED} more" if len(paths) > MAX_NAMED else ""
    raise PipelineError(
        f"{what}: {', '.join(paths[:MAX_NAMED])}{further}",
        where=there.name,
        expected=f"an empty repository, or an earlier upload of run {new.run}, format {new.format}",
        remedy="use another repository, or --replace, which overwrites or deletes these files (the hub keeps earlier "
        "commits); put edits of the card into `publish:` of the configuration first",
    )

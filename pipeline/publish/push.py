"""Upload a dataset to the Hugging Face hub: its files, its card, and what it was made and checked with.

Everything goes into one commit, so that a reader finds all of a dataset or none of it. Large files are sent before that
and stay there if the upload is cut off: run again, only the rest is sent. (``upload_large_folder`` of huggingface_hub
leaves notes among the files, shows half a dataset meanwhile, and tries for ever where a token may not write.)
"""

import re
from collections.abc import Mapping, Set
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import httpx
from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi, errors, get_token
from huggingface_hub.errors import HfHubHTTPError, RevisionNotFoundError

from pipeline.errors import MAKE_AGAIN, PipelineError
from pipeline.files import read_json
from pipeline.formats.base import Format
from pipeline.grouping import grouped
from pipeline.publish.card import REPORTS, REPOSITORY

SCRIPTS = {".py", ".yaml", ".json"}
"""What of ``finetune/`` is uploaded; trying it leaves compiled Python there."""

OFT_STATISTICS = re.compile(r"dataset_statistics_[0-9a-f]{64}\.json")
"""What OpenVLA-OFT's loader writes beside the shards when it trains without ``finetune/run_openvla_oft.py``."""

FAILURES = (OSError, RuntimeError, ValueError, httpx.HTTPError, getattr(errors, "XetError", OSError))
"""What an upload raises. Only before huggingface-hub 1 there is a ``XetError``; only since then it speaks by httpx."""


@dataclass(frozen=True)
class Upload:
    """What would be sent.

    Attributes:
        files: path in the repository to file here.
        folders: top folders of the repository in which nothing else may lie.
        tag: what the commit is tagged, where a client's loader wants that.
    """

    files: Mapping[str, Path]
    folders: Set[str]
    tag: str | None

    def summary(self) -> str:
        """Files and megabytes of each folder, the total, and the tag."""
        folders = grouped((f"{Path(path).parent}/", file.stat().st_size) for path, file in self.files.items())
        folders["in all"] = [size for sizes in folders.values() for size in sizes]
        lines = [f"{len(sizes):6,} files {sum(sizes) / 1e6:10,.1f} MB  {name}" for name, sizes in folders.items()]
        return "\n".join([*lines, f"tag: {self.tag or 'none'}"])


def prepare(target: Format[Any]) -> Upload:
    """Gather what belongs to a dataset; nothing is sent.

    Raises:
        PipelineError: when files are missing, foreign, not validated, or failed validation.
    """
    data = target.data
    dataset = _exactly(target.folder, set(target.record().files))
    files = {target.repository_path(path): file for path, file in dataset.items()}
    _refuse_unvalidated(data, files, target.name)
    for fault in (fault for file in target.written() for fault in file.faults()):
        raise PipelineError(fault.what, expected=fault.expected)
    card = data / "card" / target.name
    files |= {file.relative_to(card).as_posix(): file for file in card.rglob("*") if file.is_file()}
    files |= {name: data / name for name in ("manifest.parquet", *REPORTS)}
    scripts = (file for file in (data / "finetune").rglob("*") if file.suffix in SCRIPTS)
    files |= {file.relative_to(data).as_posix(): file for file in scripts}
    # Its own folders too where it has nothing in them now, such as videos.
    folders = target.repository_folders() | {path.partition("/")[0] for path in files if "/" in path}
    return Upload(dict(sorted(files.items())), folders, target.tag())


def send(upload: Upload, repository: str, *, private: bool = False) -> str:
    """Create the repository on the hub (of HF_ENDPOINT) if need be, send what it does not have, and tag it.

    Files of an earlier upload that the dataset no longer has are deleted by the same commit.

    Args:
        repository: ``owner/name``, or ``name`` for one of your own.
        private: whether a new repository is private; one that exists stays as it is.

    Returns:
        The address of the commit.

    Raises:
        PipelineError: without a token, without the right to write, or when the network or the hub fails.
    """
    api = HfApi()
    try:
        if get_token() is None:
            raise PipelineError(
                f"no token for {api.endpoint}", remedy="hf auth login, or HF_TOKEN=..., with a token that may write"
            )
        # With the owner in front, where it was left out.
        repository = api.create_repo(repository, repo_type="dataset", private=private, exist_ok=True).repo_id
        there = api.list_repo_files(repository, repo_type="dataset")
        stale = [path for path in there if path.partition("/")[0] in upload.folders and path not in upload.files]
        # In the card, with the repository's name in the commands that load it.
        card = upload.files["README.md"].read_text().replace(REPOSITORY, repository).encode()
        contents: dict[str, Path | bytes] = {**upload.files, "README.md": card}
        operations: list[CommitOperationAdd | CommitOperationDelete] = [
            *(CommitOperationAdd(path, content) for path, content in contents.items()),
            *(CommitOperationDelete(path, is_folder=False) for path in stale),
        ]
        commit = api.create_commit(
            repository, operations, repo_type="dataset", commit_message=f"Upload {len(upload.files)} files"
        )
        if upload.tag is not None:  # moved, where it stands on an earlier upload
            with suppress(RevisionNotFoundError):
                api.delete_tag(repository, tag=upload.tag, repo_type="dataset")
            api.create_tag(repository, tag=upload.tag, repo_type="dataset")
    except FAILURES as error:
        raise _explained(error, repository, api.endpoint) from error
    return commit.commit_url


def _exactly(root: Path, wanted: set[str]) -> dict[str, Path]:
    """The wanted files under ``root``, when there is nothing else but OFT's statistics, and nothing leads elsewhere."""
    found = {
        file.relative_to(root).as_posix(): file
        for file in root.rglob("*")
        if (file.is_symlink() or file.is_file()) and not OFT_STATISTICS.fullmatch(file.name)
    }
    linked = sorted(path for path, file in found.items() if root.resolve() not in file.resolve().parents)
    foreign = sorted(found.keys() - wanted)
    if foreign or linked:
        raise PipelineError(
            f"{len(foreign)} files that are not of the dataset, {len(linked)} that lie elsewhere, such as "
            f"{(foreign + linked)[0]}",
            where=root,
            remedy=f"move them away (training may leave files), or delete the dataset and `{MAKE_AGAIN}`",
        )
    if missing := sorted(wanted - found.keys()):
        raise PipelineError(f"lacks {len(missing)} files, such as {missing[0]}", where=root, remedy=MAKE_AGAIN)
    return found


def _refuse_unvalidated(data: Path, files: Mapping[str, Path], name: str) -> None:
    """Stop unless these very files passed validation, and the card tells of it."""
    report, card = data / "validation.json", data / "card" / name / "README.md"
    checks = read_json(report)
    failed = [f"{check} ({found['findings'][0]})" for check, found in checks.items() if found["findings"]]
    if failed or not checks:
        raise PipelineError(
            f"{len(failed)} of {len(checks)} checks failed: {'; '.join(failed)}",
            where=report,
            expected="at least one check, and no findings",
            remedy=f"mend what it finds, and `{MAKE_AGAIN}`",
        )
    if not card.is_file():
        raise PipelineError("not there", where=card, remedy=MAKE_AGAIN)
    newest = max(*files.values(), data / "manifest.parquet", key=_written)
    for before, after in pairwise((newest, report, card)):
        if _written(after) < _written(before):
            raise PipelineError(
                f"older than {before}, which it is about",
                where=after,
                # Forced: where a file was written anew with the same content, DVC sees nothing to do.
                remedy="python stages/validate.py CONFIG && python stages/card.py CONFIG",
            )


def _written(file: Path) -> int:
    return file.stat().st_mtime_ns


def _explained(error: Exception, repository: str, endpoint: str) -> PipelineError:
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, HfHubHTTPError):
        cause = cause.__cause__
    response = None if cause is None else cause.response
    status = 0 if response is None else response.status_code
    if status in (401, 403, 404):
        what = f"{repository} does not let you write"
        remedy = "hf auth login with a token that has the right to, and mind the owner's name"
    elif 400 <= status < 500 or not isinstance(error, OSError | RuntimeError | httpx.HTTPError):
        what, remedy = f"the upload to {repository} is refused", "mend what the hub says"
    else:
        what = f"the upload to {repository} stopped"
        remedy = "check the network (or HF_ENDPOINT) and run it again: what was sent is not sent again"
    return PipelineError(f"{what} ({' '.join(str(error).split())})", where=endpoint, remedy=remedy)

"""Upload of a dataset to the Hugging Face hub: its files, its card, its recipe and the reports on it.

Only files that a stage recorded are sent, with the recorded content. ``upload.json`` records the upload itself in the
repository; the next upload reads there which files it may replace.

All files go into one commit, so that a reader finds all of a dataset or none of it. Large files are sent before the
commit, and the hub keeps them if the upload is interrupted; the next try sends only the rest. (``upload_large_folder``
of huggingface_hub leaves notes among the files, shows half a dataset meanwhile, and retries for ever if a token may not
write.)
"""

from collections.abc import Iterable, Mapping, Set
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi, get_token
from huggingface_hub.errors import HfHubHTTPError, RevisionNotFoundError
from huggingface_hub.hf_api import RepoFile

from pipeline.errors import MAKE_AGAIN, PipelineError
from pipeline.files import checksum, read_json
from pipeline.formats.base import Format
from pipeline.generated import read_record, unchanged
from pipeline.grouping import grouped
from pipeline.hub import TRANSFER_ERRORS
from pipeline.publish.card import CHECKSUMS, REPOSITORY
from pipeline.publish.repository import (
    UPLOAD,
    Checksums,
    LastUpload,
    Repository,
    compute_checksums,
    deletions,
    files_of,
    read,
)
from pipeline.record import Basis
from pipeline.run.dataset_files import OFT_STATISTICS
from pipeline.run.inputs import published_settings
from pipeline.run.layout import CARD, FINETUNE
from pipeline.run.run import Run


@dataclass(frozen=True)
class Upload:
    """The files of an upload.

    Attributes:
        run: name of the run.
        format: name of the dataset's format.
        dataset: path in the repository to local file, for the files of the dataset.
        others: path in the repository to local file, for all other files.
        sha256: path in the repository to the recorded checksum.
        folders: top folders of the repository that may contain only the dataset.
        tag: name that the commit gets, if a client's loader asks for it.
    """

    run: str
    format: str
    dataset: Mapping[str, Path]
    others: Mapping[str, Path]
    sha256: Mapping[str, str]
    folders: Set[str]
    tag: str | None

    @property
    def files(self) -> dict[str, Path]:
        """All files, by path in the repository."""
        return dict(sorted({**self.dataset, **self.others}.items()))

    def summary(self) -> str:
        """Describe the upload in words.

        Returns:
            Run and format, files and megabytes of each folder, the names of files outside the dataset, and the tag.
        """
        folders = grouped((f"{Path(path).parent}/", file.stat().st_size) for path, file in self.files.items())
        folders["in all"] = [file.stat().st_size for file in self.files.values()]
        lines = [f"run {self.run}, format {self.format}"]
        for name, sizes in folders.items():
            lines.append(f"{len(sizes):6,} files {sum(sizes) / 1e6:10,.1f} MB  {name}")
        lines.append("outside the dataset:")
        lines += [f"  {path}" for path in sorted([*self.others, UPLOAD])]
        lines.append(f"tag: {self.tag or 'none'}")
        return "\n".join(lines)


def prepare(target: Format[Any], run: Run) -> Upload:
    """Gather the files that belong to a dataset; nothing is sent.

    Args:
        target: a dataset of the run.

    Raises:
        PipelineError: when files are missing, foreign, not as recorded, not validated, or failed validation; when the
            configuration has changed since the card was generated.
    """
    recorded = target.record().files
    dataset = {target.repository_path(path): file for path, file in _exactly(target.folder, {*recorded}).items()}
    _reject_unvalidated(run, dataset, target.name)
    _reject_other_settings(run)
    for file in target.written():
        for fault in file.faults():
            raise PipelineError(
                fault.what,
                where=target.folder,
                expected=fault.expected,
                remedy=f"move the file to another place, then generate it again by `{MAKE_AGAIN}`",
            )
    sha256 = {target.repository_path(path): sha256 for path, sha256 in recorded.items()}
    others: dict[str, Path] = {}
    for folder, below, inside in ((CARD, target.name, ""), (FINETUNE, "", f"{FINETUNE}/")):
        checksums = read_record(run.path(folder)).files
        for path, source in unchanged(run.path(folder), below).items():
            name = inside + path.removeprefix(f"{below}/")
            others[name], sha256[name] = source, checksums[path]
    if CHECKSUMS in others:
        _reject_other_dataset(others[CHECKSUMS], sha256, dataset)
    for name, recorded_sha256 in read_record(run.path(CARD)).basis.requested["files"].items():
        source = run.path(name)
        if source.is_symlink() or checksum(source) != recorded_sha256:
            raise PipelineError(
                "the file is a link, or has changed since the card was generated from it",
                where=source,
                remedy=MAKE_AGAIN,
            )
        others[name], sha256[name] = source, recorded_sha256
    # Folders of the format that are empty now, such as videos, belong to the dataset, too.
    folders = target.repository_folders() | {path.partition("/")[0] for path in dataset if "/" in path}
    return Upload(run.name, target.name, dataset, dict(sorted(others.items())), sha256, folders, target.tag())


def compare(upload: Upload, repository: str, *, private: bool = False, replace: bool = False) -> str:
    """Read the repository on the hub, and list the files that an upload would delete there; nothing is sent.

    Returns:
        A description of the repository, and of every file that would be deleted.

    Raises:
        PipelineError: if the repository has files of another origin, or a file here has changed.
    """
    api = HfApi()
    try:
        name = _full_name(api, repository)
        there = read(api, name)
    except TRANSFER_ERRORS as error:
        return f"the content of {repository} and its deleted files are unknown: {' '.join(str(error).split())}"
    if there is None:
        return f"{name} does not exist or is hidden from your token: it would be created"
    _, new = _contents(upload, name)
    gone = _deleted(there, new, upload.folders, private=private, replace=replace)
    kind = "private" if there.private else "public"
    return "\n".join(
        [
            f"{name} ({kind}) has {len(there.files)} files; the upload would delete {len(gone)}",
            *(f"  {x}" for x in gone),
        ]
    )


def send(upload: Upload, repository: str, *, private: bool = False, replace: bool = False) -> str:
    """Create the repository on the hub (of HF_ENDPOINT) if necessary, send missing files, and tag the commit.

    Files of an earlier upload that the dataset no longer has are deleted by the same commit.

    Args:
        repository: ``owner/name``, or ``name`` for a repository of the token's owner.
        private: create a private repository; an existing repository must be private.
        replace: overwrite or delete files that are not of an earlier upload of the same run and format.

    Returns:
        The address of the commit.

    Raises:
        PipelineError: without a token or without the right to write; if the repository has files of another origin;
            if a file has changed; when the network or the hub fails.
    """
    api = HfApi()
    try:
        if get_token() is None:
            raise PipelineError(
                f"no token for {api.endpoint}",
                remedy="log in with `hf auth login`, or set HF_TOKEN, with a token that may write",
            )
        repository = _full_name(api, repository)
        contents, sent = _contents(upload, repository)
        there = read(api, repository)
        if there is None:
            api.create_repo(repository, repo_type="dataset", private=private)
            there = read(api, repository)
        if there is None:
            raise PipelineError(
                "the repository was created, but cannot be read",
                where=repository,
                remedy="use a token that may read it",
            )
        stale = _deleted(there, sent, upload.folders, private=private, replace=replace)
        contents[UPLOAD] = (sent.model_dump_json(indent=1) + "\n").encode()
        operations: list[CommitOperationAdd | CommitOperationDelete] = [
            *(CommitOperationAdd(path, content) for path, content in contents.items()),
            *(CommitOperationDelete(path, is_folder=False) for path in stale),
        ]
        commit = api.create_commit(
            repository,
            operations,
            repo_type="dataset",
            commit_message=f"Upload run {upload.run} as {upload.format}: {len(contents)} files",
            parent_commit=there.commit,
        )
        _reject_other_content(files_of(api, repository, str(commit.oid)), sent, repository)
        if upload.tag is not None:  # An earlier upload may have the tag, which then moves.
            with suppress(RevisionNotFoundError):
                api.delete_tag(repository, tag=upload.tag, repo_type="dataset")
            api.create_tag(repository, tag=upload.tag, revision=commit.oid, repo_type="dataset")
    except TRANSFER_ERRORS as error:
        raise _explained(error, repository, api.endpoint) from error
    return commit.commit_url


def _full_name(api: HfApi, repository: str) -> str:
    """Prepend the token's owner to a name without an owner."""
    return repository if "/" in repository else f"{api.whoami()['name']}/{repository}"


def _deleted(there: Repository, new: LastUpload, folders: Set[str], *, private: bool, replace: bool) -> list[str]:
    """List the paths that an upload deletes, or reject the upload."""
    if private and not there.private:
        raise PipelineError(
            "the repository is public, but --private requests a private one",
            where=there.name,
            remedy="make it private in its settings on the hub, use another name, or leave --private out",
        )
    return deletions(there, new, folders, replace=replace)


def _contents(upload: Upload, repository: str) -> tuple[dict[str, Path | bytes], LastUpload]:
    """Collect the content to send: the dataset as paths, all other files as bytes, and the checksums.

    The card gets the repository's name in the commands that load it.

    Raises:
        PipelineError: when a file has changed since ``prepare``.
    """
    contents: dict[str, Path | bytes] = dict(upload.dataset)
    for path, file in upload.others.items():
        contents[path] = file.read_bytes()
    checksums: dict[str, Checksums] = {}
    for path, content in contents.items():
        checksums[path] = compute_checksums(content)
        if checksums[path].sha256 != upload.sha256[path]:
            raise PipelineError(
                "the file has changed since it was checked", where=upload.files[path], remedy="run the command again"
            )
    card = upload.files["README.md"].read_text().replace(REPOSITORY, repository).encode()
    contents["README.md"], checksums["README.md"] = card, compute_checksums(card)
    return contents, LastUpload(run=upload.run, format=upload.format, files=dict(sorted(checksums.items())))


def _reject_other_content(files: Mapping[str, RepoFile], sent: LastUpload, repository: str) -> None:
    """Raise an error if the hub has other content than recorded, such as a file that changed while it was sent."""
    wrong = [path for path, content in sent.files.items() if path not in files or not content.is_of(files[path])]
    if wrong:
        raise PipelineError(
            f"{len(wrong)} files on the hub differ from their record, such as {wrong[0]}",
            where=repository,
            remedy="make the repository private if the files are confidential, and run the command again",
        )


def _exactly(root: Path, wanted: set[str]) -> dict[str, Path]:
    """List the wanted files below ``root``; raise an error for missing files, further files, and links out of ``root``.

    OFT's statistics are ignored.
    """
    files = {}
    for file in root.rglob("*"):
        if (file.is_symlink() or file.is_file()) and not OFT_STATISTICS.fullmatch(file.name):
            files[file.relative_to(root).as_posix()] = file
    linked = sorted(path for path, file in files.items() if root.resolve() not in file.resolve().parents)
    foreign = sorted(files.keys() - wanted)
    if foreign or linked:
        raise PipelineError(
            f"the folder has {len(foreign)} foreign files and {len(linked)} links to files elsewhere, such as "
            f"{(foreign + linked)[0]}",
            where=root,
            remedy="move them to another folder (training may write files), and push again",
        )
    missing = sorted(wanted - files.keys())
    if missing:
        raise PipelineError(f"{len(missing)} files are missing, such as {missing[0]}", where=root, remedy=MAKE_AGAIN)
    return files


def _reject_other_settings(run: Run) -> None:
    """Raise an error if the configuration has changed since the card, the last output of a run, was generated."""
    record = read_record(run.path(CARD))
    files = record.basis.requested["files"]
    changed = record.describe_mismatch(Basis.of({"files": files, "settings": published_settings(run.config)}, {}))
    if changed:
        raise PipelineError(
            f"the card and the dataset are of another configuration: {changed}",
            where=run.path(CARD),
            expected="a card of the present configuration",
            remedy=MAKE_AGAIN,
        )


def _reject_other_dataset(checksums: Path, sha256: Mapping[str, str], dataset: Iterable[str]) -> None:
    """Raise an error if the card was generated for other files of the dataset, such as those of other options."""
    described: dict[str, str] = {}
    for line in checksums.read_text().splitlines():
        file_sha256, _, path = line.partition("  ")
        described[path] = file_sha256
    differing = [path for path in dataset if described.get(path) != sha256[path]]
    if differing:
        raise PipelineError(
            f"the card describes another dataset: {len(differing)} files differ, such as {differing[0]}",
            where=checksums,
            remedy=MAKE_AGAIN,
        )


def _reject_unvalidated(run: Run, files: Mapping[str, Path], name: str) -> None:
    """Raise an error unless exactly these files passed validation, and the card exists.

    The content of the report that the card was generated from is compared in ``prepare``.
    """
    report, card = run.validation_file, run.path(CARD) / name / "README.md"
    checks = read_json(report)
    failed = [f"{check} ({result['findings'][0]})" for check, result in checks.items() if result["findings"]]
    if failed or not checks:
        raise PipelineError(
            f"{len(failed)} of {len(checks)} checks failed: {'; '.join(failed)}",
            where=report,
            expected="at least one check, and no findings",
            remedy=f"correct the causes of the findings, and `{MAKE_AGAIN}`",
        )
    if not card.is_file():
        raise PipelineError("the card is missing", where=card, remedy=MAKE_AGAIN)
    newest = max(*files.values(), run.manifest_file, key=_written)
    if _written(report) < _written(newest):
        raise PipelineError(f"the report is older than {newest}, which it describes", where=report, remedy=MAKE_AGAIN)


def _written(file: Path) -> int:
    return file.stat().st_mtime_ns


def _explained(error: Exception, repository: str, endpoint: str) -> PipelineError:
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, HfHubHTTPError):
        cause = cause.__cause__
    response = None if cause is None else cause.response
    status = 0 if response is None else response.status_code
    if status in (409, 412):
        what = f"{repository} has changed or was created since it was read"
        remedy = "run the command again: it reads the repository first"
    elif status in (401, 403, 404):
        what = f"your token may not write to {repository}"
        remedy = "log in with `hf auth login` and a token that may write, and check the owner's name"
    elif 400 <= status < 500 or not isinstance(error, OSError | RuntimeError | httpx.HTTPError):
        what, remedy = f"the hub rejected the upload to {repository}", "correct the cause that the hub reports"
    else:
        what = f"the upload to {repository} stopped"
        remedy = "check the network (or HF_ENDPOINT), and run the command again: it does not repeat finished files"
    return PipelineError(f"{what} ({' '.join(str(error).split())})", where=endpoint, remedy=remedy)

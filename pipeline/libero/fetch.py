"""Download LIBERO's demonstrations from the Hugging Face hub."""

import os
from collections.abc import Iterable
from pathlib import Path

from huggingface_hub import HfApi, snapshot_download
from huggingface_hub.hf_api import RepoSibling

from pipeline.errors import PipelineError
from pipeline.exit_status import STORAGE_ERRORS
from pipeline.files import checksum
from pipeline.hub import TRANSFER_ERRORS
from pipeline.libero.hdf5 import SUFFIX
from pipeline.libero.tasks import tasks

REPOSITORY = "yifengzhu-hf/LIBERO-datasets"

REVISION = "f13aa24a3da8c43c7225569f28c562979fa0e35a"
"""Commit of the repository, dated 2025-05-18: a later commit must not change the demonstrations of a run."""


def fetch(out: Path, suites: Iterable[str], endpoint: str | None = None) -> list[Path]:
    """Download whole suites to ``<out>/<suite>/<task>_demo.hdf5``: 10 files of 0.3 to 1 GB for each suite of 10 tasks.

    An interrupted download resumes where it stopped (since huggingface-hub 1 at the start of that file). A file with
    the SHA-256 that the hub states is not downloaded again; any other file stays and is an error. The revision is
    fixed.

    Args:
        out: the folder to use as ``demos.root`` afterwards.
        suites: names of the suites.
        endpoint: address of a mirror of the hub, or `None` for the hub itself.

    Returns:
        The files of the suites, in the order of their tasks.

    Raises:
        PipelineError: when a suite is unknown, or a file with the name of a wanted file is not the hub's. Also when
            the hub cannot be reached or lacks a file.
    """
    wanted: list[str] = []
    for suite in suites:
        wanted += [f"{task}{SUFFIX}" for task in tasks(suite)]
    remedy = (
        "check the network (or HF_ENDPOINT, HF_HUB_OFFLINE) and run the command again, which resumes the download; "
        "or use the starter set, demos.source: starter, which needs no hub"
    )
    try:
        # Without a connection, the download below accepts any folder that is not empty.
        listed = HfApi(endpoint, token=False).dataset_info(REPOSITORY, revision=REVISION, files_metadata=True)
        stated = {file.rfilename: file for file in listed.siblings or ()}
        _reject_other_files(out, wanted, stated)
        present = [name for name in wanted if (out / name).exists()]
        snapshot_download(
            REPOSITORY,
            repo_type="dataset",
            revision=REVISION,
            allow_patterns=wanted,
            local_dir=out,
            # By default, a note of the revision is written into the user's home.
            cache_dir=out / ".cache" / "huggingface",
            endpoint=endpoint,
            # The files are public, so a mirror need not see the user's token.
            token=False,
        )
    except TRANSFER_ERRORS as error:
        if isinstance(error, OSError) and error.errno in STORAGE_ERRORS:
            raise
        raise PipelineError(
            f"the download of {REPOSITORY} at {REVISION[:7]} stopped ({error})", where=out, remedy=remedy
        ) from error
    damaged = [name for name in wanted if name not in present and not _is_copy(out / name, stated.get(name))]
    for name in damaged:
        (out / name).unlink(missing_ok=True)  # Otherwise the next call would take it for the user's.
    if damaged:
        raise PipelineError(
            f"{len(damaged)} of {len(wanted)} files of {REPOSITORY} are missing there or arrived damaged, such as "
            f"{damaged[0]}",
            where=out,
            remedy=remedy,
        )
    return [out / name for name in wanted]


def _reject_other_files(out: Path, wanted: Iterable[str], stated: dict[str, RepoSibling]) -> None:
    """Reject entries of ``out`` that a download would replace and that are not the hub's files.

    Args:
        out: folder of the suites.
        wanted: names of the files to download.
        stated: the hub's files by name, with size and hash.
    """
    foreign = []
    for name in wanted:
        if os.path.lexists(out / name) and not _is_copy(out / name, stated.get(name)):
            foreign.append(name)
    if foreign:
        raise PipelineError(
            f"{len(foreign)} files are not the hub's, and a download would replace them: {', '.join(foreign)}",
            where=out,
            expected=f"no files of these names, or copies of those of {REPOSITORY} at {REVISION[:7]}",
            remedy="fetch into another folder, or move these files to another folder",
        )


def _is_copy(file: Path, stated: RepoSibling | None) -> bool:
    """Return whether a file has the size and the SHA-256 that the hub states."""
    if stated is None or stated.lfs is None or not file.is_file():
        return False
    return file.stat().st_size == stated.size and checksum(file) == stated.lfs.sha256

"""Download LIBERO's demonstrations from the Hugging Face hub."""

from collections.abc import Iterable
from pathlib import Path

import httpx
from huggingface_hub import HfApi, snapshot_download

from pipeline.errors import PipelineError
from pipeline.libero import hdf5
from pipeline.libero.tasks import tasks

REPOSITORY = "yifengzhu-hf/LIBERO-datasets"

REVISION = "f13aa24a3da8c43c7225569f28c562979fa0e35a"
"""Commit of the repository, of 2025-05-18: a later one must not change what a run starts from."""


def fetch(out: Path, suites: Iterable[str], endpoint: str | None = None) -> list[Path]:
    """Download whole suites to ``<out>/<suite>/<task>_demo.hdf5``: 10 files of 0.3 to 1 GB for each suite of 10 tasks.

    A download that was cut short goes on where it stopped (since huggingface-hub 1 at the start of that file), and
    files that are there are not fetched again. The revision is fixed.

    Args:
        out: the folder to use as ``demos.root`` afterwards.
        endpoint: address of a mirror of the hub, when not the hub itself.

    Raises:
        PipelineError: for an unknown suite, when a file of an expansion is there, and when the hub could not be reached
            or lacks a file.
    """
    wanted = [f"{task}_demo.hdf5" for suite in suites for task in tasks(suite)]
    for file in (out / name for name in wanted):
        if file.exists() and any(_expanded(file)):
            raise PipelineError(
                "holds demonstrations of `demos expand`, and would be replaced",
                where=file,
                remedy="fetch into another folder",
            )
    remedy = (
        "check the network (or HF_ENDPOINT, HF_HUB_OFFLINE) and run it again, it goes on where it stopped; "
        "or use the starter set, demos.source: starter, which needs no hub"
    )
    try:
        # Without a connection the download below is content with any folder that is not empty.
        told = HfApi(endpoint, token=False).dataset_info(REPOSITORY, revision=REVISION, files_metadata=True)
        snapshot_download(
            REPOSITORY,
            repo_type="dataset",
            revision=REVISION,
            allow_patterns=wanted,
            local_dir=out,
            # Or else a note of the revision lands in the user's home.
            cache_dir=out / ".cache" / "huggingface",
            endpoint=endpoint,
            # The files are public: no reason to show a mirror the user's token.
            token=False,
        )
    except (OSError, httpx.HTTPError) as error:  # the second since huggingface-hub 1
        raise PipelineError(
            f"the download of {REPOSITORY} at {REVISION[:7]} stopped ({error})", where=out, remedy=remedy
        ) from error
    size_bytes = {file.rfilename: file.size for file in told.siblings or ()}
    there = {name: (out / name).stat().st_size for name in wanted if (out / name).is_file()}
    missing = [name for name in wanted if name not in there or there[name] != size_bytes.get(name)]
    if missing:
        raise PipelineError(
            f"{len(missing)} of {len(wanted)} files of {REPOSITORY} could not be had whole, such as {missing[0]}",
            where=out,
            remedy=remedy,
        )
    return [out / name for name in wanted]


def _expanded(file: Path) -> list[bool]:
    try:
        return hdf5.expanded(file)
    except PipelineError:
        return []  # A damaged file is fetched anew.

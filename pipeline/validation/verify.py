"""Compare everything that a run stored with the checksums that it was stored with."""

from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any

from pipeline.compute.pool import Workers
from pipeline.config import Config
from pipeline.errors import PipelineError
from pipeline.formats.read_back import Written
from pipeline.formats.registry import recorded
from pipeline.stores.frame_store import FrameStore
from pipeline.stores.store import Store
from pipeline.stores.trajectory_store import TrajectoryStore


def verify(config: Config, workers: Workers) -> dict[str, dict[str, Any]]:
    """Read every stored file of a run: trajectories, frames and the datasets.

    Returns:
        JSON-serialisable: what was read to how many files were ``checked``, and which are ``damaged``, each with what
        to do about it.
    """
    results: dict[str, dict[str, Any]] = {}
    stores = (TrajectoryStore(config.data / "trajectories"), FrameStore(config.data / "frames", config.render))
    for name, store in zip(("trajectories", "frames"), stores, strict=True):
        results[name] = _result(workers(partial(_damaged, store), store.names(), name))
    for one in recorded(config.data, config.export, config.render.extras):
        name = one.folder.relative_to(config.data).as_posix()
        try:
            files = one.written()
        except PipelineError as error:
            results[name] = {"checked": 0, "damaged": [str(error)]}
            continue
        faults = workers(Written.faults, files, one.title)
        results[name] = _result([f"{fault.what}: {fault.expected}" for fault in found] for found in faults)
    return results


def _damaged(store: Store, file: str) -> list[str]:
    try:
        with store.opened(file) as opened:
            for array in opened.checksums:
                opened.array(array)
    except PipelineError as error:
        return [str(error)]
    return []


def _result(findings: Iterable[Sequence[str]]) -> dict[str, Any]:
    listed = list(findings)
    return {"checked": len(listed), "damaged": [finding for found in listed for finding in found]}

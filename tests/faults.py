"""Damaged files, limited resources, and local servers that may fail."""

import os
import resource
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from http.server import ThreadingHTTPServer
from pathlib import Path
from typing import TypeVar

from pipeline.errors import PipelineError

Result = TypeVar("Result")


@contextmanager
def served(server: ThreadingHTTPServer) -> Iterator[None]:
    """Run a local server in a thread."""
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    yield
    server.shutdown()
    server.server_close()
    thread.join()


@contextmanager
def limited(what: int, most: int) -> Iterator[None]:
    """Limit a resource of this process to ``most``."""
    before = resource.getrlimit(what)
    resource.setrlimit(what, (most, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(what, before)


def rot(file: Path) -> None:
    """Flip a bit in the middle of a file as a bad disk does, without a change of its time."""
    content, stamp = bytearray(file.read_bytes()), file.stat().st_mtime_ns
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    os.utime(file, ns=(stamp, stamp))


def read_with_flipped_bits(file: Path, places: Iterable[int], read: Callable[[], Result]) -> list[Result]:
    """Read a file with one bit flipped at each of some places; return the results of reads without a PipelineError."""
    content, results = file.read_bytes(), []
    for place in places:
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(place) % 8
        file.write_bytes(damaged)
        with suppress(PipelineError):
            results.append(read())
    file.write_bytes(content)
    return results

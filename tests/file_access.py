"""Which files processes open, told by the kernel: inotify on every folder of a tree."""

from __future__ import annotations

import ctypes
import os
import select
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_IN_OPEN, _IN_ISDIR = 0x20, 0x40000000
_EVENT = struct.Struct("iIII")


@contextmanager
def opened_files(root: Path) -> Iterator[set[Path]]:
    """Collect the files below ``root`` that anybody opens while the block runs.

    Folders that are made meanwhile are not watched: what a process makes itself is none of its inputs.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    queue = libc.inotify_init()
    if queue < 0:
        raise OSError(ctypes.get_errno(), "inotify_init")
    folders: dict[int, Path] = {}
    for folder in (root, *(path for path in root.rglob("*") if path.is_dir() and not path.is_symlink())):
        watch = libc.inotify_add_watch(queue, os.fsencode(folder), _IN_OPEN)
        if watch < 0:
            raise OSError(ctypes.get_errno(), f"inotify_add_watch {folder}")
        folders[watch] = folder
    opened: set[Path] = set()
    stop, stopped = os.pipe()

    def collect() -> None:
        while True:
            ready, _, _ = select.select([queue, stop], [], [])
            if queue not in ready:
                return
            events = os.read(queue, 1 << 20)
            while events:
                watch, mask, _, length = _EVENT.unpack_from(events)
                name = events[_EVENT.size : _EVENT.size + length].rstrip(b"\0")
                events = events[_EVENT.size + length :]
                if mask & _IN_OPEN and not mask & _IN_ISDIR and name:
                    opened.add(folders[watch] / os.fsdecode(name))

    thread = threading.Thread(target=collect)
    thread.start()
    try:
        yield opened
    finally:
        os.write(stopped, b"x")
        thread.join()
        for descriptor in (queue, stop, stopped):
            os.close(descriptor)

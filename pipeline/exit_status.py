"""End of a command: an exit status, and a message with a remedy in place of a traceback."""

import errno
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from pipeline.errors import MAKE_AGAIN, PipelineError

GO_ON = "run the same command again, which keeps finished work"

SURROUNDINGS = {
    errno.ENOSPC: (
        "the disk is full",
        f"free space (`python -m pipeline doctor CONFIG` reports the need), and {GO_ON}",
    ),
    errno.EDQUOT: ("your disk quota is used up", f"free space or raise the quota, and {GO_ON}"),
    errno.EROFS: ("the file system is read-only", f"mount it for writing, and {GO_ON}"),
    errno.EACCES: ("you have no permission to read or write it", f"change its permissions or its owner, and {GO_ON}"),
    errno.EPERM: ("you have no permission to change it", f"change its permissions or its owner, and {GO_ON}"),
    errno.ENOENT: ("the file is missing", f"run `{MAKE_AGAIN}`, which performs all stages in order"),
    errno.ENOTDIR: ("a file is in the place of a folder", f"move it to another place, and {GO_ON}"),
    errno.EEXIST: ("an existing file is in the place of a folder", f"move it to another place, and {GO_ON}"),
    errno.ENAMETOOLONG: ("the name is too long for the file system", "choose a shorter name"),
    errno.EISDIR: ("a folder is in the place of a file", f"move it to another place, and {GO_ON}"),
    errno.ELOOP: ("symbolic links form a cycle", f"correct the links, and {GO_ON}"),
    errno.EMFILE: ("too many files are open", f"raise the limit (`ulimit -n 4096`), and {GO_ON}"),
    errno.EXDEV: ("the folder is on another file system", f"keep the folder of a run on one file system, and {GO_ON}"),
    errno.EBUSY: ("another program uses it", f"stop that program, or unmount it, and {GO_ON}"),
    errno.ENOTEMPTY: ("another program writes into the folder or reads from it", f"stop that program, and {GO_ON}"),
    errno.ESTALE: ("another machine deleted it", GO_ON),
    errno.ENOLCK: ("the file system has no locks", f"mount it with locks, and {GO_ON}"),
    errno.EIO: ("the disk has an error", "run `python -m pipeline dataset check CONFIG`, which lists damaged files"),
}
"""Error number of the system to its description and remedy. All other errors are bugs and keep their traceback."""

STORAGE_ERRORS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.ENAMETOOLONG})
"""Error numbers of ``SURROUNDINGS`` that a folder for downloads may cause."""


class Terminated(KeyboardInterrupt):
    """Interruption by SIGTERM: the machine shuts down, or a scheduler's time limit is over."""


def exit_status(command: Callable[[], int]) -> int:
    """Call a command, and print to the standard error why it ended early.

    Returns:
        The command's status; 1 for an error; 130 after SIGINT (Ctrl-C) and 143 after SIGTERM.
    """
    try:
        with _terminated():
            return command()
    except PipelineError as error:
        return _told(str(error), 1)
    except KeyboardInterrupt as stopped:
        return _told(f"stopped; {GO_ON}", 143 if isinstance(stopped, Terminated) else 130)
    except MemoryError:
        return _told(f"not enough memory\n  try: reduce compute.workers, and {GO_ON}", 1)
    except OSError as error:
        if error.errno not in SURROUNDINGS:
            raise
        what, remedy = SURROUNDINGS[error.errno]
        where = error.filename2 or error.filename
        return _told(str(PipelineError(f"{what} ({error.strerror})", where=where, remedy=remedy)), 1)


def _told(message: str, status: int) -> int:
    print(f"error: {message}" if status == 1 else message, file=sys.stderr)
    return status


@contextmanager
def _terminated() -> Iterator[None]:
    def stop(number: int, frame: FrameType | None) -> None:
        # Ignore further signals, as closing files and workers may take time.
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        raise Terminated

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)

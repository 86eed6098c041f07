"""Model servers in separate processes, as in evaluations."""

import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager


@contextmanager
def running(*program: str) -> Iterator[str]:
    """Run a model server; yield its address.

    Args:
        program: arguments of Python: a file, or ``-m`` and a module, and the program's options except the address.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = subprocess.Popen([sys.executable, *program, "--address", f"127.0.0.1:{port}"])
    try:
        while server.poll() is None:
            try:
                socket.create_connection(("127.0.0.1", port)).close()
                break
            except OSError:
                time.sleep(0.1)
        yield f"ws://127.0.0.1:{port}"
    finally:
        server.terminate()
        server.wait()


def replaying(chunk: int) -> AbstractContextManager[str]:
    """Run the server that replays demonstrations, as a context that gives its address.

    Args:
        chunk: number of actions in each answer.
    """
    return running("-m", "pipeline.evaluation.harness", "--args.chunk", str(chunk))

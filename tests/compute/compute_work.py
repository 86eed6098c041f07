"""Functions and jobs for workers, in a module that imports quickly."""

import os
import resource
import time
from dataclasses import dataclass
from pathlib import Path

from pipeline import gl
from pipeline.compute.pool import Job
from pipeline.errors import PipelineError

BLOCK_BYTES = 3 * 256 * 256
"""Bytes of a frame of 256 pixels."""


def square(number: int) -> int:
    return number * number


def process(_: int) -> int:
    time.sleep(0.1)  # else one worker may finish all items before the second worker starts
    return os.getpid()


def reject_two(number: int) -> int:
    if number == 2:
        raise PipelineError("two is rejected", where="item 2", expected="another number", remedy="leave it out")
    return number


def gpu(_: int) -> tuple[int, str, str | None, int]:
    time.sleep(0.1)
    return os.getpid(), gl.choose().device, os.environ.get("MUJOCO_EGL_DEVICE_ID"), gl.choose().sharing


def die(_: int) -> int:
    os._exit(1)


@dataclass(frozen=True)
class SquareJob(Job[int]):
    """Job that squares its number, which is also its size."""

    number: int

    def __call__(self) -> int:
        return square(self.number)

    def limit_s(self) -> float:
        return 1.0

    def lost(self) -> int:
        return square(self.number)

    def size(self) -> int:
        return self.number


@dataclass(frozen=True)
class DieOrHangJob(Job[int]):
    """Job that ends its worker for number 2, and hangs for number 3."""

    number: int

    def __call__(self) -> int:
        if self.number == 2:
            die(self.number)
        if self.number == 3:
            time.sleep(1000)
        return self.number

    def limit_s(self) -> float:
        return 2.0 if self.number == 3 else 300.0

    def lost(self) -> int:
        return -self.number


def mark(file: Path) -> None:
    file.touch()
    time.sleep(0.1)


def pages_asked_for(times: int) -> int:
    """Count the memory pages that the system provides while a block is allocated, filled and freed ``times`` times."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(times):
        b"x" * BLOCK_BYTES
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

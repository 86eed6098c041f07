"""Which policy acts, and what tells it from any other: the content of its files, or else the label that it is given."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pipeline.axes.base import Frozen
from pipeline.errors import PipelineError
from pipeline.evaluation.policies import Checkpoint, Policy, Server
from pipeline.evaluation.replays import Replay, TrackedReplay
from pipeline.files import checksum
from pipeline.seeding import digest

BESIDE = ("train_config.json", "README.md")
"""Files of a checkpoint that do not decide what it does."""


class PolicyConfig(Frozen):
    """What acts.

    Attributes:
        kind: ``server`` for a model server's address, ``checkpoint`` for a folder that lerobot saved, ``open_loop`` for
            the demonstrations' own actions, ``tracked`` for their paths, followed by feedback.
        address: of the server, such as ``ws://localhost:8000``, or the folder; empty for the demonstrations.
        label: name in the results. A server must have one, another for each policy: nothing else tells what is behind
            its address.
        timeout_s: how long a server's answer may take.
    """

    kind: Literal["server", "checkpoint", "open_loop", "tracked"]
    address: str = ""
    label: str = ""
    timeout_s: float = 120.0

    def identity(self) -> str:
        """What is the same for the same policy alone: ``sha256:`` and the content of a checkpoint, ``script:`` and the
        kind of a replay, or ``claimed:`` and the label, where nobody but the user knows.

        Raises:
            PipelineError: when a server has no label, or a folder no checkpoint.
        """
        match self.kind:
            case "checkpoint":
                return f"sha256:{content_of(Path(self.address))}"
            case "server" if not self.label:
                raise PipelineError(
                    "this server has no label",
                    where=self.address,
                    expected="--label NAME, another for each policy: an address does not tell what is behind it, and "
                    "results of another policy there would be taken for this one's",
                )
            case "server":
                return f"claimed:{self.label}"
            case _:
                return f"script:{self.kind}"

    def name(self, identity: str) -> str:
        """In the results: the label, or what has this identity."""
        scripts = {"open_loop": "replay", "tracked": "tracked replay"}
        return self.label or scripts.get(self.kind) or f"{self.address} {identity.removeprefix('sha256:')[:8]}"

    def open(self, look_every: int) -> Policy:
        match self.kind:
            case "server":
                return Server(self.address, self.timeout_s, look_every)
            case "checkpoint":
                return Checkpoint(Path(self.address))
            case "open_loop":
                return Replay()
            case "tracked":
                return TrackedReplay()


def content_of(checkpoint: Path) -> str:
    """SHA-256 of the files in a checkpoint's folder, by their names: configuration, weights, processors and whatever
    else is there but ``BESIDE`` and hidden files. What lerobot loads from elsewhere, such as a tokenizer, is not in it.

    Raises:
        PipelineError: when it is no checkpoint, or cannot be read.
    """
    if not (checkpoint / "config.json").is_file():
        raise PipelineError("no config.json", where=checkpoint, expected="a folder that lerobot saved a policy in")
    inside = {path.relative_to(checkpoint): path for path in checkpoint.rglob("*") if path.is_file()}
    deciding = {
        name.as_posix(): path
        for name, path in inside.items()
        if name.name not in BESIDE and not any(part.startswith(".") for part in name.parts)
    }
    try:
        return digest({name: checksum(path) for name, path in deciding.items()})
    except OSError as error:
        raise PipelineError(f"cannot be read ({error})", where=checkpoint) from error

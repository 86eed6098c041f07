"""Configuration of a policy: its kind, its name and identity in results, and how it is opened."""

from pathlib import Path
from typing import Literal

from pydantic import Field

from pipeline.errors import PipelineError
from pipeline.evaluation.checkpoint import Checkpoint, content_of
from pipeline.evaluation.environment import EpisodeSettings
from pipeline.evaluation.model_server import Server
from pipeline.evaluation.policies import Policy
from pipeline.evaluation.reference_policies import Replay, TrackedReplay
from pipeline.types import Frozen


class PolicyConfig(Frozen, use_attribute_docstrings=True):
    """Configuration of the policy that acts."""

    kind: Literal["server", "checkpoint", "open_loop", "tracked"]
    """a model server, a folder that lerobot saved, the demonstrations' own actions, or their paths, followed by
    feedback"""
    address: str = ""
    """address of the server, such as ``ws://localhost:8000``, or the folder; empty for the demonstrations"""
    label: str = ""
    """name of the policy in the results. A server must have a label, a different one for each policy, because its
    address does not identify the policy."""
    timeout_s: float = Field(default=120.0, gt=0)
    """time limit of a server's answer in seconds"""

    def identity(self) -> str:
        """Return the policy's identity, which is equal for equal policies only.

        The identity is ``sha256:`` and the content of a checkpoint, or ``script:`` and the kind of a replay. For a
        server it is ``claimed:`` and the label, because only the user knows the policy.

        Raises:
            PipelineError: if a server has no label, or if the folder is not a checkpoint.
        """
        match self.kind:
            case "checkpoint":
                return f"sha256:{content_of(Path(self.address))}"
            case "server" if not self.label:
                raise PipelineError(
                    "this server has no label",
                    where=self.address,
                    expected="--label NAME, a different one for each policy: an address does not identify a policy, so "
                    "results of another policy at it would count as results of this policy",
                )
            case "server":
                return f"claimed:{self.label}"
            case _:
                return f"script:{self.kind}"

    def name(self, identity: str) -> str:
        """Return the policy's name in the results: the label, else a name derived from kind, address and identity."""
        scripts = {"open_loop": "replay", "tracked": "tracked replay"}
        return self.label or scripts.get(self.kind) or f"{self.address} {identity.removeprefix('sha256:')[:8]}"

    def open(self, settings: EpisodeSettings) -> Policy:
        """Load the policy, or connect to its server."""
        match self.kind:
            case "server":
                return Server(self.address, self.timeout_s, settings.look_every, settings.actions, settings.state_angle)
            case "checkpoint":
                return Checkpoint(Path(self.address))
            case "open_loop":
                return Replay(demos=settings.demos)
            case "tracked":
                return TrackedReplay(settings.demos)

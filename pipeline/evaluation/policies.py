"""Interface of policies, and the parts of an observation that they ask for."""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, Protocol

from pipeline.evaluation.tasks import EvaluationTask

VIEWS = {"agentview": "image", "wrist": "wrist_image"}
"""Name of a view for policies to its name in ``schemas/episode.json``."""


StateAngle = Literal["server", "pi", "2pi"]
"""Range of the angle of a state's axis-angle, in rad: as the server requests, [0, pi], or [0, 2 pi]."""


class Wanted(NamedTuple):
    """Parts of an observation that a policy asks for.

    Attributes:
        wrist: the wrist view.
        state: position, axis-angle and fingers.
        shortest_rotation: if set, the axis-angle has an angle in [0, pi], vla-eval's default. Else the angle is in
            [0, 2 pi], as in robosuite and OpenVLA's data.
        images: any view; without images nothing is rendered.
    """

    wrist: bool = True
    state: bool = True
    shortest_rotation: bool = False
    images: bool = True


def is_shortest(state_angle: StateAngle, no_antipodal: bool) -> bool:
    """Return ``Wanted.shortest_rotation``.

    Args:
        state_angle: the user's choice.
        no_antipodal: vla-eval's parameter ``quat_no_antipodal``, by which a server requests [0, 2 pi].
    """
    return not no_antipodal if state_angle == "server" else state_angle == "pi"


Look = Callable[[Wanted], dict[str, Any]]
"""Function that returns the observation; a call renders the frames."""


class Policy(Protocol):
    """Policy that gives actions until the episode is over."""

    name: str
    wanted: Wanted
    """Parts of an observation that the policy uses."""

    def begin(self, task: EvaluationTask) -> None:
        """Begin an episode."""

    def act(self, look: Look) -> Any:
        """Return the next actions, (n, 7) or (7,) for one action, in the format of ``checked_actions``.

        Args:
            look: function that returns the observation; the policy calls it only if it needs a new observation.

        Raises:
            PolicyError: if there is no answer.
        """

    def end(self, success: bool) -> None:
        """End the episode."""

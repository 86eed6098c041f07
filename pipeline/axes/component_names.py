"""Names of components that were renamed; what is stored keeps the former name.

Ids of episodes and results are hashes of stored perturbations, so they do not depend on the name that is shown.
"""

from typing import Any

FORMER = {"gaussian_blur": "gaussian"}
"""Name of a component to its former name."""

_CURRENT = {former: name for name, former in FORMER.items()}


def current_names(joined: Any) -> Any:
    """Replace former names in the name of a component, or in several that are joined by +; return no text as it is."""
    if not isinstance(joined, str):
        return joined
    return "+".join(_CURRENT.get(name, name) for name in joined.split("+"))


def stored_names(joined: str) -> str:
    """Return the names that are stored and hashed, the reverse of ``current_names``."""
    return "+".join(FORMER.get(name, name) for name in joined.split("+"))

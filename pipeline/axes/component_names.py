"""Names of components that were renamed; stored perturbations keep the former name.

Ids of episodes and results are hashes of stored perturbations, so they do not depend on the name that is shown. Columns
such as ``component`` of the manifest have the present name.
"""

from typing import Annotated, Any

from pydantic import BeforeValidator

FORMER = {"gaussian_blur": "gaussian"}
"""Name of a component to its former name."""

_CURRENT = {former: name for name, former in FORMER.items()}


def current_names(joined: Any) -> Any:
    """Replace former names in the name of a component, or in names joined by +; return other values unchanged."""
    if not isinstance(joined, str):
        return joined
    return "+".join(_CURRENT.get(name, name) for name in joined.split("+"))


def stored_names(joined: str) -> str:
    """Return the names that are stored and hashed, the reverse of ``current_names``."""
    return "+".join(FORMER.get(name, name) for name in joined.split("+"))


ComponentName = Annotated[str, BeforeValidator(current_names)]
"""Name of a component in a filter, which may be a former name."""

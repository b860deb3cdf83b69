"""Messages for names that do not exist."""

import difflib
from collections.abc import Sequence


def unknown(kind: str, name: str, valid: Sequence[str]) -> str:
    """Message for a name that does not exist, with the valid ones.

    Args:
        kind: What the name stands for, for instance `robot`.
        name: The name that was given.
        valid: The names that exist.
    """
    near = difflib.get_close_matches(name, valid, n=1)
    hint = f" Did you mean '{near[0]}'?" if near else ""
    return f"unknown {kind} '{name}'; valid names: {', '.join(valid)}.{hint}"

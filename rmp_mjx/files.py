"""Files that are replaced in one move: a killed process leaves the old or the new."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Replace a file by what the body writes to the path that it gets.

    If the body raises, the old file stays and the new one is removed.

    Args:
        path: The file; its folder must exist.

    Yields:
        A path in the same folder, for the new contents.
    """
    temporary = path.with_name(f"{path.name}.tmp")
    try:
        yield temporary
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_text(path: Path, text: str) -> None:
    """Replace a text file in one move."""
    with replacing(path) as temporary:
        temporary.write_text(text)

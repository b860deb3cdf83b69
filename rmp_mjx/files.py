"""Files that are replaced in one move, and JSON files that anybody may have damaged."""

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Replace a file by what the body writes to the path that it gets.

    A process that is killed leaves the old file or the new one. If the body raises, the
    old file stays and the new one is removed.

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


def read_json(path: Path) -> Any:
    """The content of a JSON file.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It cannot be read, or is no JSON; the message names it.
    """
    try:
        return json.loads(path.read_text())
    except FileNotFoundError:
        raise
    except (OSError, ValueError, RecursionError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ValueError(f"{path} cannot be read: {reason}") from error


def with_tuples(record: Mapping[str, Any]) -> dict[str, Any]:
    """A record with tuples again where JSON gave back lists."""
    return {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in record.items()
    }

"""The file that goes to the robot: parts in a zip, with a SHA-256 of each.

`metadata.json` says what the parts are and holds their checksums; zip's own CRC guards
it. The checksums find damage, not forgery: take files from people you trust. No part is
pickled, and none is code in Python.
"""

import hashlib
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rmp_mjx.files import replacing

FORMAT = "rmp_mjx_deploy"
"""What the metadata calls the format."""
VERSION = 1
"""Version of the format that this module writes and reads."""
SUFFIX = ".rmp"
"""How such a file's name ends."""
METADATA = "metadata.json"
"""The part that describes the others."""
MOST_BYTES = 100_000_000
"""More than any part has."""


class DeployError(ValueError):
    """A file cannot be used on a robot; the message says why."""


def write(path: Path, metadata: Mapping[str, Any], parts: Mapping[str, bytes]) -> None:
    """Write a file; a process that is killed leaves the old one or the new one.

    The same parts give the same bytes.

    Args:
        path: The file, by custom NAME.rmp.
        metadata: What it is; JSON-ready.
        parts: Contents by name.
    """
    sums = {name: hashlib.sha256(data).hexdigest() for name, data in parts.items()}
    head = {"format": FORMAT, "version": VERSION, **metadata, "sha256": sums}
    text = json.dumps(head, indent=1).encode()
    with replacing(path) as new, zipfile.ZipFile(new, "w") as archive:
        for name, data in {METADATA: text, **parts}.items():
            info = zipfile.ZipInfo(name)  # of 1980: no clock in the file
            info.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(info, data)


def read(path: Path) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Read a file.

    Returns:
        Its metadata, and the other parts by name.

    Raises:
        DeployError: It is damaged, not one of these files, or of another version.
        FileNotFoundError: There is none.
    """
    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}")
    try:
        with zipfile.ZipFile(path) as archive:
            found = {x.filename: _part(path, archive, x) for x in archive.filelist}
    except DeployError:
        raise
    except Exception as error:  # whatever zipfile and zlib make of damaged bytes
        raise _foreign(path, error) from error
    metadata = _metadata(path, found.pop(METADATA, b""))
    sums = metadata.get("sha256")
    if not isinstance(sums, dict) or set(sums) != set(found):
        raise DeployError(f"{path} is damaged: its parts are not those that it lists")
    for name, data in found.items():
        if hashlib.sha256(data).hexdigest() != sums[name]:
            raise DeployError(f"{path} is damaged: {name} fails its checksum")
    return metadata, found


def _part(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> bytes:
    if info.file_size > MOST_BYTES:
        raise DeployError(f"{path}: {info.filename} has {info.file_size:,} bytes")
    return archive.read(info)


def _metadata(path: Path, text: bytes) -> dict[str, Any]:
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise _foreign(path, f"no {METADATA} that can be read") from error
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise _foreign(path, f"{METADATA} names another format")
    if found.get("version") != VERSION:
        raise DeployError(
            f"{path} has version {found.get('version')} of the format, this rmp_mjx "
            f"reads {VERSION}: export the policy again, or install another rmp_mjx"
        )
    return found


def _foreign(path: Path, reason: object) -> DeployError:
    return DeployError(f"{path} is damaged, or no file of rmp-mjx-export: {reason}")

"""A policy as one file: its arrays and what they are, read without Orbax.

The file is a `safetensors` file (Hugging Face): the mean and the standard deviation of
the observations, the layers of the policy network, and in its metadata, as JSON, a
description and a SHA-256 of both. Value network and optimisers stay in the checkpoints.

Many policies are one file too: FOLDER.safetensors takes the place of all the files of
FOLDER, and FOLDER/NAME.safetensors is still the path of each.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from brax.training.acme import running_statistics
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from rmp_mjx.files import replacing
from rmp_mjx.training.config import ConfigError
from rmp_mjx.training.learning.networks import Agent, make_agent, make_networks

KEY = "rmp_mjx_policy"
"""The entry of the metadata that makes a safetensors file a policy."""
MANY = "rmp_mjx_policies"
"""The entry of the metadata that makes one a folder of policies."""
SUFFIX = ".safetensors"
"""How a policy file's name ends."""
VERSION = 1
"""Version of the format that this module writes and reads."""
NORMALIZER, NETWORK = "normalizer", "policy"
"""Parts of a policy: the first word of an array's name."""


class PolicyError(ConfigError):
    """A file is no policy that can be used; the message says why."""


@dataclass(frozen=True, eq=False)
class Policy:
    """A policy that was read from a file."""

    arrays: dict[str, np.ndarray]
    """Arrays by name, for instance `normalizer/mean`."""
    about: dict[str, Any]
    """What it is, for instance `config`, `versions`, `iterations`, `safety`."""

    def agent(
        self, observation_size: int, action_size: int, deterministic: bool
    ) -> Agent:
        """The policy as evaluation runs it.

        Args:
            observation_size: Length of an observation of the environment.
            action_size: Length of its actions.
            deterministic: Act with the mean action.

        Raises:
            PolicyError: The policy has other sizes, or arrays are missing.
        """
        widths = [len(self.arrays[name]) for name in hidden_biases(self.arrays)]
        networks = make_networks(observation_size, action_size, tuple(widths), 0.0)
        shape = jax.ShapeDtypeStruct((observation_size,), np.dtype(np.float32))
        template = {
            NORMALIZER: {"mean": shape, "std": shape},
            NETWORK: jax.eval_shape(networks.policy_network.init, jax.random.key(0)),
        }
        parts = _fill(template, self.arrays)
        normalizer = running_statistics.NestedMeanStd(**parts[NORMALIZER])
        return make_agent(networks, normalizer, parts[NETWORK], deterministic)


def hidden_biases(arrays: Mapping[str, np.ndarray]) -> list[str]:
    """Names of the hidden layers' biases, in the order of the layers."""
    found = [name for name in arrays if "/hidden_" in name and name.endswith("/bias")]
    return sorted(found, key=lambda name: int(name.split("/hidden_")[1].split("/")[0]))


def arrays_of(agent: Agent) -> dict[str, np.ndarray]:
    """The arrays of a policy by name, as its file has them.

    Args:
        agent: What `make_agent` returned, of one seed.
    """
    normalizer, params = agent.args  # pyright: ignore[reportFunctionMemberAccess]
    parts = {
        NORMALIZER: {"mean": normalizer.mean, "std": normalizer.std},
        NETWORK: params,
    }
    return {name: np.asarray(leaf) for name, leaf in _named(parts).items()}


def save_policy(path: Path, agent: Agent, about: Mapping[str, Any]) -> None:
    """Write a policy; a process that is killed leaves the old file or the new one.

    Args:
        path: The file, by custom NAME.safetensors.
        agent: What `make_agent` returned, of one seed.
        about: What it is; JSON-ready.
    """
    arrays = arrays_of(agent)
    head = _head(arrays, about)
    with replacing(path) as temporary:
        temporary.write_bytes(save(arrays, {KEY: json.dumps(head)}))


def save_folder(folder: Path, policies: Mapping[str, Policy]) -> Path:
    """Write many policies as one file, FOLDER.safetensors.

    Args:
        folder: The folder whose place it takes; FOLDER/NAME.safetensors is the path of
            one of them.
        policies: They by name.

    Returns:
        The file.
    """
    heads = {name: _head(each.arrays, each.about) for name, each in policies.items()}
    arrays = {
        f"{name}/{key}": array
        for name, each in policies.items()
        for key, array in each.arrays.items()
    }
    path = _packed(folder)
    with replacing(path) as temporary:
        temporary.write_bytes(save(arrays, {MANY: json.dumps(heads)}))
    return path


def _packed(folder: Path) -> Path:
    """The file that takes a folder's place."""
    return Path(f"{folder}{SUFFIX}")


def names(folder: Path) -> list[str]:
    """Names of the policies of a folder: of its files, and of FOLDER.safetensors.

    Raises:
        PolicyError: FOLDER.safetensors cannot be read.
    """
    packed = _packed(folder)
    found = {path.stem for path in folder.glob(f"*{SUFFIX}")}
    if packed.is_file():
        metadata, _ = _read(packed)
        found |= set(_parsed(packed, metadata.get(MANY, "{}")))
    return sorted(found)


def is_policy(path: Path) -> bool:
    """Whether there is a file of that name, or one that takes its folder's place."""
    if path.is_file():
        return path.suffix == SUFFIX
    packed = _packed(path.parent)
    return (
        path.suffix == SUFFIX and packed.is_file() and path.stem in names(path.parent)
    )


def load_policy(path: Path) -> Policy:
    """Read a policy that `save_policy` or `save_folder` wrote.

    Raises:
        PolicyError: There is no such file, it is damaged, it is something else, or a
            newer version of this project wrote it.
    """
    if path.is_file():
        metadata, arrays = _read(path)
        if KEY not in metadata:
            hint = f"; it holds many: --run {path.with_suffix('')}/NAME"
            raise PolicyError(
                f"{path} is a safetensors file, but no policy of rmp_mjx"
                f"{hint if MANY in metadata else ''}"
            )
        return _checked(path, _parsed(path, metadata[KEY]), arrays)
    if not is_policy(path):
        raise PolicyError(f"{path}: no such policy file")
    packed = _packed(path.parent)
    metadata, arrays = _read(packed, f"{path.stem}/")
    return _checked(path, _parsed(packed, metadata[MANY])[path.stem], arrays)


def _read(path: Path, prefix: str = "") -> tuple[dict[str, str], dict[str, np.ndarray]]:
    """Metadata of a file, and the arrays whose names begin so, without the prefix."""
    try:
        with safe_open(path, framework="numpy") as file:
            wanted = [name for name in file.keys() if name.startswith(prefix)]  # noqa: SIM118
            arrays = {name[len(prefix) :]: file.get_tensor(name) for name in wanted}
            return file.metadata() or {}, arrays
    except (SafetensorError, OSError, UnicodeDecodeError) as error:
        raise PolicyError(
            f"{path} is damaged, or no safetensors file: {error}"
        ) from error


def _head(arrays: Mapping[str, np.ndarray], about: Mapping[str, Any]) -> dict[str, Any]:
    """What the metadata says of a policy."""
    sha256 = _fingerprint(arrays, about)
    return {"version": VERSION, "about": about, "sha256": sha256}


def _parsed(path: Path, text: str) -> dict[str, Any]:
    """An object of the metadata."""
    try:
        found = json.loads(text)
    except ValueError as error:
        raise _damaged(path) from error
    if not isinstance(found, dict):
        raise _damaged(path)
    return found


def _damaged(path: Path) -> PolicyError:
    return PolicyError(f"{path} is damaged: its content fails its checksum")


def _checked(path: Path, head: Any, arrays: dict[str, np.ndarray]) -> Policy:
    """The policy, if it is of this version and whole."""
    try:
        version, about, fingerprint = (head[k] for k in ("version", "about", "sha256"))
    except (KeyError, TypeError) as error:
        raise _damaged(path) from error
    if version != VERSION:
        raise PolicyError(
            f"{path} has version {version} of the format, this rmp_mjx reads "
            f"{VERSION}: install another version of rmp_mjx"
        )
    if fingerprint != _fingerprint(arrays, about):
        raise _damaged(path)
    return Policy(arrays, about)


def _named(tree: Any) -> dict[str, Any]:
    """Leaves of nested dictionaries by the names on their way, joined by slashes."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {"/".join(key.key for key in path): leaf for path, leaf in leaves}


def _fill(template: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """The arrays in the structure of the template."""
    wanted = {name: (leaf.shape, leaf.dtype) for name, leaf in _named(template).items()}
    found = {name: (array.shape, array.dtype) for name, array in arrays.items()}
    wrong = [
        f"{name}: {_show(found.get(name))} in the file, {_show(wanted.get(name))} "
        "for the environment"
        for name in sorted(wanted.keys() | found.keys())
        if wanted.get(name) != found.get(name)
    ]
    if wrong:
        more = f"; and {len(wrong) - 3} more" if len(wrong) > 3 else ""
        raise PolicyError(
            f"the policy does not fit the environment: {'; '.join(wrong[:3])}{more}"
        )
    return jax.tree.unflatten(
        jax.tree.structure(template), [arrays[name] for name in wanted]
    )


def _show(array: tuple[tuple[int, ...], Any] | None) -> str:
    return f"{array[1]}{list(array[0])}" if array else "nothing"


def _fingerprint(arrays: Mapping[str, np.ndarray], about: Mapping[str, Any]) -> str:
    """SHA-256 of a description, and of the arrays' names, shapes, types and bytes."""
    total = hashlib.sha256(json.dumps(about, sort_keys=True).encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        total.update(f"\n{name} {array.dtype} {list(array.shape)}\n".encode())
        total.update(array.tobytes())
    return total.hexdigest()

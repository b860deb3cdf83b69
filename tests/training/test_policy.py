"""A policy file: what is written is read, and what is not ours is refused."""

import dataclasses
import json
import struct

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.acme import running_statistics
from safetensors.numpy import load_file, save_file

from rmp_mjx.training import policy
from rmp_mjx.training.learning.networks import make_agent, make_networks
from rmp_mjx.training.policy import (
    PolicyError,
    load_policy,
    names,
    save_folder,
    save_policy,
)

OBS, ACT = 5, 3
ABOUT = {"config": {"task": "toy", "sizes": [7, 6]}, "iterations": 4}


@pytest.fixture(scope="module")
def agents():
    """The same parameters as two agents: the mean action, and samples."""
    networks = make_networks(OBS, ACT, (7, 6), -0.5)
    params = networks.policy_network.init(jax.random.key(0))
    leaves, structure = jax.tree.flatten(params)
    leaves = [x + 0.1 * jnp.cos(jnp.arange(x.size)).reshape(x.shape) for x in leaves]
    params = jax.tree.unflatten(structure, leaves)
    seen = running_statistics.init_state(jax.ShapeDtypeStruct((OBS,), jnp.float32))
    data = 3.0 * jax.random.normal(jax.random.key(1), (50, OBS)) + 1.0
    seen = running_statistics.update(seen, data)
    return {d: make_agent(networks, seen, params, d) for d in (True, False)}


@pytest.fixture
def file(agents, tmp_path):
    path = tmp_path / "toy.safetensors"
    save_policy(path, agents[True], ABOUT)
    return path


@pytest.mark.parametrize("deterministic", [True, False])
def test_a_policy_that_is_read_acts_bit_for_bit_as_the_one_written(
    agents, file, deterministic
):
    found = load_policy(file)
    obs, key = jax.random.normal(jax.random.key(2), (100, OBS)), jax.random.key(3)
    action = found.agent(OBS, ACT, deterministic)(obs, key)
    np.testing.assert_array_equal(action, agents[deterministic](obs, key))
    assert np.std(action, axis=0).min() > 0.0
    assert found.about == ABOUT


def test_what_was_read_is_written_to_the_same_bytes(file, tmp_path):
    found = load_policy(file)
    again = tmp_path / "again.safetensors"
    save_policy(again, found.agent(OBS, ACT, True), found.about)
    assert again.read_bytes() == file.read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == [again.name, file.name]


def test_policies_in_one_file_have_the_paths_of_a_folder(file):
    one = load_policy(file)
    other = dataclasses.replace(one, about={"iterations": 5})
    folder = file.parent / "kept"
    assert save_folder(folder, {"a": one, "b": other}) == file.parent / (
        "kept.safetensors"
    )
    assert names(folder) == ["a", "b"]
    for name, wanted in (("a", one), ("b", other)):
        found = load_policy(folder / f"{name}.safetensors")
        assert found.about == wanted.about
        jax.tree.map(np.testing.assert_array_equal, found.arrays, wanted.arrays)
    with pytest.raises(PolicyError, match="no such policy file"):
        load_policy(folder / "c.safetensors")
    with pytest.raises(PolicyError, match=r"it holds many: --run .*kept/NAME"):
        load_policy(file.parent / "kept.safetensors")
    folder.mkdir()
    save_policy(folder / "b.safetensors", one.agent(OBS, ACT, True), one.about)
    assert load_policy(folder / "b.safetensors").about == ABOUT  # an own file is first
    assert names(folder) == ["a", "b"]


def test_a_flipped_bit_in_a_file_of_many_is_refused(file):
    one = load_policy(file)
    packed = save_folder(file.parent / "kept", {"a": one})
    whole = packed.read_bytes()
    for place in range(0, len(whole), 7):
        damaged = bytearray(whole)
        damaged[place] ^= 1
        packed.write_bytes(damaged)
        with pytest.raises(PolicyError):
            load_policy(file.parent / "kept" / "a.safetensors")


def test_other_libraries_find_arrays_with_plain_names(file):
    arrays = load_file(file)
    assert arrays["normalizer/mean"].shape == (OBS,)
    assert arrays["policy/params/MLP_0/hidden_0/kernel"].shape == (OBS, 7)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(PolicyError, match="no such policy file"):
        load_policy(tmp_path / "nothing.safetensors")


@pytest.mark.parametrize("kept", [0, 4, 100, -1])
def test_an_empty_or_truncated_file_is_refused(file, kept):
    file.write_bytes(file.read_bytes()[:kept])
    with pytest.raises(PolicyError, match=r"toy\.safetensors is damaged, or no safe"):
        load_policy(file)


def test_text_is_refused(file):
    file.write_text("{'this': 'is no policy'}" * 20)
    with pytest.raises(PolicyError, match="is damaged, or no safetensors file"):
        load_policy(file)


@pytest.mark.parametrize("metadata", [None, {"format": "pt"}])
def test_another_safetensors_file_is_refused(file, metadata):
    save_file({"weight": np.zeros(3, np.float32)}, file, metadata)
    with pytest.raises(PolicyError, match="but no policy of rmp_mjx"):
        load_policy(file)


def test_a_flipped_bit_is_refused_wherever_it_is(file):
    whole = bytearray(file.read_bytes())
    for place in range(len(whole)):
        damaged = bytearray(whole)
        damaged[place] ^= 1
        file.write_bytes(damaged)
        with pytest.raises(PolicyError):
            load_policy(file)


def test_a_renamed_array_is_refused(file):
    arrays = load_file(file)
    arrays["normalizer/average"] = arrays.pop("normalizer/mean")
    save_file(arrays, file, _metadata(file))
    with pytest.raises(PolicyError, match="fails its checksum"):
        load_policy(file)


def test_a_newer_format_is_refused(agents, tmp_path, monkeypatch):
    path = tmp_path / "new.safetensors"
    monkeypatch.setattr(policy, "VERSION", 2)
    save_policy(path, agents[True], ABOUT)
    monkeypatch.undo()
    with pytest.raises(PolicyError, match="version 2 of the format, this rmp_mjx read"):
        load_policy(path)


@pytest.mark.parametrize(
    ("obs", "act", "message"),
    [
        (
            OBS + 1,
            ACT,
            r"0/kernel: float32\[5, 7\] in the file, float32\[6, 7\]",
        ),
        (OBS, ACT + 1, r"Dense_0/bias: float32\[3\] in the file, float32\[4\] for"),
    ],
)
def test_an_environment_of_other_sizes_is_refused(file, obs, act, message):
    with pytest.raises(PolicyError, match=message):
        load_policy(file).agent(obs, act, True)


def test_a_policy_with_an_array_too_few_or_too_many_is_refused(file):
    found = load_policy(file)
    fewer = {k: v for k, v in found.arrays.items() if k != "normalizer/std"}
    with pytest.raises(PolicyError, match="normalizer/std: nothing in the file"):
        dataclasses.replace(found, arrays=fewer).agent(OBS, ACT, True)
    more = found.arrays | {"extra": np.zeros(2, np.float32)}
    with pytest.raises(PolicyError, match=r"extra: float32\[2\] in the file, nothing"):
        dataclasses.replace(found, arrays=more).agent(OBS, ACT, True)


def _metadata(file):
    """The metadata of a safetensors file: JSON after the eight bytes of its length."""
    data = file.read_bytes()
    (length,) = struct.unpack("<Q", data[:8])
    return json.loads(data[8 : 8 + length])["__metadata__"]

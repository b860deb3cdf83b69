"""`jax.device_put_replicated`: there for the call alone, and what `jax.pmap` takes."""

import jax
import jax.numpy as jnp
import pytest

from rmp_mjx.training.brax.replicated import NAME, device_put_replicated


@pytest.fixture
def without(monkeypatch):
    """A JAX that does not have the function, as the locked one."""
    monkeypatch.delattr(jax, NAME, raising=False)


def test_it_is_there_inside_the_context_alone(without):
    with device_put_replicated():
        assert hasattr(jax, NAME)
    assert not hasattr(jax, NAME)


def test_it_is_gone_after_an_error_too(without):
    with pytest.raises(KeyError), device_put_replicated():
        raise KeyError
    assert not hasattr(jax, NAME)


def test_a_jax_that_has_it_keeps_its_own(monkeypatch):
    own = object()
    monkeypatch.setattr(jax, NAME, own, raising=False)
    with device_put_replicated():
        assert getattr(jax, NAME) is own
    assert getattr(jax, NAME) is own


def test_each_device_gets_a_copy_that_pmap_takes(without):
    devices = jax.local_devices()[:2]
    tree = {"a": jnp.arange(3.0), "b": 7}
    with device_put_replicated():
        copies = getattr(jax, NAME)(tree, devices)
    sums = jax.pmap(lambda t: t["a"].sum() + t["b"], devices=devices)(copies)
    assert sums.tolist() == [10.0] * len(devices)
    assert {s.device for s in copies["a"].addressable_shards} == set(devices)

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from rmp_mjx import runtime

USER_VARIABLES = ("XLA_FLAGS", "JAX_COMPILATION_CACHE_DIR", "MUJOCO_GL", "DISPLAY")


def run_python(code: str, **env: str) -> str:
    """Run code in a fresh interpreter without this test run's own settings."""
    clean = {k: v for k, v in os.environ.items() if k not in USER_VARIABLES}
    done = subprocess.run(
        [sys.executable, "-W", "always", "-c", textwrap.dedent(code)],
        env={**clean, **env},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_flags_are_appended_to_the_users_own():
    merged = runtime.merge_flags("--xla_a=1", ("--xla_b=2",))
    assert merged == "--xla_a=1 --xla_b=2"


def test_a_flag_that_the_user_set_is_never_overridden():
    mine = "--xla_cpu_use_fusion_emitters=true"
    merged = runtime.merge_flags(mine, ("--xla_cpu_use_fusion_emitters=false",))
    assert merged == mine


def test_merging_twice_changes_nothing():
    flags = runtime.cpu_xla_flags("0.10.2")
    once = runtime.merge_flags("", flags)
    assert runtime.merge_flags(once, flags) == once


@pytest.mark.parametrize("version", ["0.9.2", "0.11.1", "0.11.2", "0.12.0.1", "1.0.0"])
def test_releases_that_do_not_know_the_flags_get_none(version):
    assert runtime.cpu_xla_flags(version) == ()


@pytest.mark.parametrize("version", ["0.10.0", "0.10.2", "0.10.2.dev1", "0.11.0"])
def test_the_releases_that_need_the_flags_get_them(version):
    assert "--xla_cpu_use_fusion_emitters=false" in runtime.cpu_xla_flags(version)


DEVICES = """
    import jax
    from rmp_mjx import runtime
    runtime.configure(split_cpu={split}, compile_cache=False)
    print(jax.device_count(), runtime.usable_cores())
    """


def test_a_cpu_that_is_split_has_a_device_for_each_core():
    devices, cores = run_python(DEVICES.format(split=True)).split()
    assert devices == cores
    assert run_python(DEVICES.format(split=False)).split()[0] == "1"


@pytest.mark.parametrize(
    "name, value",
    [
        ("XLA_FLAGS", "--xla_force_host_platform_device_count=3"),
        ("JAX_NUM_CPU_DEVICES", "3"),
    ],
)
def test_the_users_number_of_cpu_devices_is_kept(name, value):
    assert run_python(DEVICES.format(split=True), **{name: value}).split()[0] == "3"


def test_the_installed_jax_accepts_its_flags_and_caches_programs(tmp_path):
    out = run_python(
        """
        from rmp_mjx import runtime
        first = runtime.configure()
        assert runtime.configure() == first, "not idempotent"
        import jax, os
        assert os.environ.get("XLA_FLAGS", "") == first.xla_flags
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        assert float(jax.jit(lambda x: x + 1)(1.0)) == 2.0
        assert runtime.configure() == first, "not idempotent after the start"
        print(first.cache_dir)
        """,
        XDG_CACHE_HOME=str(tmp_path),
    )
    assert Path(out) == tmp_path / "rmp_mjx" / "xla"
    assert any(Path(out).iterdir())


def test_the_users_cache_folder_wins_over_the_default(tmp_path):
    out = run_python(
        "from rmp_mjx import runtime; print(runtime.configure().cache_dir)",
        JAX_COMPILATION_CACHE_DIR=str(tmp_path / "mine"),
    )
    assert Path(out) == tmp_path / "mine"


def test_configuring_too_late_warns_that_the_flags_cannot_take_effect():
    if not runtime.cpu_xla_flags():
        return  # nothing to set on this line of jax, so nothing to warn about
    run_python(
        """
        import warnings
        import jax
        jax.devices()
        from rmp_mjx import runtime
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            assert "fusion" not in runtime.configure(compile_cache=False).xla_flags
        assert any("backend" in str(w.message) for w in caught), caught
        """
    )


def test_an_unwritable_cache_folder_warns_and_goes_on_without(tmp_path):
    blocker = tmp_path / "file"
    blocker.touch()
    with pytest.warns(RuntimeWarning, match="cannot be written"):
        assert runtime.configure(cache_dir=blocker / "xla").cache_dir is None


def test_the_users_rendering_backend_is_kept(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    assert runtime.choose_gl() == "osmesa"


@pytest.mark.parametrize(
    ("works", "expected"), [({"egl", "osmesa"}, "egl"), ({"osmesa"}, "osmesa")]
)
def test_the_first_rendering_backend_that_loads_is_chosen(monkeypatch, works, expected):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setenv("MUJOCO_GL", "")
    monkeypatch.setattr(runtime, "gl_loads", works.__contains__)
    monkeypatch.setattr(runtime, "_GL_CONTEXT_MODULES", ())
    assert runtime.choose_gl() == expected
    assert os.environ["MUJOCO_GL"] == expected


def test_no_rendering_backend_leaves_the_environment_alone(monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(runtime, "gl_loads", lambda name: False)
    assert runtime.choose_gl() is None
    assert "MUJOCO_GL" not in os.environ

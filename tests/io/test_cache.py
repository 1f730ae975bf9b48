"""Where costly things are kept; and that tests keep theirs apart."""

from pathlib import Path

from warp_neumat.io.cache import cache_folder


def test_tests_never_write_to_the_users_cache(tmp_path_factory):
    assert cache_folder().is_relative_to(tmp_path_factory.getbasetemp())


def test_the_folder_is_said_or_below_home(tmp_path, monkeypatch):
    monkeypatch.setenv("NEUMAT_CACHE", str(tmp_path / "said"))
    assert cache_folder() == tmp_path / "said"
    assert not cache_folder().exists()
    for unset in (lambda: monkeypatch.setenv("NEUMAT_CACHE", ""), lambda: monkeypatch.delenv("NEUMAT_CACHE")):
        unset()
        assert cache_folder() == Path.home() / ".cache" / "warp_neumat"

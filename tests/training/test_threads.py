"""Threads of torch inside a block, and what is put back."""

import pytest

torch = pytest.importorskip("torch")

from warp_neumat.training.threads import all_threads, torch_threads  # noqa: E402


def test_threads_are_put_back_whatever_happens():
    before = torch.get_num_threads()
    with torch_threads(before + 1):
        assert torch.get_num_threads() == before + 1
        with torch_threads(None):
            assert torch.get_num_threads() == before + 1
    assert torch.get_num_threads() == before
    with pytest.raises(KeyError), torch_threads(before + 1):
        raise KeyError
    assert torch.get_num_threads() == before
    with all_threads():
        assert torch.get_num_threads() >= 1
    assert torch.get_num_threads() == before

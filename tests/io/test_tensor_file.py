"""Tensor files: the layout byte by byte, a round trip, Mitsuba's own reader, and broken files."""

import struct

import numpy as np
import pytest

from warp_neumat.io.tensor_file import TYPES, read_tensors, write_tensors


@pytest.fixture
def arrays(rng):
    arrays = {
        f"field_{kind.strip('<')}": rng.integers(0, 100, (2, 3, number)).astype(kind) for number, kind in TYPES.items()
    }
    return {**arrays, "empty": np.zeros((0, 4), np.float32), "turned": np.arange(6.0).reshape(2, 3).T}


def test_round_trip(tmp_path, arrays):
    got = read_tensors(write_tensors(tmp_path / "a.bsdf", {**arrays, "description": "grün"}))
    assert bytes(got.pop("description")).decode() == "grün"
    assert set(got) == set(arrays)
    for name, value in arrays.items():
        assert got[name].dtype == value.dtype
        np.testing.assert_array_equal(got[name], value)


def test_a_file_written_by_hand(tmp_path):
    path = tmp_path / "hand.bsdf"
    header = (
        b"tensor_file\0"
        + struct.pack("<BBI", 1, 0, 1)
        + struct.pack("<H", 2)
        + b"xy"
        + struct.pack("<HBQQQ", 2, 10, 64, 2, 2)
    )
    path.write_bytes(header.ljust(64, b"\xee") + struct.pack("<4f", 1, 2, 3, 4))
    np.testing.assert_array_equal(read_tensors(path)["xy"], [[1, 2], [3, 4]])


def test_mitsuba_reads_and_writes_the_same(tmp_path, arrays):
    mi = pytest.importorskip("mitsuba", reason="the peer is not installed")
    mi.set_variant("scalar_rgb")
    arrays.pop("empty")
    theirs = mi.tensor_io.read(str(write_tensors(tmp_path / "ours.bsdf", arrays)))
    mi.tensor_io.write(str(tmp_path / "theirs.bsdf"), **arrays)
    ours = read_tensors(tmp_path / "theirs.bsdf")
    for name, value in arrays.items():
        np.testing.assert_array_equal(theirs[name], value)
        np.testing.assert_array_equal(ours[name], value)


def test_broken_files_are_explained(tmp_path):
    path = write_tensors(tmp_path / "a.bsdf", {"abc": np.arange(5, dtype=np.float32)})
    data = path.read_bytes()
    for content, message in (
        (b"", r"a\.bsdf: not a tensor file"),
        (b"PK" + data[2:], "not a tensor file"),
        (data[:12] + b"\2\0" + data[14:], "tensor file of version 2.0; only 1.0 is known"),
        (data[:20], "the header of the tensor file ends early"),
        (data[:-4], "field 'abc' ends beyond the file's"),
        (data.replace(b"abc", b"\xff\xfeb"), "a field's name is not text"),
        (data[:25] + b"\x4d" + data[26:], "field 'abc' has the unknown type 77"),
    ):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=message):
            read_tensors(path)
    with pytest.raises(ValueError, match="field 'flag' is bool"):
        write_tensors(tmp_path / "b.bsdf", {"flag": np.ones(3, bool)})

"""The container: what goes in comes out, and what is broken is refused with a reason."""

import json
import os
import struct

import numpy as np
import pytest
from safetensors.numpy import save_file

from warp_neumat.io.asset import FormatError, expect, pack_bits, read_asset, unpack_bits, write_asset

HEADER = {"kind": "neubrdf", "version": 1, "config": {"nside": 4, "name": "Grün"}}


@pytest.fixture
def tensors(rng):
    return {
        "weight": rng.normal(size=(5, 3)).astype(np.float16),
        "bits": rng.integers(0, 256, 17, dtype=np.uint8),
        "strided": rng.normal(size=(4, 6)).astype(np.float32)[:, ::2],
    }


def test_round_trip(tmp_path, tensors):
    path = tmp_path / "a.neumat"
    write_asset(path, tensors, HEADER)
    read, header = read_asset(path)
    assert header == HEADER
    assert read.keys() == tensors.keys()
    for name, value in tensors.items():
        assert read[name].dtype == value.dtype
        np.testing.assert_array_equal(read[name], value)
    assert os.listdir(tmp_path) == ["a.neumat"]


def test_same_content_same_bytes(tmp_path, tensors):
    for name in ("a", "b"):
        write_asset(tmp_path / f"{name}.neumat", tensors, HEADER)
    assert (tmp_path / "a.neumat").read_bytes() == (tmp_path / "b.neumat").read_bytes()


@pytest.mark.parametrize("keep", [0, 4, 60, -1])
def test_truncated_file_is_refused(tmp_path, tensors, keep):
    path = tmp_path / "a.neumat"
    write_asset(path, tensors, HEADER)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(
        FormatError, match=r"a\.neumat: file: truncated or no safetensors file .*; copy or fit it again"
    ):
        read_asset(path)


def test_other_files_are_refused(tmp_path, tensors):
    path = tmp_path / "a.neumat"
    path.write_bytes(b"\x89PNG\r\n" * 100)
    with pytest.raises(FormatError, match="no safetensors file"):
        read_asset(path)
    save_file({"x": np.zeros(3, np.float32)}, path)
    with pytest.raises(FormatError, match="neumat: missing in the metadata"):
        read_asset(path)
    save_file({"x": np.zeros(3, np.float32)}, path, metadata={"neumat": "{"})
    with pytest.raises(FormatError, match="neumat: header is not JSON"):
        read_asset(path)
    with pytest.raises(FileNotFoundError, match=r"b\.neumat: no such file"):
        read_asset(tmp_path / "b.neumat")


def test_tensor_type_unknown_to_numpy_is_refused(tmp_path):
    header = json.dumps(
        {
            "__metadata__": {"neumat": json.dumps(HEADER)},
            "x": {"dtype": "BF16", "shape": [2], "data_offsets": [0, 4]},
        }
    ).encode()
    path = tmp_path / "a.neumat"
    path.write_bytes(struct.pack("<Q", len(header)) + header + b"\0\0\0\0")
    with pytest.raises(FormatError, match=r"a\.neumat"):
        read_asset(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "nubrdf"}, "kind: 'nubrdf' is unknown; this release reads .*neubrdf"),
        ({"kind": None}, "kind: missing"),
        ({"version": 99}, "version: 99 of neubrdf is newer than .*; update warp-neumat"),
        ({"version": "1"}, "version: must be a whole number"),
    ],
)
def test_header_that_does_not_fit_is_refused(tmp_path, change, message):
    path = tmp_path / "a.neumat"
    metadata = {"neumat": json.dumps({**HEADER, **change})}
    save_file({"x": np.zeros(3, np.float32)}, path, metadata=metadata)
    with pytest.raises(FormatError, match=message):
        read_asset(path)
    with pytest.raises(FormatError, match=message):
        write_asset(tmp_path / "b.neumat", {}, {**HEADER, **change})


def test_values_that_are_not_finite_are_refused(tmp_path, tensors):
    tensors["weight"][2, 1] = np.inf
    write_asset(tmp_path / "a.neumat", tensors, HEADER)
    with pytest.raises(FormatError, match="weight: holds values that are not finite"):
        read_asset(tmp_path / "a.neumat")


def test_unwritable_place_is_an_os_error(tmp_path, tensors):
    with pytest.raises(FileNotFoundError, match="no folder"):
        write_asset(tmp_path / "missing" / "a.neumat", tensors, HEADER)
    (tmp_path / "folder.neumat").mkdir()
    with pytest.raises(OSError, match=r"folder\.neumat"):
        write_asset(tmp_path / "folder.neumat", tensors, HEADER)
    assert os.listdir(tmp_path) == ["folder.neumat"]


def test_expect_names_the_field(tmp_path, tensors):
    assert expect(tensors, "weight", "float16", (5, 3), "a") is tensors["weight"]
    for name, dtype, shape, message in (
        ("wieght", "float16", (5, 3), "a: wieght: missing"),
        ("weight", "float32", (5, 3), "a: weight: must be float32, got float16"),
        ("weight", "float16", (3, 5), r"a: weight: must have shape \(3, 5\), got \(5, 3\)"),
    ):
        with pytest.raises(FormatError, match=message):
            expect(tensors, name, dtype, shape, "a")


@pytest.mark.parametrize("bits", [1, 3, 8, 9, 12, 16])
def test_bits_round_trip(rng, bits):
    values = rng.integers(0, 1 << bits, 1001)
    packed = pack_bits(values, bits)
    assert packed.dtype == np.uint8
    assert packed.size == -(-1001 * bits // 8)
    np.testing.assert_array_equal(unpack_bits(packed, bits, 1001), values)


def test_bit_order_is_little_endian():
    # 9-bit values 0b1_0000_0001 and 0b0_0000_0011: the second starts in bit 1 of byte 1.
    np.testing.assert_array_equal(pack_bits([257, 3], 9), [0b0000_0001, 0b0000_0111, 0])


def test_bits_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match=r"values must lie in \[0, 7\]"):
        pack_bits([8], 3)
    with pytest.raises(ValueError, match="100 values of 9 bits need 113 bytes, got 112"):
        unpack_bits(np.zeros(112, np.uint8), 9, 100)

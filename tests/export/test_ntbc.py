"""The exported folder of an NTBC: its very blocks in DDS and KTX2, and a manifest from which maps can be read."""

import hashlib
import json
import os

import numpy as np
import pytest

from tests.block_oracles import bcdec
from tests.block_textures import assert_same
from tests.fake_assets import fake_bcf, fake_ntbc
from warp_neumat.export.ntbc import export_ntbc
from warp_neumat.io.asset import FormatError, read_asset, write_asset
from warp_neumat.io.block_formats import from_blocks
from warp_neumat.io.dds import read_dds
from warp_neumat.io.ktx2 import read_ktx2
from warp_neumat.materials.base import load

SHAPES = {"plain": {}, "bc7": {"textures": "bc7", "mode": "aggressive", "metric": "luma"}}


def export(asset, folder, **options):
    """Export and return (paths by name, manifest)."""
    paths = export_ntbc(asset, folder, **options)
    assert sorted(p.name for p in paths) == sorted(os.listdir(folder))
    return {p.name: p for p in paths}, json.loads(paths[-1].read_text(encoding="utf-8"))


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("format", "read"), [("dds", read_dds), ("ktx2", read_ktx2)])
def test_files_hold_exactly_the_materials_blocks(tmp_path, format, read, shape):
    fake_ntbc(tmp_path / "Stone 7.neumat", **SHAPES[shape])
    material = load(tmp_path / "Stone 7.neumat")
    paths, manifest = export(tmp_path / "Stone 7.neumat", tmp_path / "out", format=format)
    names = [texture["name"] for texture in material.config["textures"]]
    assert sorted(paths) == sorted([*(f"Stone 7_{name}.{format}" for name in names), "Stone 7.json"])
    for texture, entry in zip(material.textures, manifest["textures"], strict=True):
        content = paths[entry["file"]].read_bytes()
        assert entry["sha256"] == hashlib.sha256(content).hexdigest()
        assert entry["bytes"] == len(content)
        assert (entry["format"], entry["mips"]) == (texture.format, 7)
        assert_same(read(paths[entry["file"]]), texture)
        if format == "dds":
            assert content[148:] == b"".join(blocks.tobytes() for blocks in texture.levels[0])


def test_the_folder_alone_gives_the_maps(tmp_path):
    """Textures by an outside decoder and the manifest: no asset, no kernels."""
    fake_ntbc(tmp_path / "a.neumat", size=(36, 20), textures="bc7", mode="aggressive", metric="luma")
    paths, manifest = export(tmp_path / "a.neumat", tmp_path / "out")
    assert manifest["reference"] == {"width": 36, "height": 20}
    assert manifest["constants"] == {"specular": [0.5]}
    assert (manifest["kind"], manifest["version"], manifest["asset"]["kind"]) == ("neumat-export", 1, "ntbc")
    material = load(tmp_path / "a.neumat")
    assert manifest["asset"]["bytes"] == material.bytes
    u, v = np.meshgrid((np.arange(36) + 0.5) / 36, (np.arange(20) + 0.5) / 20)
    encoded = material.encoded(np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float32), 0.0)
    for k, channel in enumerate(manifest["channels"]):
        entry = manifest["textures"][channel["texture"]]
        blocks = read_dds(paths[entry["file"]]).levels[0][0]
        texels = bcdec(entry["format"].partition("_")[0], blocks.reshape(-1, blocks.shape[-1]))
        picture = from_blocks(texels, 36, 20)[..., "rgba".index(channel["texture_component"])]
        np.testing.assert_allclose(encoded[:, k].reshape(20, 36), picture / 255, atol=4e-6)


def test_outside_readers_take_the_files(tmp_path):
    import OpenImageIO as oiio

    fake_ntbc(tmp_path / "a.neumat")
    paths, manifest = export(tmp_path / "a.neumat", tmp_path / "out")
    for entry in manifest["textures"]:
        family = entry["format"].partition("_")[0]
        file = oiio.ImageInput.open(str(paths[entry["file"]]))
        assert file is not None, oiio.geterror()
        for mip, blocks in enumerate(read_dds(paths[entry["file"]]).levels[0]):
            assert file.seek_subimage(0, mip)
            count = min(3, file.spec().nchannels)
            picture = file.read_image(0, mip, 0, count, oiio.UINT8)
            ours = from_blocks(bcdec(family, blocks.reshape(-1, blocks.shape[-1])), 64 >> mip, 64 >> mip)[..., :count]
            # Its older bcdec rounds otherwise.
            assert np.abs(picture[..., : ours.shape[-1]].astype(int) - ours).max() <= 1
        assert not file.seek_subimage(0, entry["mips"])
        file.close()


def test_an_open_material_exports_the_same_bytes_as_its_file(tmp_path):
    fake_ntbc(tmp_path / "a.neumat")
    from_file, _ = export(tmp_path / "a.neumat", tmp_path / "a")
    from_material, _ = export(load(tmp_path / "a.neumat"), tmp_path / "b")
    for name, path in from_file.items():
        assert path.read_bytes() == from_material[name].read_bytes(), name


def test_what_cannot_be_exported_is_named(tmp_path):
    fake_bcf(tmp_path / "b.neumat")
    with pytest.raises(FormatError, match="kind: 'bcf' has no textures to export; give one of kind 'ntbc'"):
        export_ntbc(tmp_path / "b.neumat", tmp_path / "out")
    fake_ntbc(tmp_path / "a.neumat")
    with pytest.raises(ValueError, match="format must be one of dds, ktx2, got 'dsd'; did you mean 'dds'"):
        export_ntbc(tmp_path / "a.neumat", tmp_path / "out", format="dsd")
    tensors, header = read_asset(tmp_path / "a.neumat")
    del tensors["model1.texel.zero"]
    write_asset(tmp_path / "a.neumat", tensors, header)
    with pytest.raises(FormatError, match=r"model1\.texel\.zero: missing"):
        export_ntbc(tmp_path / "a.neumat", tmp_path / "out")
    assert not (tmp_path / "out").exists()

"""The exported folder: the asset's very blocks, weights where the manifest says, and a golden vector that holds."""

import hashlib
import json
import os
from pathlib import Path

import numpy as np
import pytest

from tests.fake_assets import fake_bcf, random_neubrdf
from warp_neumat.export.bcf import export_bcf
from warp_neumat.io.asset import FormatError, read_asset, write_asset
from warp_neumat.io.dds import read_dds
from warp_neumat.io.ktx2 import read_ktx2
from warp_neumat.materials.base import load
from warp_neumat.reference import bcf as reference

# Shapes of network and textures; few, as each compiles kernels of its own.
SHAPES = {
    "plain": {},
    "signed": {"signed": True, "wrap": "mirror", "features": (16, (8, 16), 4), "hidden": 13, "channels": 16},
    "odd sizes": {"wrap": "clamp", "size": (96, 40), "features": ((24, 10), (7, 5)), "channels": 3, "constants": {}},
}


@pytest.fixture
def asset(tmp_path) -> Path:
    path = tmp_path / "Bricks 097.neumat"
    fake_bcf(path)
    return path


def export(asset, folder, **options):
    """Export and return (paths by name, manifest)."""
    paths = export_bcf(asset, folder, **options)
    assert sorted(p.name for p in paths) == sorted(os.listdir(folder))
    return {p.name: p for p in paths}, json.loads(paths[-1].read_text(encoding="utf-8"))


def test_folder_holds_what_the_manifest_lists(asset, tmp_path):
    paths, manifest = export(asset, tmp_path / "deep" / "out")
    textures = [f"Bricks 097_features{n}.dds" for n in range(4)]
    sources = [f"Bricks 097{baked}.{language}" for language in ("glsl", "hlsl", "wgsl") for baked in ("", "_baked")]
    assert sorted(paths) == sorted([*textures, *sources, "Bricks 097_weights.bin", "Bricks 097.json"])
    listed = [*manifest["textures"], manifest["weights"], *manifest["shaders"]]
    assert len(listed) == len(paths) - 1
    for entry in listed:
        content = paths[entry["file"]].read_bytes()
        assert entry["bytes"] == len(content)
        assert entry["sha256"] == hashlib.sha256(content).hexdigest()
    assert [t["lod_bias"] for t in manifest["textures"]] == [-1, -2, -3, -4]
    assert manifest["constants"] == {"specular": [0.5]}
    assert manifest["prefix"] == "bcf_Bricks_097"
    assert "bcf_Bricks_097_sample_grad" in paths["Bricks 097.wgsl"].read_text()


@pytest.mark.parametrize("format", ["dds", "ktx2"])
@pytest.mark.parametrize("shape", ["plain", "signed"])
def test_files_hold_exactly_the_assets_blocks(tmp_path, format, shape):
    fake_bcf(tmp_path / "a.neumat", **SHAPES[shape])
    tensors, header = read_asset(tmp_path / "a.neumat")
    paths, manifest = export(tmp_path / "a.neumat", tmp_path / "out", format=format, shaders=())
    for n, (entry, about) in enumerate(zip(header["config"]["textures"], manifest["textures"], strict=True)):
        path = paths[f"a_features{n}.{format}"]
        texture = {"dds": read_dds, "ktx2": read_ktx2}[format](path)
        assert texture.format == about["format"] == ("bc6h_sf16" if shape == "signed" else "bc6h_uf16")
        assert (texture.width, texture.height, texture.mips) == (entry["width"], entry["height"], entry["mips"])
        blocks = b""
        for mip in range(entry["mips"]):
            np.testing.assert_array_equal(texture.levels[0][mip], tensors[f"texture{n}.mip{mip}"])
            blocks += tensors[f"texture{n}.mip{mip}"].tobytes()
        if format == "dds":
            assert path.read_bytes()[148:] == blocks


@pytest.mark.parametrize("shape", ["plain", "signed"])
def test_outside_readers_decode_the_same_texels(tmp_path, shape):
    imagecodecs = pytest.importorskip("imagecodecs")
    import OpenImageIO as oiio

    signed = shape == "signed"
    fake_bcf(tmp_path / "a.neumat", **SHAPES[shape])
    tensors, header = read_asset(tmp_path / "a.neumat")
    paths, _ = export(tmp_path / "a.neumat", tmp_path / "out", shaders=())
    for n, entry in enumerate(header["config"]["textures"]):
        path = paths[f"a_features{n}.dds"]
        if not signed:  # imagecodecs takes a signed file for an unsigned one
            whole = imagecodecs.dds_decode(path.read_bytes())
            np.testing.assert_array_equal(whole, decode(imagecodecs, tensors[f"texture{n}.mip0"], signed))
        file = oiio.ImageInput.open(str(path))
        assert file is not None, oiio.geterror()
        for mip in range(entry["mips"]):
            assert file.seek_subimage(0, mip)
            picture = file.read_image(0, mip, 0, 3, "half")
            expected = decode(imagecodecs, tensors[f"texture{n}.mip{mip}"], signed)
            np.testing.assert_array_equal(picture, expected[: picture.shape[0], : picture.shape[1]])
        assert not file.seek_subimage(0, entry["mips"])
        file.close()


def decode(imagecodecs, blocks, signed: bool) -> np.ndarray:
    """Return blocks (rows, columns, 16) decoded by bcdec, float16."""
    rows, columns = blocks.shape[:2]
    return imagecodecs.bcn_decode(blocks.tobytes(), -6 if signed else 6, shape=(4 * rows, 4 * columns, 3))


@pytest.mark.parametrize("shape", SHAPES)
def test_the_folder_alone_reproduces_the_golden_vector(tmp_path, shape):
    """Textures by an outside decoder, weights by the manifest's offsets, float64 reference: no asset, no kernels."""
    imagecodecs = pytest.importorskip("imagecodecs")
    fake_bcf(tmp_path / "a.neumat", **SHAPES[shape])
    paths, manifest = export(tmp_path / "a.neumat", tmp_path / "out", shaders="glsl")
    textures = []
    for entry in manifest["textures"]:
        texture = read_dds(paths[entry["file"]])
        mips = [decode(imagecodecs, blocks, entry["format"] == "bc6h_sf16") for blocks in texture.levels[0]]
        sizes = [texture.size(mip) for mip in range(texture.mips)]
        textures.append([mip[:h, :w].astype(np.float64) for mip, (w, h) in zip(mips, sizes, strict=True)])
    weights, file = {}, paths[manifest["weights"]["file"]].read_bytes()
    for tensor in manifest["weights"]["tensors"]:
        size, offset = tensor["shape"], tensor["offset"]
        rows = [np.frombuffer(file, "<f2", size[-1], offset + n * tensor.get("stride", 0)) for n in range(size[0])]
        weights[tensor["name"]] = np.array(rows) if len(size) == 2 else rows[0]
    config = manifest["reference"] | {key: manifest[key] for key in ("textures", "wrap", "channels", "constants")}
    golden = manifest["golden"]
    uv, lod = np.array(golden["uv"]), np.array(golden["lod"])

    features = reference.features(textures, config, uv, lod)
    np.testing.assert_allclose(golden["features"], features, rtol=1e-7, atol=1e-7 * np.abs(features).max())
    pairs = [weights["weight0"], weights["weight1"]], [weights["bias0"], weights["bias1"]]
    outputs = reference.encoded(textures, *pairs, config, uv, lod)
    np.testing.assert_allclose(golden["outputs"], outputs, atol=1e-5)
    maps = reference.maps(np.array(golden["outputs"]), config)
    assert maps.keys() == golden["maps"].keys()
    assert [[m["name"], m["components"]] for m in manifest["maps"]] == [[n, v.shape[1]] for n, v in maps.items()]
    for name, value in maps.items():
        np.testing.assert_allclose(golden["maps"][name], value, atol=1e-5)
    if shape == "plain":
        assert golden["exact"] == [True] * 5 + [False] * 5


def test_an_open_material_exports_the_same_bytes_as_its_file(asset, tmp_path):
    from_file, _ = export(asset, tmp_path / "a")
    from_material, _ = export(load(asset), tmp_path / "b")
    assert from_file.keys() == from_material.keys()
    for name, path in from_file.items():
        assert path.read_bytes() == from_material[name].read_bytes(), name


def test_any_file_name_gives_valid_source(tmp_path):
    fake_bcf(tmp_path / "2 Größen 影\\.neumat")
    paths, manifest = export(tmp_path / "2 Größen 影\\.neumat", tmp_path / "out")
    assert manifest["name"] == "2 Größen 影\\"
    assert manifest["prefix"] == "bcf_2_Gr_en"
    for entry in manifest["shaders"]:
        text = paths[entry["file"]].read_text(encoding="ascii")
        assert '"2 Gr??en ??"' in text


def test_files_are_replaced_and_others_left_alone(asset, tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "Bricks 097.json").write_text("old")
    (folder / "notes.txt").write_text("mine")
    export_bcf(asset, folder, shaders=["wgsl"])
    assert json.loads((folder / "Bricks 097.json").read_text())["version"] == 1
    assert (folder / "notes.txt").read_text() == "mine"
    assert not [name for name in os.listdir(folder) if name.startswith(".")]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"format": "dsd"}, "format must be one of dds, ktx2, got 'dsd'; did you mean 'dds'?"),
        ({"format": "png"}, "format must be one of dds, ktx2, got 'png'"),
        ({"shaders": ("GLSL",)}, "shaders must be one of glsl, hlsl, wgsl, got 'GLSL'; did you mean 'glsl'?"),
        ({"shaders": "metal"}, "shaders must be one of glsl, hlsl, wgsl, got 'metal'"),
    ],
)
def test_unknown_names_are_refused_before_anything_is_written(asset, tmp_path, options, message):
    with pytest.raises(ValueError) as error:  # noqa: PT011 (the whole text is compared)
        export_bcf(asset, tmp_path / "out", **options)
    assert str(error.value) == message
    assert not (tmp_path / "out").exists()


def test_other_kinds_and_broken_assets_are_refused(tmp_path, rng):
    write_asset(tmp_path / "a.neumat", *random_neubrdf(rng))
    for source in (tmp_path / "a.neumat", load(tmp_path / "a.neumat")):
        with pytest.raises(FormatError, match="kind: 'neubrdf' has no textures to export; give one of kind 'bcf'"):
            export_bcf(source, tmp_path / "out")
    fake_bcf(tmp_path / "b.neumat")
    tensors, header = read_asset(tmp_path / "b.neumat")
    del tensors["texture2.mip1"]
    write_asset(tmp_path / "b.neumat", tensors, header)
    with pytest.raises(FormatError, match=r"texture2\.mip1: missing"):
        export_bcf(tmp_path / "b.neumat", tmp_path / "out")
    with pytest.raises(FileNotFoundError, match=r"c\.neumat: no such file"):
        export_bcf(tmp_path / "c.neumat", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_written_is_one_line(asset, tmp_path, monkeypatch):
    with pytest.raises(OSError, match="is a file; give another folder"):
        export_bcf(asset, asset)
    with pytest.raises(OSError, match="give another folder") as error:
        export_bcf(asset, asset / "out")
    assert "\n" not in str(error.value)
    folder = tmp_path / "shut"
    folder.mkdir()
    allowed = os.access  # root may write anywhere, so the test does not rely on chmod
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != folder and allowed(path, mode))
    with pytest.raises(PermissionError, match="the folder .*shut is read-only; choose another one"):
        export_bcf(asset, folder)
    assert os.listdir(folder) == []

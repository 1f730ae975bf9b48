"""Maps written to files: values by hand, sizes and levels, files of the right kind, and back through the reader."""

import numpy as np
import pytest

from warp_neumat.io.image import read_image
from warp_neumat.io.texture_set import open_texture_set
from warp_neumat.pipeline import decode_maps as module
from warp_neumat.pipeline.decode_maps import decode_maps, decode_size, write_maps


def channel(map, component="value", encoding="linear", range=(0.0, 1.0)):
    return {"map": map, "component": component, "encoding": encoding, "range": list(range)}


class Ramps:
    """A material whose maps are ramps along u and v."""

    def __init__(self, width=16, height=8, constants=None):
        self.header = {"config": {"width": width, "height": height}}
        self.channels = [
            *(channel("base_color", c, "srgb") for c in "rgb"),
            *(channel("normal", c, "normal") for c in "xy"),
            channel("roughness"),
            channel("displacement", range=(-1.0, 3.0)),
        ]
        self.constants = constants or {"metallic": np.float32([0.25]), "emissive": np.float32([0.1, 0.2, 4.0])}
        self.lods = []

    def maps(self, uv, lod):
        self.lods.append(lod)
        u, v = uv[:, :1], uv[:, 1:]
        xy = np.concatenate([0.6 * u - 0.3, 0.4 * v], axis=1)
        return {
            "base_color": np.concatenate([u, v, u * v], axis=1),
            "normal": np.concatenate([xy, np.sqrt(1 - (xy**2).sum(axis=1, keepdims=True))], axis=1),
            "roughness": 0.2 + 0.6 * u,
            "displacement": 4 * v - 1,
            **{name: np.broadcast_to(value, (len(uv), len(value))) for name, value in self.constants.items()},
        }


def test_pictures_are_sampled_at_texel_centres_in_any_chunk(monkeypatch):
    whole = decode_maps(Ramps())
    assert {name: picture.shape for name, picture in whole.items()} == {
        "base_color": (8, 16, 3),
        "normal": (8, 16, 3),
        "roughness": (8, 16, 1),
        "displacement": (8, 16, 1),
        "metallic": (8, 16, 1),
        "emissive": (8, 16, 3),
    }
    np.testing.assert_allclose(whole["base_color"][2, :, 0], (np.arange(16) + 0.5) / 16, rtol=1e-6)
    np.testing.assert_allclose(whole["displacement"][:, 3, 0], 4 * (np.arange(8) + 0.5) / 8 - 1, rtol=1e-6)
    monkeypatch.setattr(module, "_CHUNK", 48)
    for name, picture in decode_maps(Ramps()).items():
        np.testing.assert_array_equal(picture, whole[name])


@pytest.mark.parametrize(
    ("size", "lod", "expected"),
    [
        (None, None, ((16, 8), 0.0)),
        (None, 1.0, ((8, 4), 1.0)),
        (None, 2.5, ((4, 2), 2.5)),
        (None, 9, ((1, 1), 9.0)),
        ((4, 2), None, ((4, 2), 2.0)),
        ((4, 8), None, ((4, 8), 2.0)),  # the longer way to go decides, as in Eq. 11
        ((64, 64), None, ((64, 64), 0.0)),
        ((64, 32), 1, ((64, 32), 1.0)),
    ],
)
def test_size_and_level_follow_from_each_other(size, lod, expected):
    material = Ramps()
    assert decode_size(material, size, lod) == expected
    pictures = decode_maps(material, size, lod)
    assert pictures["roughness"].shape[:2] == expected[0][::-1]
    assert set(material.lods) == {expected[1]}


def test_what_cannot_be_is_named(tmp_path):
    with pytest.raises(ValueError, match="size must be at least 1x1, got 0x4"):
        decode_maps(Ramps(), (0, 4))
    with pytest.raises(ValueError, match="lod must be between 0 .* got -1"):
        decode_maps(Ramps(), lod=-1)
    with pytest.raises(ValueError, match="bits must be 8 or 16, got 12"):
        write_maps(tmp_path, Ramps(), bits=12)


@pytest.mark.parametrize("bits", [8, 16])
def test_files_hold_the_maps(tmp_path, bits):
    material, folder = Ramps(), tmp_path / "new" / "folder"
    paths = write_maps(folder, material, bits=bits)
    names = ["base_color.png", "normal_gl.png", "roughness.png", "displacement.exr", "metallic.png", "emissive.exr"]
    assert [path.name for path in paths] == names
    assert sorted(path.name for path in folder.iterdir()) == sorted(names)
    maps, step = decode_maps(material), 0.501 / (2**bits - 1)
    read = {path.stem: read_image(path) for path in paths}
    assert {read[n][1].dtype for n in ("base_color", "normal_gl", "roughness")} == {f"uint{bits}"}
    assert read["displacement"][1].dtype == "float"
    u = (np.arange(16) + 0.5) / 16
    srgb = np.where(u <= 0.0031308, 12.92 * u, 1.055 * u ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(read["base_color"][0][0, :, 0], srgb, atol=step)
    np.testing.assert_allclose(read["normal_gl"][0], 0.5 + 0.5 * maps["normal"], atol=step)
    np.testing.assert_allclose(read["roughness"][0], maps["roughness"], atol=step)
    np.testing.assert_allclose(read["metallic"][0], np.full((8, 16, 1), 0.25), atol=step)
    np.testing.assert_array_equal(read["displacement"][0], maps["displacement"])
    np.testing.assert_array_equal(read["emissive"][0], maps["emissive"])


def test_the_folder_opens_as_a_source_again(tmp_path):
    material = Ramps(constants={"metallic": np.float32([0.25])})
    material.channels[-1]["range"] = [0.0, 1.0]
    inner = material.maps
    material.maps = lambda uv, lod: {**inner(uv, lod), "displacement": uv[:, 1:]}
    write_maps(tmp_path, material, bits=16)
    opened = open_texture_set(tmp_path)
    assert (opened.width, opened.height) == (16, 8)
    maps = decode_maps(material)
    found = {}
    for k, channel in enumerate(opened.channels):
        found.setdefault(channel.map, []).append(opened.pixels[..., k])
    assert set(found) == {"base_color", "normal", "roughness", "displacement"}
    np.testing.assert_allclose(found["roughness"][0], maps["roughness"][..., 0], atol=1e-4)
    np.testing.assert_allclose(np.stack(found["normal"], -1), 0.5 + 0.5 * maps["normal"][..., :2], atol=1e-4)
    assert opened.constants["metallic"] == pytest.approx((0.25,), abs=1e-4)

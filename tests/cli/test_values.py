"""Arguments as people write them, and what is read from them."""

import pytest

from warp_neumat.cli.common import Usage
from warp_neumat.cli.values import (
    one_of,
    parse_crop,
    parse_features,
    parse_options,
    parse_overrides,
    parse_set_size,
    parse_size,
)


def test_sizes_crops_and_features():
    assert parse_size("640x360") == (640, 360)
    assert parse_set_size("512") == 512
    assert parse_set_size("512X256") == (512, 256)
    assert parse_crop("0, 8,512,256") == (0, 8, 512, 256)
    assert parse_features("256,128,64,32") == (256, 128, 64, 32)


@pytest.mark.parametrize("text", ["", "x", "4x", "x4", "4x4x4", "-4x4", "4.5x4", "0x4", "²x4", "99999x4", "4,4"])
def test_what_is_no_size(text):
    for parse in (parse_size, parse_set_size):
        with pytest.raises(Usage, match="--size must be"):
            parse(text)


def test_options_become_numbers_truths_lists_and_texts():
    found = parse_options(["rounds=2", "qat=false", "feature-range=0.5,2", "wrap=clamp", "mip_decay=1e-1", "a=[1]"], ())
    assert found == {
        "rounds": 2, "qat": False, "feature_range": (0.5, 2), "wrap": "clamp", "mip_decay": 0.1, "a": (1,),
    }  # fmt: skip


def test_overrides_gather_by_map():
    found = parse_overrides(
        [
            "normal.orientation=dx", "roughness.file=a=b.png", "roughness.channel=g", "roughness.invert=true",
            "ids.channel=0,2", "metallic=0", "base_color=0.1,0.2,0.3", "mask=none", "height.replace_nan=0",
            "sheen.constant=0.25",
        ]
    )  # fmt: skip
    assert found == {
        "normal": {"orientation": "dx"},
        "roughness": {"file": "a=b.png", "channel": "g", "invert": True},
        "ids": {"channel": [0, 2]},
        "metallic": [0.0],
        "base_color": [0.1, 0.2, 0.3],
        "mask": None,
        "height": {"replace_nan": 0.0},
        "sheen": {"constant": 0.25},
    }


def test_one_of_names_the_nearest():
    assert one_of("--format", "dds", ("dds", "ktx2")) == "dds"
    with pytest.raises(Usage, match="--format must be one of dds, ktx2, got 'KTX'; nearest: ktx2"):
        one_of("--format", "KTX", ("dds", "ktx2"))
    with pytest.raises(Usage, match="got 'png'$"):
        one_of("--format", "png", ("dds", "ktx2"))

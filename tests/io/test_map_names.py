"""Maps from file names: every naming scheme in use, and the words that only look like one."""

import pytest

from warp_neumat.io.map_names import read_names


def read(*names, channels=3):
    """{name: "map" or "map:channels …", with a "!" where inverted and "@gl" for an orientation}."""
    counts = channels if isinstance(channels, list) else [channels] * len(names)
    result = {}
    for name, claims in zip(names, read_names(list(names), counts), strict=True):
        words = []
        for claim in claims:
            word = claim.map + (f":{claim.channels}" if claim.channels else "") + ("!" if claim.invert else "")
            words.append(word + (f"@{claim.orientation}" if claim.orientation else ""))
        result[name] = " ".join(words)
    return result


ORM = "occlusion:r roughness:g metallic:b"

SCHEMES = {
    "ambientCG": {
        "Tiles074_2K-JPG_Color": "base_color",
        "Tiles074_2K-JPG_NormalGL": "normal@gl",
        "Tiles074_2K-JPG_NormalDX": "normal@dx",
        "Tiles074_2K-JPG_Roughness": "roughness",
        "Tiles074_2K-JPG_Metalness": "metallic",
        "Tiles074_2K-JPG_AmbientOcclusion": "occlusion",
        "Tiles074_2K-JPG_Displacement": "displacement",
        "Tiles074_2K-JPG_Opacity": "opacity",
        "Tiles074_2K-JPG_Emission": "emissive",
    },
    "Poly Haven": {
        "rusty_metal_02_diff_4k": "base_color",
        "rusty_metal_02_nor_gl_4k": "normal@gl",
        "rusty_metal_02_nor_dx_4k": "normal@dx",
        "rusty_metal_02_rough_4k": "roughness",
        "rusty_metal_02_metal_4k": "metallic",
        "rusty_metal_02_ao_4k": "occlusion",
        "rusty_metal_02_arm_4k": ORM,
        "rusty_metal_02_disp_4k": "displacement",
        "rusty_metal_02_spec_4k": "specular",
        "rusty_metal_02_mask_4k": "mask",
        "rusty_metal_02_translucent_4k": "translucency",
    },
    "glTF": {
        "Helmet_baseColor": "base_color",
        "Helmet_normal": "normal",
        "Helmet_metallicRoughness": "roughness:g metallic:b",
        "Helmet_occlusion": "occlusion",
        "Helmet_emissive": "emissive",
    },
    "glTF exporters": {
        "FlightHelmet_Materials_LensesMat_BaseColor": "base_color",
        "FlightHelmet_Materials_LensesMat_Normal": "normal",
        "FlightHelmet_Materials_LensesMat_OcclusionRoughMetal": ORM,
    },
    "Substance": {
        "wall_DefaultMaterial_BaseColor": "base_color",
        "wall_DefaultMaterial_Normal_OpenGL": "normal@gl",
        "wall_DefaultMaterial_Normal_DirectX": "normal@dx",
        "wall_DefaultMaterial_OcclusionRoughnessMetallic": ORM,
        "wall_DefaultMaterial_Height": "displacement",
        "wall_DefaultMaterial_Glossiness": "roughness!",
        "wall_DefaultMaterial_Scattering": "scattering",
        "wall_DefaultMaterial_Emissive": "emissive",
    },
    "Quixel": {
        "tkynejer_2K_Albedo": "base_color",
        "tkynejer_2K_Normal": "normal",
        "tkynejer_2K_Gloss": "roughness!",
        "tkynejer_2K_Specular": "specular",
        "tkynejer_2K_Cavity": "cavity",
        "tkynejer_2K_Bump": "bump",
        "tkynejer_2K_Fuzz": "fuzz",
    },
    "Unreal": {
        "T_Metal_D": "base_color",
        "T_Metal_N": "normal",
        "T_Metal_ORM": ORM,
        "T_Metal_E": "emissive",
        "T_Metal_BC": "base_color",
    },
    "engine letters": {"rock_wall_d": "base_color", "rock_wall_n": "normal", "rock_wall_ao": "occlusion"},
    "packed": {
        "crate_RMA": "roughness:r metallic:g occlusion:b",
        "crate_MRAO": "metallic:r roughness:g occlusion:b",
        "crate_orm": ORM,
        "crate_ARM": ORM,
        "crate_occlusionroughnessmetallic": ORM,
        "crate_metallic_roughness": "roughness:g metallic:b",
        "crate_ao_roughness_metallic": ORM,
        "crate_ORDp": "occlusion:r roughness:g displacement:b",
    },
    "MaterialX": {
        "castle_white_base_color": "base_color",
        "castle_shared_metallic": "metallic",
        "castle_shared_normal": "normal",
        "castle_shared_roughness": "roughness",
    },
    "masks": {
        "brick_base_gray": "base_color",
        "brick_dirt_mask": "mask_dirt",
        "brick_mask": "mask",
        "brick_variation_mask": "mask_variation",
        "brick_normal": "normal",
    },
    "layers": {
        "car_base_color": "base_color",
        "car_clearcoat": "clearcoat",
        "car_clearcoat_roughness": "clearcoat_roughness",
        "car_ClearcoatNormal": "clearcoat_normal",
        "car_transmission": "transmission",
        "car_sheenColor": "sheen_color",
        "car_emissive_color": "emissive",
    },
    "joined words": {
        "floor_tiles_bumpmap": "bump",
        "floor_tiles_normalmap": "normal",
        "floor_tiles_basecolor": "base_color",
        "floor_tiles_roughnessMap": "roughness",
        "floor_tiles_AOMap": "occlusion",
        "floor_tiles_ambientocclusion": "occlusion",
    },
    "blanks and dots": {
        "Old Wood.Base Color.4096": "base_color",
        "Old Wood.Normal.4096": "normal",
        "Old Wood.Roughness4K.png": "roughness",
    },
    "no slug": {"color": "base_color", "normal": "normal", "roughness": "roughness", "ao": "occlusion"},
}


@pytest.mark.parametrize("scheme", SCHEMES)
def test_scheme_is_read(scheme):
    expected = SCHEMES[scheme]
    assert read(*expected) == expected


@pytest.mark.parametrize("name", sorted({name for scheme in SCHEMES.values() for name in scheme}))
def test_a_single_picture_is_read_as_within_its_set(name):
    expected = next(s[name] for s in SCHEMES.values() if name in s)
    if expected.startswith("mask"):
        assert read(name)[name].startswith("mask")
    else:
        assert read(name)[name] == expected


@pytest.mark.parametrize(
    "slug", ["charm", "chaos", "warm", "harmony", "aorta", "format", "normandy", "colorado", "spectrum"]
)
def test_parts_of_words_say_nothing(slug):
    names = read(f"{slug}_01", f"{slug}_normal", f"{slug}_roughness")
    assert names[f"{slug}_normal"] == "normal"
    assert names[f"{slug}_roughness"] == "roughness"
    assert names[f"{slug}_01"] == "map_01"
    assert read(slug)[slug] == slug


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["metal_plate_diff", "metal_plate_rust"], ["base_color", "rust"]),  # metal is the slug's
        (["rusty_metal_rough", "rusty_metal_diff"], ["roughness", "base_color"]),  # and no packed metal_rough
        (["robot_arm_color", "robot_arm_normal"], ["base_color", "normal"]),
        (["table_base_color", "table_base_normal"], ["base_color", "normal"]),  # base belongs to both
        (["normal_wood_color", "normal_wood_rough"], ["base_color", "roughness"]),
        (["floor_tiles", "floor_tiles_normalmap"], ["base_color", "normal"]),  # the stem that the other shares
        (["Metal032_1K-JPG", "Metal032_1K-JPG_Color"], ["metal_032", "base_color"]),  # a preview beside its set
        (["normal_a", "normal_b"], ["normal", "normal"]),  # a conflict, not a slug
        (["roughness", "roughness_2"], ["roughness", "roughness"]),
        (["wall_color_mask", "wall_color"], ["mask_color", "base_color"]),
        (["vitaminD", "vitaminN"], ["vitamin_d", "vitamin_n"]),  # letters count after a separator only
        (["d", "n"], ["d", "n"]),
    ],
)
def test_slugs_are_no_maps(names, expected):
    assert list(read(*names).values()) == expected


def test_a_one_channel_picture_is_not_packed():
    assert read("robot_arm", channels=1)["robot_arm"] == "robot_arm"
    assert read("x_orm", channels=1)["x_orm"] == "x_orm"


def test_unity_packings_need_their_alpha():
    assert read("a_MetallicSmoothness", channels=4)["a_MetallicSmoothness"] == "metallic:r roughness:a!"
    assert read("a_AlbedoTransparency", channels=4)["a_AlbedoTransparency"] == "base_color:rgb opacity:a"
    assert read("a_MaskMap", channels=4)["a_MaskMap"] == "metallic:r occlusion:g roughness:a!"
    assert read("a_MaskMap", channels=1)["a_MaskMap"].startswith("mask")


def test_previews_and_unknown_names_say_so():
    (preview,), (unknown,), _ = read_names(["oak_preview", "oak_lichen", "oak_color"], [3, 3, 3])
    assert preview.how == "preview"
    assert (unknown.how, unknown.map) == ("extra", "lichen")


def test_two_pictures_without_a_word_are_both_kept():
    """Only one picture can be the base colour for its stem; with two, neither is guessed."""
    assert read("oak_1k", "oak_2k", "oak_normal") == {"oak_1k": "oak", "oak_2k": "oak", "oak_normal": "normal"}

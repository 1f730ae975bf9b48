"""What a picture in a folder of PBR maps is, read from its file name.

A name is cut into words at ``_``, ``-``, ``.``, blanks, and where camel case or digits begin, and only whole words or
runs of whole words count: ``charm_normal``, ``chaos`` and ``warm`` say nothing about ambient occlusion or a packed ARM
map. Resolutions (``2K``, ``4096``), formats (``JPG``, ``16bit``) and the slug that files share are skipped; of what is
left, the phrase that ends last counts, and of those the longest.

Known schemes: ambientCG (``ID_2K-JPG_NormalGL``), Poly Haven (``slug_nor_gl_2k``, ``slug_arm_4k``), glTF exporters
(``baseColor``, ``occlusionRoughnessMetallic``), Substance (``_BaseColor``, ``_OcclusionRoughnessMetallic``), Quixel
(``_Albedo``, ``_Gloss``, ``_Cavity``), Unreal (``T_Name_N``, ``T_Name_ORM``), Unity (``_MetallicSmoothness``,
``_MaskMap``), MaterialX (``_base_color``, ``_shared_metallic``, ``_dirt_mask``).
"""

from __future__ import annotations

import dataclasses
import itertools
import re


@dataclasses.dataclass(frozen=True)
class MapKind:
    """What is known of a map: its shape and its usual transfer function.

    ``form`` is ``color`` (three channels, or one where the picture is grey throughout), ``scalar`` (one channel),
    ``normal`` (x and y) or ``any`` (as many as the picture has, one where it is grey); ``srgb`` says that 8-bit
    pictures of it are sRGB-encoded.
    """

    form: str
    srgb: bool = False


KINDS: dict[str, MapKind] = {
    "base_color": MapKind("color", srgb=True),
    "normal": MapKind("normal"),
    "roughness": MapKind("scalar"),
    "metallic": MapKind("scalar"),
    "occlusion": MapKind("scalar"),
    "displacement": MapKind("scalar"),
    "opacity": MapKind("scalar"),
    "emissive": MapKind("color", srgb=True),
    "specular": MapKind("any"),
    "transmission": MapKind("any"),
    "scattering": MapKind("any"),
    "translucency": MapKind("any"),
    "clearcoat": MapKind("scalar"),
    "clearcoat_roughness": MapKind("scalar"),
    "clearcoat_normal": MapKind("normal"),
    "sheen_color": MapKind("any"),
    "sheen_roughness": MapKind("scalar"),
    "anisotropy": MapKind("any"),
    "anisotropy_rotation": MapKind("scalar"),
    "thickness": MapKind("scalar"),
    "cavity": MapKind("scalar"),
    "curvature": MapKind("scalar"),
    "fuzz": MapKind("any"),
    "bump": MapKind("scalar"),
    "mask": MapKind("any"),
}
"""Maps with a known meaning, in the order in which a set lists them."""

EXTRA = MapKind("any")
"""The kind of a map with any other name: linear, as many channels as the picture has."""

# Phrases by map. A phrase matches its words one by one and written together; "gloss" and "bump" are settled by what
# else the set holds.
_PHRASES = {
    "base_color": "base color,base colour,base col,base gray,base grey,base,bc,albedo,albedo color,alb,diffuse,"
    "diffuse color,diffuse albedo,diff,dif,color,colour,col",
    "normal": "normal,normals,norm,nor,nrm,nml,normal tangent,tangent normal",
    "roughness": "roughness,rough,rgh,specular roughness,base roughness",
    "gloss": "gloss,glossiness,glossy,smoothness,gls",
    "metallic": "metallic,metalness,metallness,metal,met,base metalness",
    "occlusion": "ambient occlusion,occlusion,ao,occ,mixed ao",
    "displacement": "displacement,displace,disp,height,height field,parallax",
    "bump": "bump",
    "opacity": "opacity,alpha,cutout,opacity mask,alpha mask,transparency",
    "emissive": "emissive,emission,emit,emis,glow,self illumination,emissive color,emission color",
    "specular": "specular,spec,specular color,specular colour,specular level,specular f0,reflectance",
    "transmission": "transmission,transmissive,transmission color,transmission weight",
    "scattering": "scattering,scatter,sss,subsurface,subsurface scattering,subsurface color,scattering color",
    "translucency": "translucency,translucent",
    "clearcoat": "clearcoat,clear coat,coat,coat weight",
    "clearcoat_roughness": "clearcoat roughness,clear coat roughness,coat roughness,coat rough",
    "clearcoat_normal": "clearcoat normal,clear coat normal,coat normal",
    "sheen_color": "sheen,sheen color,sheen colour",
    "sheen_roughness": "sheen roughness",
    "anisotropy": "anisotropy,anisotropic,aniso,anisotropy level",
    "anisotropy_rotation": "anisotropy rotation,anisotropy angle,anisotropic rotation",
    "thickness": "thickness",
    "cavity": "cavity",
    "curvature": "curvature",
    "fuzz": "fuzz",
    "mask": "mask,masks",
}
_ORIENTATIONS = {"gl": "gl,ogl,opengl", "dx": "dx,directx,d3d"}
_LETTERS = {
    "n": "normal",
    "d": "base_color",
    "r": "roughness",
    "m": "metallic",
    "e": "emissive",
    "h": "displacement",
    "s": "specular",
}

_RESOLUTION = re.compile(r"\d{1,2}k|\d{2,5}x\d{2,5}|64|128|256|512|1024|2048|4096|8192|16384|\d{2,5}px", re.IGNORECASE)
_FORMAT = re.compile(r"jpe?g|png|exr|tiff?|tga|bmp|hdr|webp|(8|16|32)bits?|bits?|srgb|udim|lod\d*", re.IGNORECASE)
_PIECE = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[^\W\d_a-zA-Z]+|\d+")
_PREVIEW = {"preview", "thumb", "thumbnail", "thumbs", "screenshot", "swatch", "icon", "render", "rendered"}


@dataclasses.dataclass(frozen=True)
class Claim:
    """One map that a picture's name claims.

    ``channels`` are the letters of the channels it takes (None: all that the map's kind wants), ``needs`` how many
    channels the picture must have for it, ``how`` what the name rests on: ``name``, ``letter``, ``packed``, ``stem``
    (no word, but the stem that the others share), ``extra`` (an unknown name) or ``preview`` (to be ignored).
    """

    map: str
    channels: str | None = None
    orientation: str | None = None
    invert: bool = False
    how: str = "name"
    needs: int = 1


def kind_of(name: str) -> MapKind:
    """Return what is known of the map ``name``; masks and unknown names are extra maps."""
    return KINDS.get(name, EXTRA)


# --- tables -----------------------------------------------------------------------------------------------------------


def _build_phrases() -> dict[str, tuple[str, str | None]]:
    """Return {words written together: (map, orientation)}."""
    table: dict[str, tuple[str, str | None]] = {}
    for name, text in _PHRASES.items():
        for phrase in text.split(","):
            table[phrase.replace(" ", "")] = (name, None)
    for phrase in _PHRASES["normal"].split(","):
        joined = phrase.replace(" ", "")
        for orientation, words in _ORIENTATIONS.items():
            for word in words.split(","):
                for text in (joined + word, joined + "map" + word, word + joined):
                    table[text] = ("normal", orientation)
    for text in list(table):
        for suffix in ("map", "maps", "tex", "texture"):
            table.setdefault(text + suffix, table[text])
    return table


def _build_acronyms() -> dict[str, tuple[str, ...]]:
    """Return {acronym: maps of R, G, B(, A)}: every order of occlusion, roughness and metallic, and a few more."""
    letters = {"occlusion": ("o", "a", "ao"), "roughness": ("r",), "metallic": ("m",)}
    table = {}
    for order in itertools.permutations(letters):
        for spelling in itertools.product(*(letters[name] for name in order)):
            table["".join(spelling)] = order
            table["".join(spelling) + "h"] = (*order, "displacement")
    table["ord"] = table["ordp"] = ("occlusion", "roughness", "displacement")
    return table


_TABLE = _build_phrases()
_LONGEST = 4  # words in the longest phrase
_ACRONYMS = _build_acronyms()
_SCALARS = {"roughness", "metallic", "occlusion", "displacement", "opacity", "gloss", "specular"}

# Pairs that stand for a packing of their own: {(first, second): (channels, …)}.
_PAIRS = {
    ("metallic", "roughness"): (("roughness", "g"), ("metallic", "b")),  # glTF 2.0, material.pbrMetallicRoughness
    ("roughness", "metallic"): (("roughness", "g"), ("metallic", "b")),
    ("metallic", "gloss"): (("metallic", "r"), ("gloss", "a")),  # Unity's standard shader
    ("specular", "gloss"): (("specular", "rgb"), ("gloss", "a")),
    ("base_color", "opacity"): (("base_color", "rgb"), ("opacity", "a")),
}
_MASK_MAP = (("metallic", "r"), ("occlusion", "g"), ("gloss", "a"))  # Unity's HDRP mask map; B is a detail mask


# --- words ------------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _Word:
    text: str
    part: int  # number of the piece between separators that it comes from
    upper: bool = False


def _words(stem: str) -> list[_Word]:
    words = []
    for part, piece in enumerate(re.split(r"[_\-.\s]+", stem)):
        if not piece or _RESOLUTION.fullmatch(piece) or _FORMAT.fullmatch(piece):
            continue
        piece = re.sub(r"(?<=[A-Za-z])\d{1,2}[kK]$", "", piece)  # Normal4K
        for odd in ("OpenGL", "DirectX", "ORDp"):  # camel case, but one word
            piece = piece.replace(odd, odd.capitalize())
        words += [_Word(text.lower(), part, text.isupper()) for text in _PIECE.findall(piece)]
    return words


def _look_up(words: list[_Word]) -> tuple[str, str | None] | None:
    if len(words) > 1 and any(len(word.text) < 2 for word in words):
        return None  # single letters do not add up to a word
    return _TABLE.get("".join(word.text for word in words))


@dataclasses.dataclass(frozen=True)
class _Match:
    start: int
    claims: tuple[Claim, ...]


def _match(words: list[_Word], channels: int) -> _Match | None:
    """Return the map that ``words`` name, by the phrase that ends last, or None."""
    letter, strong = _letter(words)
    for end in range(len(words), 0, -1):
        if letter and end == len(words) - (1 if strong else 2):
            return letter
        hit = _ending_at(words, end)
        packed = _packed_ending_at(words, end, hit, channels)
        if packed:
            return packed
        if hit:
            start, (name, orientation) = hit
            if name == "gloss":
                return _Match(start, (Claim("roughness", invert=True),))
            return _Match(start, (Claim(name, orientation=orientation),))
    return letter


def _letter(words: list[_Word]) -> tuple[_Match | None, bool]:
    """Return the map of a last single letter, and whether it outranks a phrase right before it (``T_Metal_N``)."""
    if len(words) < 2 or words[-1].text not in _LETTERS or words[-1].part == words[-2].part:
        return None, False
    match = _Match(len(words) - 1, (Claim(_LETTERS[words[-1].text], how="letter"),))
    return match, words[-1].upper or words[0].text == "t"


def _ending_at(words, end):
    for start in range(max(0, end - _LONGEST), end):
        found = _look_up(words[start:end])
        if found:
            return start, found
    return None


def _packed_ending_at(words, end, hit, channels: int) -> _Match | None:
    word = words[end - 1].text
    if word in _ACRONYMS and channels >= len(_ACRONYMS[word]):
        return _Match(end - 1, _packed(zip(_ACRONYMS[word], "rgba", strict=False)))
    joined = "".join(w.text for w in words[max(0, end - 2) : end])
    if channels == 4 and joined.endswith("maskmap"):
        return _Match(end - (1 if word == "maskmap" else 2), _packed(_MASK_MAP))
    if hit is None:
        return _written_together(word, end, channels)
    run, start = [hit[1][0]], hit[0]
    while start > 0 and run[0] in _SCALARS:
        before = _ending_at(words, start)
        if before is None or before[1][0] not in (_SCALARS | {"base_color"}) or before[1][0] in run:
            break
        run.insert(0, before[1][0])
        start = before[0]
    names = tuple(run)
    if len(names) >= 3 and set(names[-3:]) <= _SCALARS and channels >= 3:
        begin = _start_of(words, end, 3)
        return _Match(begin, _packed(zip(names[-3:], "rgb", strict=True)))
    if len(names) >= 2:
        return _pair(words, end, names[-2:], channels)
    return None


def _pair(words, end, names, channels: int) -> _Match | None:
    layout = _PAIRS.get(names)
    if layout is None or channels < (4 if "a" in "".join(c for _, c in layout) else 3):
        return None
    begin = _start_of(words, end, 2)
    # A slug may end in a short map word: rusty_metal_rough is the roughness of rusty metal.
    one_piece = words[begin].part == words[end - 1].part
    if not one_piece and words[begin].text in ("metal", "rough", "met", "color", "colour", "base", "spec"):
        return None
    return _Match(begin, _packed(layout))


def _start_of(words, end, count: int) -> int:
    for _ in range(count):
        end = _ending_at(words, end)[0]
    return end


def _written_together(word: str, end: int, channels: int) -> _Match | None:
    """Return the packed maps of ``occlusionroughnessmetallic`` and the like in one lower-case word."""
    rest, names = word, []
    while rest:
        for size in range(len(rest), 2, -1):
            found = _TABLE.get(rest[:size])
            if found and found[0] in _SCALARS and found[0] not in names:
                names.append(found[0])
                rest = rest[size:]
                break
        else:
            return None
    if len(names) == 3 and channels >= 3:
        return _Match(end - 1, _packed(zip(names, "rgb", strict=True)))
    layout = _PAIRS.get(tuple(names))
    return _Match(end - 1, _packed(layout)) if layout and channels >= 3 else None


def _packed(layout) -> tuple[Claim, ...]:
    claims = []
    for name, channels in layout:
        needs = max("rgba".index(c) for c in channels) + 1
        invert = name == "gloss"
        claims.append(Claim("roughness" if invert else name, channels, invert=invert, how="packed", needs=needs))
    return tuple(claims)


# --- a folder ---------------------------------------------------------------------------------------------------------


def read_names(stems: list[str], channels: list[int]) -> list[tuple[Claim, ...]]:
    """Return what each picture of one folder claims to be; nothing is settled between them.

    Args:
        stems: File names without their suffix.
        channels: Channels of each picture: a one-channel ``robot_arm`` is no packed ARM map.

    A slug is what a name shares with another name that goes on with a known map: ``metal_plate_rust`` beside
    ``metal_plate_diff`` is an extra map ``rust``, not metallic. A picture whose name is nothing but the slug is the
    base colour if it has colours and no other picture is; else a preview. An unknown name becomes an extra map.
    """
    words = [_words(stem) for stem in stems]
    matches = [_match(w, n) if w else None for w, n in zip(words, channels, strict=True)]
    slugs = [_slug(i, words, matches) for i in range(len(words))]
    claims = []
    for i, (stem, n) in enumerate(zip(stems, channels, strict=True)):
        rest = words[i][slugs[i] :]
        if any(word.text in _PREVIEW for word in rest):
            claims.append((Claim(_slugged(rest, stem), how="preview"),))
        elif match := _past(slugs[i], matches[i], words[i], n):
            claims.append(_named(match, words[i], slugs[i]))
        elif not rest and slugs[i]:
            claims.append((Claim("base_color", how="stem", needs=3 if n >= 3 else 1),))
        else:
            claims.append((Claim(_slugged(rest or words[i], stem), how="extra"),))
    taken = any(c.map == "base_color" and c.how != "stem" for group in claims for c in group)
    bare = [i for i, group in enumerate(claims) if group[0].how == "stem"]
    for i in bare:
        if taken or channels[i] < 3 or len(bare) > 1:
            claims[i] = (Claim(_slugged(words[i], stems[i]), how="preview" if taken else "extra"),)
    return claims


def _slug(i: int, words, matches) -> int:
    """Return how many leading words of name i are the set's slug."""
    longest = 0
    for j, other in enumerate(words):
        if j == i or matches[j] is None:
            continue
        shared = 0
        for a, b in zip(words[i], other, strict=False):
            if a.text != b.text:
                break
            shared += 1
        longest = max(longest, min(shared, matches[j].start))
    return longest


def _past(slug: int, match: _Match | None, words, channels: int) -> _Match | None:
    """Return the match among the words behind the slug: ``color`` of ``table_base_color`` where the slug is a base."""
    if match is None or match.start >= slug:
        return match
    match = _match(words[slug:], channels)
    return match and _Match(match.start + slug, match.claims)


def _named(match: _Match, words, slug: int) -> tuple[Claim, ...]:
    first = match.claims[0]
    if first.map == "mask" and match.start > slug:  # dirt_mask and variation_mask are masks of different things
        return (dataclasses.replace(first, map="mask_" + "_".join(word.text for word in words[slug : match.start])),)
    return match.claims


def _slugged(words, stem: str) -> str:
    """Return ``words`` as a map's name: lower case, an identifier."""
    name = "_".join(word.text for word in words) or re.sub(r"\W+", "_", stem.lower()).strip("_")
    return name if name.isidentifier() else f"map_{name}".rstrip("_")

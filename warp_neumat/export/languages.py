"""What differs between GLSL, HLSL and WGSL, and nothing else: the decoder itself is written once, in shader_source.py.

A decoder is written in a neutral notation: types are spelt as in HLSL (``float3``, ``uint4``), operators, swizzles,
constructors with one argument per component and the functions max, clamp, dot, pow, sqrt, log2, normalize mean the same
everywhere. :class:`Writer` turns statements into the text of one :class:`Language`.
"""

import dataclasses
import re
import textwrap

import numpy as np

TYPES = ("float", "float2", "float3", "float4", "uint", "uint4")
"""Types of the neutral notation."""


@dataclasses.dataclass(frozen=True)
class Language:
    """One shading language.

    Attributes:
        name: As a user asks for it; also the file's suffix.
        types: Its names of :data:`TYPES`, in their order.
        texture: Type of a 2-D texture parameter.
        sampler: Type of a sampler parameter, or none where a texture carries its sampler.
        fetch: First three channels of ``{texture}`` at ``{uv}`` and mip level ``{level}``.
        halves: Two halves of the 32-bit word ``{word}`` as a float2, the low one first.
        choose: ``{yes}`` if ``{condition}`` else ``{no}``.
        typed_after: Whether a type follows its name.
        derivatives: Screen-space derivatives of ``uv``, for the usage text.
        usage: Declaration of the weight buffer, for the usage text.
        preamble: Text before the first declaration.
    """

    name: str
    types: tuple[str, ...]
    texture: str
    sampler: str | None
    fetch: str
    halves: str
    choose: str
    typed_after: bool
    derivatives: str
    usage: str
    preamble: str = ""

    def translate(self, text: str) -> str:
        """Return neutral ``text`` with this language's names of the types."""
        names = dict(zip(TYPES, self.types, strict=True))
        return re.sub(rf"\b({'|'.join(TYPES)})\b", lambda match: names[match[1]], text)

    def parameter(self, kind: str, name: str) -> str:
        """Return the declaration of a parameter, without a separator."""
        return f"{name}: {kind}" if self.typed_after else f"{kind} {name}"


GLSL = Language(
    name="glsl",
    types=("float", "vec2", "vec3", "vec4", "uint", "uvec4"),
    texture="BCF_TEXTURE",
    sampler=None,
    fetch="BCF_FETCH({texture}, {uv}, {level}).rgb",
    halves="unpackHalf2x16({word})",
    choose="({condition} ? {yes} : {no})",
    typed_after=False,
    derivatives="dFdx(uv), dFdy(uv)",
    usage="layout(std430, set = 0, binding = {n}) readonly buffer BcfWeights {{ uvec4 bcf_weights[]; }};",
    preamble="""\
// Textures come with their samplers. For separate ones, or for indices into an array of textures, define both before
// this file, as
//     #define BCF_TEXTURE texture2D
//     #define BCF_FETCH(t, uv, level) textureLod(sampler2D(t, my_sampler), uv, level)
#ifndef BCF_TEXTURE
#define BCF_TEXTURE sampler2D
#define BCF_FETCH(t, uv, level) textureLod(t, uv, level)
#endif
""",
)
HLSL = Language(
    name="hlsl",
    types=TYPES,
    texture="Texture2D",
    sampler="SamplerState",
    fetch="{texture}.SampleLevel({sampler}, {uv}, {level}).rgb",
    halves="f16tof32(uint2({word}, {word} >> 16))",
    choose="({condition} ? {yes} : {no})",
    typed_after=False,
    derivatives="ddx(uv), ddy(uv)",
    usage="StructuredBuffer<uint4> bcf_weights : register(t{n});",
)
WGSL = Language(
    name="wgsl",
    types=("f32", "vec2f", "vec3f", "vec4f", "u32", "vec4u"),
    texture="texture_2d<f32>",
    sampler="sampler",
    fetch="textureSampleLevel({texture}, {sampler}, {uv}, {level}).rgb",
    halves="unpack2x16float({word})",
    choose="select({no}, {yes}, {condition})",
    typed_after=True,
    derivatives="dpdx(uv), dpdy(uv)",
    usage="@group(0) @binding({n}) var<storage, read> bcf_weights: array<vec4u>;",
)
LANGUAGES = {language.name: language for language in (GLSL, HLSL, WGSL)}
"""The languages by name."""


def literal(value) -> str:
    """Return ``value``, rounded to float32, as a literal that every compiler reads back as that very float32."""
    number = float(np.float32(value))
    if not np.isfinite(number):
        raise ValueError(f"a shader constant must be finite, got {value}")
    return repr(number)  # shortest text that a double reads back, so exact after the final rounding to float32


def vector(values) -> str:
    """Return the constructor of a float, float2, float3 or float4 of literals."""
    texts = [literal(value) for value in values]
    return texts[0] if len(texts) == 1 else f"float{len(texts)}({', '.join(texts)})"


class Writer:
    """Collects statements of one language."""

    def __init__(self, language: Language):
        self.language = language
        self._lines: list[str] = []
        self._depth = 0

    @property
    def text(self) -> str:
        """Everything written so far."""
        return "\n".join(self._lines).strip() + "\n"

    def raw(self, text: str) -> None:
        """Write text of the language itself."""
        self._lines += text.split("\n")

    def line(self, text: str = "") -> None:
        """Write neutral code as it is; further lines of ``text`` are indented as continuations."""
        first, *rest = self.language.translate(text).split("\n")
        indent = "    " * self._depth
        self._lines += [(indent + first).rstrip(), *((indent + "    " + line).rstrip() for line in rest)]

    def comment(self, text: str) -> None:
        """Write a comment, wrapped; lines that start with blanks are kept as they are."""
        indent = "    " * self._depth + "// "
        for line in text.split("\n"):
            wrapped = [line] if line.startswith(" ") else textwrap.wrap(line, 116 - len(indent)) or [""]
            self._lines += [(indent + part).rstrip() for part in wrapped]

    def struct(self, name: str, fields) -> None:
        """Write a struct of (type, name, remark) fields."""
        self.line(f"struct {name} {{")
        separator = "," if self.language.typed_after else ";"
        for kind, field, remark in fields:
            code = self.language.translate(self.language.parameter(kind, field)) + separator
            self._lines.append(f"    {code:<28} // {remark}" if remark else f"    {code}")
        self.line("}" if self.language.typed_after else "};")
        self.line()

    def begin(self, result: str, name: str, parameters) -> None:
        """Open a function of (type, name) ``parameters``; types ``texture`` and ``sampler`` are known, too."""
        known = {"texture": self.language.texture, "sampler": self.language.sampler}
        listed = [(known.get(kind, kind), parameter) for kind, parameter in parameters]
        inner = ", ".join(self.language.parameter(kind, parameter) for kind, parameter in listed if kind)
        self.line(f"fn {name}({inner}) -> {result} {{" if self.language.typed_after else f"{result} {name}({inner}) {{")
        self._depth += 1

    def end(self, value: str) -> None:
        """Return ``value`` and close the function."""
        self.line(f"return {value};")
        self._depth -= 1
        self.line("}")
        self.line()

    def let(self, kind: str, name: str, value: str) -> None:
        """Declare a value that does not change."""
        self.line(f"let {name} = {value};" if self.language.typed_after else f"{kind} {name} = {value};")

    def variable(self, kind: str, name: str) -> None:
        """Declare a variable whose parts are assigned next."""
        self.line(f"var {name}: {kind};" if self.language.typed_after else f"{kind} {name};")


# --- names ------------------------------------------------------------------------------------------------------------

# Words that a map could bear and that one of the languages keeps for itself.
_WORDS = """
    abstract active alias alignas alignof as asm async attribute auto await become bool break buffer case cast catch
    cbuffer centroid char class coherent common compile concept const constexpr continue continuing crate debugger
    decltype default delete demote diagnostic discard do double else enable enum explicit export extends extern external
    fallthrough false filter final finally fixed flat float fn for friend from fxgroup get goto groupshared half handle
    highp if impl implements import in inline inout input instanceof int interface invariant layout let line lineadj
    linear long loop lowp macro match matrix mediump meta mod module move mut mutable namespace new nil noexcept
    noinline nointerpolation noncoherent noperspective null nullptr of operator out output override package packoffset
    partition pass patch pixelfragment point precise precision premerge priv private protected pub public readonly ref
    regardless register requires resource restrict return sample sampler self set shared short signed sizeof smooth
    snorm stateblock static std storage string struct subroutine super superp switch target tbuffer technique template
    texture this throw trait triangle true try type typedef typeid typename typeof uint uniform union unless unorm
    unsafe unsigned unsized use using var varying vector virtual void volatile wgsl where while with writeonly yield
    vec2 vec3 vec4 mat2 mat3 mat4 float2 float3 float4 uint2 uint3 uint4 int2 int3 int4
"""
_RESERVED = frozenset(_WORDS.split())


def identifier(text: str) -> str:
    """Return ``text`` with every run of other characters than ASCII letters and digits made one underscore."""
    return re.sub(r"[^A-Za-z0-9]+", "_", text).strip("_")


def plain(text: str) -> str:
    """Return ``text`` as it may stand in a comment: printable ASCII, no backslash that would continue the line."""
    return re.sub(r"[^ -~]|\\", "?", text)


def field_names(maps) -> dict[str, str]:
    """Return a struct field for each map name: a valid identifier in all languages, no two the same."""
    fields: dict[str, str] = {}
    for name in maps:
        stem = identifier(name).lower() or "map"
        if stem in _RESERVED or stem[0].isdigit():
            stem = f"map_{stem}"
        field, number = stem, 2
        while field in fields.values():
            field, number = f"{stem}_{number}", number + 1
        fields[name] = field
    return fields

"""The BCf decoder as shader source: one description, written out in GLSL, HLSL and WGSL (paper [bcf], §5.2, Eq. 11).

The same steps as ``Material.maps``: the T feature textures are sampled by the graphics API's own trilinear sampler at
an explicit mip level each, their colours are the 3T inputs of a 3T → H → C network with ReLU, and its clamped outputs
are decoded (range, sRGB, normal) to named maps. Numbers are written so that they read back exactly; loops are unrolled,
so that no array is indexed at run time. Every name begins with ``bcf_NAME``: several materials fit into one shader.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from warp_neumat.export.languages import LANGUAGES, Language, Writer, field_names, identifier, literal, plain, vector
from warp_neumat.export.weight_layout import layout

_ZERO = "float4(0.0, 0.0, 0.0, 0.0)"
_ONE = "float4(1.0, 1.0, 1.0, 1.0)"
_COMPONENTS = ("value", "r", "g", "b", "a", "x", "y")


@dataclasses.dataclass(frozen=True)
class Map:
    """One map that the decoder returns.

    Attributes:
        name: Name in the asset.
        field: Field of the shader's struct.
        channels: Indices of the network's outputs that it is made of, in the order of its components; empty where it is
            constant.
        width: Components of the decoded value: those of a normal are 3.
        constant: The value, of a map that does not vary.
    """

    name: str
    field: str
    channels: tuple[int, ...]
    width: int
    constant: tuple[float, ...] = ()


def maps_of(config: dict) -> list[Map]:
    """Return the maps of an asset's config, in its order, the constant ones last."""
    channels, constants = config["channels"], config.get("constants", {})
    members: dict[str, list[int]] = {}
    for index, channel in enumerate(channels):
        members.setdefault(channel["map"], []).append(index)
    for indices in members.values():
        indices.sort(key=lambda index: _COMPONENTS.index(channels[index]["component"]))
    fields = field_names([*members, *constants])
    found = []
    for name, indices in members.items():
        width = 3 if channels[indices[0]]["encoding"] == "normal" else len(indices)
        found.append(Map(name, fields[name], tuple(indices), width))
    for name, value in constants.items():
        found.append(Map(name, fields[name], (), len(value), tuple(value)))
    return found


def lod_bias(config: dict, texture: dict) -> float:
    """Return b = log₂ max(h_t/h, w_t/w), what Eq. 11 of [bcf] adds to the reference's mip level for ``texture``."""
    return math.log2(max(texture["height"] / config["height"], texture["width"] / config["width"]))


def prefix_of(name: str) -> str:
    """Return what every name in the shader of material ``name`` begins with."""
    return f"bcf_{identifier(name) or 'material'}"


def shader_source(language: str, name: str, config: dict, weights: dict[str, np.ndarray], *, baked=False) -> str:
    """Return the decoder of one material as source of one language.

    Args:
        language: ``"glsl"``, ``"hlsl"`` or ``"wgsl"``.
        name: The material's name.
        config: The config of its asset.
        weights: ``weight0``, ``bias0``, ``weight1``, ``bias1`` of its asset, float16.
        baked: Write the weights as constants; otherwise they are read from the host's buffer ``bcf_weights``.
    """
    return _Decoder(LANGUAGES[language], name, config, weights, baked).write()


class _Decoder:
    """Writes one decoder; every step of it is a method."""

    def __init__(self, language: Language, name: str, config: dict, weights: dict, baked: bool):
        self.language, self.name, self.config, self.weights, self.baked = language, name, config, weights, baked
        self.prefix = prefix_of(name)
        self.textures, self.maps = config["textures"], maps_of(config)
        (self.hidden, self.inputs), self.outputs = weights["weight0"].shape, len(weights["bias1"])
        self.blocks = layout(self.inputs, self.hidden, self.outputs)
        self.base = [] if baked else [("uint", "base")]
        self.out = Writer(language)

    def write(self) -> str:
        self.usage()
        self.structs()
        self.lod()
        if any(channel["encoding"] == "srgb" for channel in self.config["channels"]):
            self.srgb()
        if not self.baked:
            self.unpacking()
        self.network()
        self.decode()
        self.samplers()
        return self.out.text

    # --- steps ---

    def usage(self) -> None:
        out, count = self.out, len(self.textures)
        sizes = ", ".join(f"T{n} {t['width']}x{t['height']} ({t['mips']} mips)" for n, t in enumerate(self.textures))
        shape = f"{self.inputs} -> {self.hidden} -> {self.outputs}"
        kind = "signed" if self.config["signed"] else "unsigned"
        out.comment(
            f'Decoder of the neural material "{plain(self.name)}": a {shape} network over {count} {kind} BC6H '
            f"textures: {sizes}."
        )
        out.comment(
            f"Reference size {self.config['width']}x{self.config['height']}; lod 0 is its finest mip. Texture v runs "
            "down, row 0 on top: upload the rows in the order of the file."
        )
        if self.baked:
            out.comment("The weights are constants of this file; it needs no buffer.")
        else:
            out.comment("The weights are in the buffer bcf_weights that the host shader declares, as")
            out.comment("    " + self.language.usage.format(n=count + 1))
            out.comment(
                "It holds the weights files of one or more materials end to end; base is the number of 16-byte rows "
                "before this material's."
            )
        wrap = {"repeat": "repeat", "clamp": "clamp to edge", "mirror": "mirrored repeat"}[self.config["wrap"]]
        out.comment(
            f"The sampler{'s' if self.language.sampler is None else ''}: linear, linear between mips, {wrap}, no bias."
        )
        out.comment("")
        arguments = self.arguments()
        out.comment("In a fragment shader, outside of divergent control flow:")
        call = ", ".join([*arguments, "uv", self.language.derivatives, *(name for _, name in self.base)])
        out.comment(f"    {self.language.parameter(self.prefix + '_Maps', 'm')} = {self.prefix}_sample_grad({call});")
        call = ", ".join([*arguments, "uv", "lod", *(name for _, name in self.base)])
        out.comment(f"Elsewhere, with the mip level of the reference:  {self.prefix}_sample_lod({call})")
        out.comment("Fields that are not used cost nothing once the compiler has removed them.")
        out.line()
        if self.language.preamble:
            out.raw(self.language.preamble)

    def structs(self) -> None:
        rows = []
        for found in self.maps:
            kind = "float" if found.width == 1 else f"float{found.width}"
            encodings = sorted({self.config["channels"][index]["encoding"] for index in found.channels})
            remark = {"srgb": "linear Rec.709", "normal": "unit, tangent space, +Y up"}.get(
                encodings[0] if encodings else "", "constant" if not encodings else "linear"
            )
            if found.name != found.field:
                remark += f'; "{plain(found.name)}"'
            rows.append((kind, found.field, remark))
        self.out.comment("What the decoder returns.")
        self.out.struct(f"{self.prefix}_Maps", rows)
        self.out.comment("The network's outputs, clamped to [0, 1], in the order of the asset's channels.")
        self.out.struct(f"{self.prefix}_Outputs", [("float4", f"y{n}", "") for n in range(self.quads(self.outputs))])

    def lod(self) -> None:
        out, size = self.out, vector([self.config["width"], self.config["height"]])
        out.comment("Mip level of the reference from the derivatives of uv over a pixel's two axes (Eq. 11).")
        out.begin("float", f"{self.prefix}_lod", [("float2", "duv_dx"), ("float2", "duv_dy")])
        out.let("float2", "dx", f"duv_dx * {size}")
        out.let("float2", "dy", f"duv_dy * {size}")
        out.end("0.5 * log2(max(max(dot(dx, dx), dot(dy, dy)), 1e-30))")

    def srgb(self) -> None:
        out = self.out
        out.comment("sRGB (IEC 61966-2-1) to linear.")
        out.begin("float", f"{self.prefix}_linear", [("float", "v")])
        curve = "pow((max(v, 0.0) + 0.055) / 1.055, 2.4)"
        out.end(self.language.choose.format(condition="v <= 0.04045", yes="v / 12.92", no=curve))

    def unpacking(self) -> None:
        out = self.out
        for half, words, which in (("lo", "xy", "first"), ("hi", "zw", "last")):
            out.comment(f"The {which} four halves of a row of weights.")
            out.begin("float4", f"{self.prefix}_{half}", [("uint", "row")])
            for n, word in enumerate(words):
                out.let("float2", f"h{n}", self.language.halves.format(word=f"bcf_weights[row].{word}"))
            out.end("float4(h0.x, h0.y, h1.x, h1.y)")
        out.comment("Eight weights times eight inputs.")
        out.begin("float", f"{self.prefix}_dot", [("uint", "row"), ("float4", "a"), ("float4", "b")])
        out.end(f"dot({self.prefix}_lo(row), a) + dot({self.prefix}_hi(row), b)")

    def network(self) -> None:
        out, features = self.out, [f"f{n}" for n in range(len(self.textures))]
        out.comment(f"Network: the features of the {len(self.textures)} textures -> {self.outputs} outputs in [0, 1].")
        out.begin(f"{self.prefix}_Outputs", f"{self.prefix}_network", [*(("float3", f) for f in features), *self.base])
        self.gather("x", [f"{f}.{c}" for f in features for c in "xyz"])
        for n in range(self.quads(self.hidden)):
            out.let("float4", f"h{n}", f"max({self.affine(0, n, 'x', self.inputs, self.hidden)},\n{_ZERO})")
        out.variable(f"{self.prefix}_Outputs", "y")
        for n in range(self.quads(self.outputs)):
            out.line(f"y.y{n} = clamp({self.affine(1, n, 'h', self.hidden, self.outputs)},\n{_ZERO}, {_ONE});")
        out.end("y")

    def decode(self) -> None:
        out = self.out
        out.comment("Outputs of the network -> maps: range, sRGB, normal.")
        out.begin(f"{self.prefix}_Maps", f"{self.prefix}_maps", [(f"{self.prefix}_Outputs", "y")])
        out.variable(f"{self.prefix}_Maps", "m")
        for found in self.maps:
            if not found.channels:
                out.line(f"m.{found.field} = {vector(found.constant)};")
                continue
            values = [self.value(index) for index in found.channels]
            if found.width == 3 and self.config["channels"][found.channels[0]]["encoding"] == "normal":
                x, y = f"{found.field}_x", f"{found.field}_y"
                out.let("float", x, f"2.0 * ({values[0]}) - 1.0")
                out.let("float", y, f"2.0 * ({values[1]}) - 1.0")
                z = f"sqrt(max(0.0, 1.0 - {x} * {x} - {y} * {y}))"
                out.line(f"m.{found.field} = normalize(float3({x}, {y}, {z}));")
            else:
                text = values[0] if len(values) == 1 else f"float{len(values)}({', '.join(values)})"
                out.line(f"m.{found.field} = {text};")
        out.end("m")

    def samplers(self) -> None:
        out, count = self.out, len(self.textures)
        textures = [*(("texture", f"t{n}") for n in range(count)), ("sampler", "s")]
        arguments, base = ", ".join(self.arguments()), "".join(f", {name}" for _, name in self.base)
        out.comment("Maps at uv and the mip level lod of the reference, which may be fractional or negative.")
        parameters = [*textures, ("float2", "uv"), ("float", "lod"), *self.base]
        out.begin(f"{self.prefix}_Maps", f"{self.prefix}_sample_lod", parameters)
        for n, texture in enumerate(self.textures):
            bias, last = lod_bias(self.config, texture), literal(texture["mips"] - 1)
            shifted = f"lod {'-' if bias < 0 else '+'} {literal(abs(bias))}" if bias else "lod"
            level = f"clamp({shifted}, 0.0, {last})" if texture["mips"] > 1 else "0.0"
            fetch = self.language.fetch.format(texture=f"t{n}", sampler="s", uv="uv", level=level)
            out.let("float3", f"f{n}", fetch)
        features = ", ".join(f"f{n}" for n in range(count))
        out.end(f"{self.prefix}_maps({self.prefix}_network({features}{base}))")

        out.comment("Maps at uv, filtered over a pixel whose axes move uv by duv_dx and duv_dy (Eq. 11).")
        parameters = [*textures, ("float2", "uv"), ("float2", "duv_dx"), ("float2", "duv_dy"), *self.base]
        out.begin(f"{self.prefix}_Maps", f"{self.prefix}_sample_grad", parameters)
        out.end(f"{self.prefix}_sample_lod({arguments}, uv, {self.prefix}_lod(duv_dx, duv_dy){base})")

    # --- pieces ---

    @staticmethod
    def quads(count: int) -> int:
        """Vectors of four that hold ``count`` numbers."""
        return -(-count // 4)

    def arguments(self) -> list[str]:
        """Return the names of the texture parameters, and of the sampler's where there is one."""
        return [*(f"t{n}" for n in range(len(self.textures))), *(["s"] if self.language.sampler else [])]

    def gather(self, name: str, scalars: list[str]) -> None:
        """Declare ``scalars`` as vectors of four, the last one filled up with zeros."""
        for n in range(self.quads(len(scalars))):
            part = [*scalars[4 * n : 4 * n + 4], "0.0", "0.0", "0.0"][:4]
            self.out.let("float4", f"{name}{n}", f"float4({', '.join(part)})")

    def affine(self, layer: int, quad: int, name: str, inputs: int, outputs: int) -> str:
        """Return components 4·quad … of weight · (name0, name1, …) + bias; those beyond ``outputs`` are 0."""
        units = range(4 * quad, 4 * quad + 4)
        rows = [self.product(layer, unit, name, self.quads(inputs)) if unit < outputs else "0.0" for unit in units]
        return "float4(\n" + ",\n".join("    " + row for row in rows) + f")\n+ {self.bias(layer, quad)}"

    def product(self, layer: int, unit: int, name: str, quads: int) -> str:
        """Return one matrix row times (name0, name1, …)."""
        if self.baked:
            row = self.weights[f"weight{layer}"][unit]
            return " +\n    ".join(f"dot({self.numbers(row, n)}, {name}{n})" for n in range(quads))
        block, terms = self.blocks[f"weight{layer}"], []
        for n in range(0, quads, 2):
            row = f"base + {block.row + unit * block.stride + n // 2}u"
            if n + 1 < quads:
                terms.append(f"{self.prefix}_dot({row}, {name}{n}, {name}{n + 1})")
            else:
                terms.append(f"dot({self.prefix}_lo({row}), {name}{n})")
        return " + ".join(terms)

    def bias(self, layer: int, quad: int) -> str:
        """Return four biases."""
        if self.baked:
            return self.numbers(self.weights[f"bias{layer}"], quad)
        row = self.blocks[f"bias{layer}"].row + quad // 2
        return f"{self.prefix}_{('lo', 'hi')[quad % 2]}(base + {row}u)"

    @staticmethod
    def numbers(values, quad: int) -> str:
        return vector([*values[4 * quad : 4 * quad + 4], 0, 0, 0][:4])

    def value(self, index: int) -> str:
        """Return the decoded value of one channel; of a normal's, in [0, 1]."""
        channel = self.config["channels"][index]
        lo, hi = np.float32(channel["range"][0]), np.float32(channel["range"][1])
        text = f"y.y{index // 4}.{'xyzw'[index % 4]}"
        if (lo, hi) != (0, 1):
            text = f"{literal(lo)} + {literal(hi - lo)} * {text}"
        return f"{self.prefix}_linear({text})" if channel["encoding"] == "srgb" else text

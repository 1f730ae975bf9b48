"""Small host shaders around an exported decoder, written by hand per language, and the tools that compile them."""

import shutil
import subprocess

import pytest

from warp_neumat.export.shader_source import lod_bias, maps_of, prefix_of

FETCH = {
    "glsl": "textureLod(sampler2D(t{t}, s), q.xy, q.z + {bias}).rgb",
    "hlsl": "t{t}.SampleLevel(s, q.xy, q.z + {bias}).rgb",
    "wgsl": "textureSampleLevel(t{t}, s, q.xy, q.z + {bias}).rgb",
}


def declarations(language: str, textures: int) -> str:
    """Return the bindings that wgpu_host.py makes, in ``language``."""
    n = textures
    if language == "glsl":
        lines = [f"layout(set = 0, binding = {t}) uniform texture2D t{t};" for t in range(n)]
        lines += [f"layout(set = 0, binding = {n}) uniform sampler s;"]
        for k, (access, name, array) in enumerate(
            [
                ("readonly", "Weights", "uvec4 bcf_weights"),
                ("readonly", "Queries", "vec4 queries"),
                ("", "Results", "float results"),
            ]
        ):
            lines.append(f"layout(std430, set = 0, binding = {n + 1 + k}) {access} buffer {name} {{ {array}[]; }};")
        lines += ["#define BCF_TEXTURE texture2D", "#define BCF_FETCH(t, uv, l) textureLod(sampler2D(t, s), uv, l)"]
        return "#version 450\nlayout(local_size_x = 64) in;\n" + "\n".join(lines) + "\n"
    if language == "hlsl":
        kinds = ["Texture2D t{n}"] * n + ["SamplerState s", "StructuredBuffer<uint4> bcf_weights"]
        kinds += ["StructuredBuffer<float4> queries", "RWStructuredBuffer<float> results"]
        return "".join(f"[[vk::binding({k})]] {kind.format(n=k)};\n" for k, kind in enumerate(kinds))
    kinds = ["var t{n}: texture_2d<f32>"] * n + ["var s: sampler", "var<storage, read> bcf_weights: array<vec4u>"]
    kinds += ["var<storage, read> queries: array<vec4f>", "var<storage, read_write> results: array<f32>"]
    return "".join(f"@group(0) @binding({k}) {kind.format(n=k)};\n" for k, kind in enumerate(kinds))


def compute_host(language: str, name: str, config: dict, decoder: str, count: int, base: int | None, grad: bool):
    """Return (source, floats): a compute shader, and how many numbers it writes per query.

    A query is u, v, lod, and the texels of a pixel's footprint, across if positive and down if negative. Written are
    the features as the sampler gives them, the network's outputs for them, the maps of ``sample_lod``, and with
    ``grad`` those of ``sample_grad``. ``base`` is the material's base in the weights, None for a baked decoder.
    """
    prefix, textures, outputs = prefix_of(name), len(config["textures"]), len(config["channels"])
    wgsl, two = language == "wgsl", {"glsl": "vec2", "hlsl": "float2", "wgsl": "vec2f"}[language]
    three = two.replace("2", "3")

    def let(kind, variable, value):
        return f"    let {variable} = {value};\n" if wgsl else f"    {kind} {variable} = {value};\n"

    last = [] if base is None else [f"{base}u"]
    names = [f"t{t}" for t in range(textures)] + ([] if language == "glsl" else ["s"])
    body = let({"glsl": "vec4", "hlsl": "float4"}.get(language), "q", "queries[i]")
    written = []
    for t, texture in enumerate(config["textures"]):
        bias = repr(lod_bias(config, texture))
        body += let(three, f"f{t}", FETCH[language].format(t=t, bias=f"({bias})"))
        written += [f"f{t}.{c}" for c in "xyz"]
    features = ", ".join([f"f{t}" for t in range(textures)] + last)
    body += let(f"{prefix}_Outputs", "y", f"{prefix}_network({features})")
    written += [f"y.y{k // 4}.{'xyzw'[k % 4]}" for k in range(outputs)]
    body += let(f"{prefix}_Maps", "a", f"{prefix}_sample_lod({', '.join([*names, 'q.xy', 'q.z', *last])})")
    across, down = f"max(q.w, 0.0) / {config['width']}.0", f"max(-q.w, 0.0) / {config['height']}.0"
    step = [f"{two}({across}, 0.0)", f"{two}(0.0, {down})"]
    if grad:
        body += let(f"{prefix}_Maps", "b", f"{prefix}_sample_grad({', '.join([*names, 'q.xy', *step, *last])})")
    for struct in "ab" if grad else "a":
        for found in maps_of(config):
            written += [f"{struct}.{found.field}" + (f".{c}" if found.width > 1 else "") for c in "xyz"[: found.width]]
    floats = len(written)
    body += "".join(f"    results[i * {floats}u + {k}u] = {value};\n" for k, value in enumerate(written))
    head = {
        "glsl": "void main() {\n    uint i = gl_GlobalInvocationID.x;\n",
        "hlsl": "[numthreads(64, 1, 1)]\nvoid main(uint3 id : SV_DispatchThreadID) {\n    uint i = id.x;\n",
        "wgsl": "@compute @workgroup_size(64)\nfn main(@builtin(global_invocation_id) id: vec3u) {\nlet i = id.x;\n",
    }[language]
    guard = f"    if (i >= {count}u) {{ return; }}\n"
    return declarations(language, textures) + decoder + head + guard + body + "}\n", floats


def fragment_host(language: str, name: str, config: dict, decoder: str, *, baked: bool) -> str:
    """Return a fragment shader as the head of the decoder tells a user to write it: every map goes into the colour."""
    prefix, textures = prefix_of(name), len(config["textures"])
    last = "" if baked else ", 7u"
    names = ", ".join(f"t{t}" for t in range(textures))
    total = " + ".join(f"m.{f.field}" + (".x" if f.width > 1 else "") for f in maps_of(config))
    if language == "glsl":
        head = "#version 450\nlayout(location = 0) in vec2 uv;\nlayout(location = 0) out vec4 colour;\n"
        head += "".join(f"layout(set = 0, binding = {t}) uniform sampler2D t{t};\n" for t in range(textures))
        if not baked:
            head += f"layout(std430, set = 0, binding = {textures + 1}) readonly buffer B {{ uvec4 bcf_weights[]; }};\n"
        call = f"{prefix}_sample_grad({names}, uv, dFdx(uv), dFdy(uv){last})"
        return head + decoder + f"void main() {{\n    {prefix}_Maps m = {call};\n    colour = vec4({total});\n}}\n"
    if language == "hlsl":
        head = "".join(f"Texture2D t{t} : register(t{t});\n" for t in range(textures)) + "SamplerState s;\n"
        head += "" if baked else f"StructuredBuffer<uint4> bcf_weights : register(t{textures + 1});\n"
        call = f"{prefix}_sample_grad({names}, s, uv, ddx(uv), ddy(uv){last})"
        main = f"float4 main(float2 uv : TEXCOORD0) : SV_Target {{\n    {prefix}_Maps m = {call};\n"
        return head + decoder + main + f"    return float4(({total}).xxxx);\n}}\n"
    head = "".join(f"@group(0) @binding({t}) var t{t}: texture_2d<f32>;\n" for t in range(textures))
    head += f"@group(0) @binding({textures}) var s: sampler;\n"
    if not baked:
        head += f"@group(0) @binding({textures + 1}) var<storage, read> bcf_weights: array<vec4u>;\n"
    call = f"{prefix}_sample_grad({names}, s, uv, dpdx(uv), dpdy(uv){last})"
    main = f"@fragment\nfn main(@location(0) uv: vec2f) -> @location(0) vec4f {{\n    let m = {call};\n"
    return head + decoder + main + f"    return vec4f({total});\n}}\n"


def missing_tool() -> str | None:
    """Return why GLSL and HLSL cannot be compiled here, if so."""
    for tool, package in (("glslangValidator", "glslang-tools"), ("spirv-opt", "spirv-tools")):
        if not shutil.which(tool):
            return f"{tool} is missing; install {package}"
    return None


def spirv(language: str, stage: str, source: str, folder, *, inline=False) -> bytes:
    """Return GLSL or HLSL compiled by glslangValidator to valid SPIR-V; skip where the tools are missing.

    ``inline`` inlines functions, for a reader that cannot pass textures to them.
    """
    if reason := missing_tool():
        pytest.skip(reason)
    text, binary = folder / f"host.{language}", folder / "host.spv"
    text.write_text(source)
    command = ["glslangValidator", "-V", "-S", stage, "-e", "main", *(["-D"] if language == "hlsl" else [])]
    done = subprocess.run([*command, text, "-o", binary], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr
    subprocess.run(["spirv-val", "--target-env", "vulkan1.1", binary], check=True, timeout=60)
    if inline:
        command = ["spirv-opt", "--inline-entry-points-exhaustive", "-O", binary, "-o", binary]
        subprocess.run(command, check=True, timeout=60)
    return binary.read_bytes()

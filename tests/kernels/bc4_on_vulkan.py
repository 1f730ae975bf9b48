"""Decodes BC4_SNORM blocks by a Vulkan device's texture unit: `python -m tests.kernels.bc4_on_vulkan IN.npy OUT.npy`.

IN holds (rows, columns, 8) uint8 blocks, OUT receives the texels, (4·rows, 4·columns) float32 in [−1, 1]. A process of
its own, because a driver may hang or crash; the exit code is that of tests/export/wgpu_host.py.
"""

import sys

import numpy as np

from tests.export.wgpu_host import device

SHADER = """
@group(0) @binding(0) var texels: texture_2d<f32>;
@group(0) @binding(1) var<storage, read_write> values: array<f32>;
@compute @workgroup_size(8, 8) fn main(@builtin(global_invocation_id) at: vec3<u32>) {
    let size = textureDimensions(texels);
    if (all(at.xy < size)) { values[at.y * size.x + at.x] = textureLoad(texels, at.xy, 0).x; }
}
"""


def decode(gpu, blocks: np.ndarray) -> np.ndarray:
    """Return the texels that ``gpu`` reads from a texture of ``blocks``."""
    import wgpu

    height, width = 4 * blocks.shape[0], 4 * blocks.shape[1]
    usage = wgpu.TextureUsage.COPY_DST | wgpu.TextureUsage.TEXTURE_BINDING
    texture = gpu.create_texture(size=(width, height, 1), format="bc4-r-snorm", usage=usage)
    rule = {"bytes_per_row": 8 * blocks.shape[1], "rows_per_image": blocks.shape[0]}
    gpu.queue.write_texture({"texture": texture}, blocks.tobytes(), rule, (width, height, 1))
    values = gpu.create_buffer(size=4 * width * height, usage=wgpu.BufferUsage.STORAGE | wgpu.BufferUsage.COPY_SRC)
    program = {"module": gpu.create_shader_module(code=SHADER), "entry_point": "main"}
    pipeline = gpu.create_compute_pipeline(layout="auto", compute=program)
    bound = [{"binding": 0, "resource": texture.create_view()}, {"binding": 1, "resource": {"buffer": values}}]
    group = gpu.create_bind_group(layout=pipeline.get_bind_group_layout(0), entries=bound)
    encoder = gpu.create_command_encoder()
    work = encoder.begin_compute_pass()
    work.set_pipeline(pipeline)
    work.set_bind_group(0, group)
    work.dispatch_workgroups(-(-width // 8), -(-height // 8))
    work.end()
    gpu.queue.submit([encoder.finish()])
    return np.frombuffer(gpu.queue.read_buffer(values), np.float32).reshape(height, width)


if __name__ == "__main__":
    np.save(sys.argv[2], decode(device(), np.load(sys.argv[1])))

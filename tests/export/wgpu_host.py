"""Runs compute shaders over BC6H textures on a Vulkan device, in a process of its own: `python wgpu_host.py DIR`.

Every DIR/*.npz is a job: ``shader`` (WGSL text, or SPIR-V words as uint32), ``texture{t}.mip{m}`` blocks, ``sizes``
(T, 3) of width, height and mips, ``signed``, ``wrap``, ``weights`` (bytes), ``queries`` (n, 4) float32, and ``floats``,
how many numbers the shader writes per query; they go to DIR/NAME.npy, [n, floats]. Bindings of group 0: textures
0 … T−1, the sampler T, weights T + 1, queries T + 2, results T + 3. A job without queries is only compiled.
Exit code 77: there is no Vulkan device that reads BC textures; the reason is printed. A process of its own, because a
driver may hang or crash.
"""

import sys
from pathlib import Path

import numpy as np

MISSING = 77
ADDRESS = {"repeat": "repeat", "clamp": "clamp-to-edge", "mirror": "mirror-repeat"}


def device():
    """Return a device with BC textures, or exit."""
    try:
        import wgpu
    except ImportError as error:
        print(f"wgpu is not installed ({error})")
        sys.exit(MISSING)
    adapters = [a for a in wgpu.gpu.enumerate_adapters_sync() if a.info["backend_type"] == "Vulkan"]
    adapters = [a for a in adapters if "texture-compression-bc" in a.features]
    if not adapters:
        print("no Vulkan device with texture-compression-bc; install mesa-vulkan-drivers")
        sys.exit(MISSING)
    # A software device first: it filters in float32, and is the same one everywhere.
    adapters.sort(key=lambda a: a.info["adapter_type"] != "CPU")
    print(adapters[0].info["adapter_type"], adapters[0].info["device"])
    return adapters[0].request_device_sync(required_features=["texture-compression-bc"])


def texture(gpu, job, t: int):
    """Upload texture ``t`` with its mips, block by block, and return a view of it."""
    import wgpu

    width, height, mips = map(int, job["sizes"][t])
    format = "bc6h-rgb-float" if job["signed"] else "bc6h-rgb-ufloat"
    usage = wgpu.TextureUsage.COPY_DST | wgpu.TextureUsage.TEXTURE_BINDING
    made = gpu.create_texture(size=(width, height, 1), mip_level_count=mips, format=format, usage=usage)
    for mip in range(mips):
        blocks = np.ascontiguousarray(job[f"texture{t}.mip{mip}"])
        rows, columns = blocks.shape[:2]
        place = {"texture": made, "mip_level": mip, "origin": (0, 0, 0)}
        rule = {"bytes_per_row": 16 * columns, "rows_per_image": rows}
        gpu.queue.write_texture(place, blocks, rule, (4 * columns, 4 * rows, 1))
    return made.create_view()


def run(gpu, job) -> np.ndarray:
    """Return what the shader wrote, shape [n, floats]."""
    import wgpu

    code = job["shader"]
    shader = gpu.create_shader_module(code=code.tobytes() if code.dtype == np.uint32 else str(code))
    if "queries" not in job:
        return np.zeros((0, 0), np.float32)
    count, floats, total = len(job["queries"]), int(job["floats"]), len(job["sizes"])
    mode = ADDRESS[str(job["wrap"])]
    sampler = gpu.create_sampler(
        address_mode_u=mode, address_mode_v=mode, mag_filter="linear", min_filter="linear", mipmap_filter="linear"
    )
    storage = wgpu.BufferUsage.STORAGE
    weights = gpu.create_buffer_with_data(data=job["weights"].tobytes(), usage=storage)
    queries = gpu.create_buffer_with_data(data=job["queries"].astype(np.float32).tobytes(), usage=storage)
    results = gpu.create_buffer(size=4 * count * floats, usage=storage | wgpu.BufferUsage.COPY_SRC)
    bound = [texture(gpu, job, t) for t in range(total)] + [sampler]
    bound += [{"buffer": b, "offset": 0, "size": b.size} for b in (weights, queries, results)]
    kinds = [{"texture": {"sample_type": "float"}}] * total + [{"sampler": {"type": "filtering"}}]
    kinds += [{"buffer": {"type": "read-only-storage"}}] * 2 + [{"buffer": {"type": "storage"}}]
    entries = [{"binding": n, "visibility": wgpu.ShaderStage.COMPUTE, **kind} for n, kind in enumerate(kinds)]
    shape = gpu.create_bind_group_layout(entries=entries)
    group = gpu.create_bind_group(
        layout=shape, entries=[{"binding": n, "resource": resource} for n, resource in enumerate(bound)]
    )
    layout = gpu.create_pipeline_layout(bind_group_layouts=[shape])
    pipeline = gpu.create_compute_pipeline(layout=layout, compute={"module": shader, "entry_point": "main"})
    commands = gpu.create_command_encoder()
    work = commands.begin_compute_pass()
    work.set_pipeline(pipeline)
    work.set_bind_group(0, group)
    work.dispatch_workgroups(-(-count // 64))
    work.end()
    gpu.queue.submit([commands.finish()])
    return np.frombuffer(gpu.queue.read_buffer(results), np.float32).reshape(count, floats)


if __name__ == "__main__":
    gpu = device()
    for path in sorted(Path(sys.argv[1]).glob("*.npz")):
        with np.load(path) as job:
            np.save(path.with_suffix(".npy"), run(gpu, job))

"""Renders mesh sequences with fitted materials, shading in texture space and reusing it over frames (MobileVR §4.2).

A frame passes the stages ``pose`` (animation and upload), ``visibility`` (camera raster), ``mark`` (which texels the
picture will read), ``list`` (compaction into 2×2 quads by material), ``shade``, and ``gather`` (the picture from the
radiance texture). With interval N, every (N + 1)th frame starts a new epoch: it freezes pose, viewer and lights, and
all that is seen from then on is shaded as of that frame, when it is first seen. So the radiance texture is the
paper's, evaluated lazily: what comes into view within an epoch is neither a hole nor newer than its neighbours.

In stereo, all that holds for each of two eyes (``pipeline/stereo.py``).

In screen space, the same shading kernel runs on the camera raster itself, every pixel of every frame: the reference.
"""

import copy
import dataclasses
import math
import numbers
from collections.abc import Iterable, Iterator

import numpy as np
import warp as wp

from warp_neumat.kernels.tiles import TILE
from warp_neumat.materials.proxy import proxy_of
from warp_neumat.pipeline.atlas import Atlas, AtlasLayout
from warp_neumat.pipeline.camera import CameraPath, bounding_sphere, load_camera
from warp_neumat.pipeline.clock import Clock
from warp_neumat.pipeline.lights import PointLights, lights_from
from warp_neumat.pipeline.look import Look
from warp_neumat.pipeline.policy import POLICIES, Policy, make_policy
from warp_neumat.pipeline.sequence import MeshSequence
from warp_neumat.pipeline.sheet import Sheet, StreamedSheet, sheet_lod
from warp_neumat.pipeline.skips import SKIPS, Skips
from warp_neumat.pipeline.stereo import SharedStereoView, eye_distance_of, screen_stereo, texture_stereo
from warp_neumat.pipeline.surface_mesh import SurfaceMesh, bind_materials, map_sizes, open_materials
from warp_neumat.pipeline.tonemap import OPERATORS
from warp_neumat.pipeline.view import ScreenView, TextureView

__all__ = ["POLICIES", "SIDE_MAX", "SKIPS", "RenderedFrame", "Renderer"]

SIDE_MAX = 16384
"""Largest side of a picture or an atlas [px]: a quad's word holds 13 bits for its column and 13 for its row."""


@dataclasses.dataclass(frozen=True)
class RenderedFrame:
    """One picture and what it took.

    Attributes:
        index: Frame number in the sequence.
        image: Linear Rec. 709 radiance, shape (H, W, 3), float32, row 0 on top; in stereo the left eye's.
        stats: ``ms`` per stage, ``texels`` (owned; facing the viewer of the last update, or two-sided; seen; shaded),
            ``evaluations`` (material × light), ``updated`` (whether the frame started a new epoch). In stereo they
            are sums over both eyes, ``eyes`` has each one's own, and ``shared``, if tiles may be, theirs.
        right: The right eye's picture, likewise; None without stereo.
    """

    index: int
    image: np.ndarray
    stats: dict
    right: np.ndarray | None = None

    @property
    def eyes(self) -> tuple[np.ndarray, ...]:
        """The pictures: left and right, or the only one."""
        return (self.image,) if self.right is None else (self.image, self.right)


class Renderer:
    """Renders frames of a mesh sequence.

    Args:
        sequence: The mesh sequence, or its path.
        materials: Name or glob of meshes, nodes or materials → :class:`Material` or path of an asset.
        space: ``"texture"`` shades the atlas and reuses it; ``"screen"`` shades every pixel of every frame.
        atlas: The atlas, or its resolution [texel]; unused in screen space.
        resident: Side of the sheet [texel] that charts stream onto when they are seen, a multiple of 8; ``atlas`` then
            says how large they are at most, and is never rasterised. Default: the whole atlas is held.
        size: (width, height) of the pictures [px].
        camera: A camera path, ``"orbit"``, or the path of a camera file.
        lights: The lights, a number of default ones, or the path of a lights file.
        frame_count: Length of the shot, which orbits and default paths are spread over; default: the sequence's.
        policy: When tiles of the atlas are shaded anew, of :data:`POLICIES`, or a :class:`Policy`.
        interval: Frames that reuse the shading of the one before them; 0 shades every frame. For ``staggered`` and
            ``adaptive`` the measure of their default budgets.
        budget: Evaluations that a frame may spend.
        milliseconds: Milliseconds of shading that a frame may spend.
        target_flip: Mean FLIP that ``adaptive`` aims for, against per-pixel shading.
        carry: Whether stale radiance is carried to the present by the materials' proxies (``kernels/carry.py``);
            default: by ``adaptive`` alone.
        skip: Which of :data:`SKIPS` are in force.
        gain: What radiance is multiplied by before it is shown, 2^exposure: what counts as a visible change.
        tonemap: How the pictures will be shown, as :func:`warp_neumat.tonemap` names it: what ``target_flip`` compares.
        background: Radiance where nothing is seen, 3 values.
        seed: Decides which of equal tiles comes first.
        stereo: Whether to render two eyes, to the left and the right of the camera (``pipeline/stereo.py``).
        eye_distance: Between them [scene unit]; default: a thirtieth of the first camera's distance to the scene.
        share: Difference between the eyes [√Y as shown] up to which a tile is shaded once for both; default: none is.
        device: Warp device.
        progress: Passed to :meth:`Atlas.build`.

    Raises:
        ValueError, OSError, FormatError: As the parts it is made of; each message is one line.
    """

    def __init__(
        self,
        sequence,
        materials: dict,
        *,
        space: str = "texture",
        atlas: Atlas | int = 1200,
        resident: int | None = None,
        size: tuple[int, int] = (1280, 720),
        camera: CameraPath | str = "orbit",
        lights: PointLights | int | str = 3,
        frame_count: int | None = None,
        policy: Policy | str = "adaptive",
        interval: int = 4,
        budget: float | None = None,
        milliseconds: float | None = None,
        target_flip: float | None = None,
        carry: bool | None = None,
        skip: Iterable[str] = SKIPS,
        gain: float = 1.0,
        tonemap: str = "srgb",
        background=(0.0, 0.0, 0.0),
        seed: int = 0,
        stereo: bool = False,
        eye_distance: float | None = None,
        share: float | None = None,
        device=None,
        progress=None,
    ):
        if space not in ("texture", "screen"):
            raise ValueError(f'space must be "texture" or "screen", got {space!r}')
        if not all(1 <= side <= SIDE_MAX for side in size):
            raise ValueError(f"size must be 1 to {SIDE_MAX} pixels each way, got {size[0]}x{size[1]}")
        for name, value in (("eye_distance", eye_distance), ("share", share)):
            if value is not None and not stereo:
                raise ValueError(f"{name} takes two eyes; give stereo too")
        if share is not None and not 0 <= share <= 1:
            raise ValueError(f"share must be a difference in [0, 1], got {share!r}")
        if share is not None and space == "screen":
            raise ValueError('share takes textures; leave it out, or use space="texture"')
        if share is not None and getattr(policy, "target", target_flip) is not None:
            raise ValueError("share and target_flip exclude each other; give a budget")
        limits = {"budget": budget, "milliseconds": milliseconds, "target_flip": target_flip}
        limits = {name: value for name, value in limits.items() if value is not None}
        only_texture = [*limits, *(n for n, v in (("resident", resident), ("carry", carry)) if v is not None)]
        if only_texture and space == "screen":
            raise ValueError(f'{only_texture[0]} is for textures; leave it out, or use space="texture"')
        skips = Skips.named(skip)
        if isinstance(policy, Policy):
            if limits:
                raise ValueError(f"{next(iter(limits))} is for policies by name; give it to the policy itself")
            policy = copy.deepcopy(policy)  # it learns, and others may use it too
        else:
            policy = make_policy(policy, interval, **limits)
        carried = policy.predicts if carry is None else bool(carry)
        if carried and policy.holds_pose:
            raise ValueError(f"{policy.name} shows an old pose's light; carry goes with every, staggered and adaptive")
        if resident is not None and not (16 <= resident <= SIDE_MAX and resident % TILE == 0):
            raise ValueError(f"resident must be a multiple of {TILE} in 16 … {SIDE_MAX} texels, got {resident!r}")
        if not 0 < gain < math.inf:
            raise ValueError(f"gain must be a positive number, got {gain!r}")
        if not isinstance(seed, numbers.Integral) or seed < 0:
            raise ValueError(f"seed must be a whole number of at least 0, got {seed!r}")
        if len(background) != 3:
            raise ValueError(f"background must be three values, got {len(background)}")
        if tonemap not in OPERATORS:
            raise ValueError(f"tonemap must be one of {', '.join(OPERATORS)}, got {tonemap!r}")
        self.device, self.space, self.policy = wp.get_device(device), space, policy
        self.sequence = sequence if isinstance(sequence, MeshSequence) else MeshSequence.load(sequence)
        self.assigned = open_materials(materials, device=self.device)
        self.materials, face_material = bind_materials(self.sequence, self.assigned)
        self.width, self.height = int(size[0]), int(size[1])
        frame_count = frame_count or self.sequence.frame_count
        lo, hi = self.sequence.bounds()
        if not isinstance(camera, CameraPath):
            picture = {"width": self.width, "height": self.height, "outline": self.sequence.outline()}
            camera = load_camera(camera, lo, hi, frame_count, **picture)
        first = camera.at(0)
        if (first.width, first.height) != (self.width, self.height):
            raise ValueError(
                f"camera must be made for {self.width}x{self.height} pixels, got {first.width}x{first.height}"
            )
        self.camera, self.stereo = camera, bool(stereo)
        self.eye_distance = eye_distance_of(eye_distance, first, *bounding_sphere(lo, hi)) if stereo else None
        self.lights = lights if isinstance(lights, PointLights) else lights_from(lights, lo, hi, frame_count)
        self.background, self.gain, self.tonemap = tuple(float(c) for c in background), float(gain), tonemap

        map_size = map_sizes(self.sequence, face_material, self.materials)
        self.mesh = SurfaceMesh(self.sequence, face_material, map_size, device=self.device)
        look = Look(
            self.mesh,
            self.materials,
            len(self.lights),
            (self.width, self.height),
            wp.vec3(*self.background),
            self.gain,
            skips,
            tonemap,
        )
        self._pose = 0  # counts the poses shown
        if space == "screen":
            self.atlas = None
            self.view = screen_stereo(look, 0.5 * self.eye_distance) if stereo else ScreenView(look)
            return
        if not isinstance(atlas, (Atlas, AtlasLayout)):
            make = Atlas.build if resident is None else Atlas.layout
            atlas = make(self.sequence, atlas, progress=progress, device=self.device)
        if isinstance(atlas, AtlasLayout) and resident is None:
            raise ValueError("atlas is a layout without texels; give resident, the side of the sheet to stream onto")
        if len(atlas.corner_uv) != len(self.sequence.faces):
            raise ValueError(
                f"atlas must be built for this sequence of {len(self.sequence.faces)} faces, "
                f"got one of {len(atlas.corner_uv)}; use Atlas.build"
            )
        self.atlas = atlas
        needed = carried or policy.predicts
        proxies = [proxy_of(m) for m in self.materials] if needed or share is not None else None
        lod = sheet_lod(atlas, self.sequence, map_size)

        def sheet():
            if resident is None:
                return Sheet(atlas, face_material, lod, unowned_too=not skips.unowned, device=self.device)
            return StreamedSheet(atlas, resident, face_material, lod, device=self.device)

        more = {"carried": carried, "seed": seed}
        if not stereo:
            self.view = TextureView(look, sheet(), policy, proxies, **more)
        elif share is None:
            left = sheet()
            sheets = (left, left if resident is None else sheet())
            self.view = texture_stereo(look, sheets, policy, proxies, 0.5 * self.eye_distance, **more)
        else:
            self.view = SharedStereoView(look, sheet(), policy, proxies, 0.5 * self.eye_distance, float(share), **more)

    def per_pixel(self) -> "Renderer":
        """Return a renderer of the same shot that shades every pixel of every frame: the reference for this one.

        It has as many eyes as this one.
        """
        return Renderer(
            self.sequence,
            self.assigned,
            space="screen",
            size=(self.width, self.height),
            camera=self.camera,
            lights=self.lights,
            background=self.background,
            gain=self.gain,
            tonemap=self.tonemap,
            stereo=self.stereo,
            eye_distance=self.eye_distance,
            device=self.device,
        )

    def render(self, frames: Iterable[int] | None = None) -> Iterator[RenderedFrame]:
        """Yield the pictures of ``frames`` (default: the whole sequence), in order.

        The first frame shades anew all that it sees.
        """
        self.restart()
        for index in range(self.sequence.frame_count) if frames is None else frames:
            frame = self.frame(index)
            right = None if frame.right is None else frame.right.copy()
            yield dataclasses.replace(frame, image=frame.image.copy(), right=right)

    def restart(self) -> None:
        """Make the next frame start a new epoch, as the first one does."""
        if self.space == "texture":
            self.view.restart()

    def frame(self, index: int) -> RenderedFrame:
        """Render frame ``index`` as the next picture.

        Its image is read-only and is overwritten by the next frame; :meth:`render` hands out copies.
        """
        clock = Clock(self.device)
        camera, lights = self.camera.at(index), self.lights.at(index)
        self._pose += self.mesh.show(index)
        if self.space == "screen":
            self.mesh.freeze()
            stats = self.view.render(camera, lights, clock)
        else:
            if self.view.begins_epoch() or not self.policy.holds_pose:
                self.mesh.freeze()
            stats = self.view.render(camera, lights, self._pose, clock)
        right = self.view.right.image if self.stereo else None
        return RenderedFrame(index, self.view.image, {"ms": clock.ms, **stats}, right)

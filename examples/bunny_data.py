"""Makes what examples/bunny.toml asks for: a mesh with texture coordinates, photographs, and something to start from.

The mesh is the Stanford bunny (Stanford 3D Scanning Repository) that the warp-lang wheel carries as an example asset;
it is read from there and unwrapped by xatlas. What is painted on it and the light around it are formulas of this file.

The fit is given ``bunny.ply``, ``view_0.exr`` to ``view_7.exr`` and the flat grey ``*_start.exr``, not the files that
end in ``_truth``. All of it lies in one folder, since a scene file names only what lies beside or below it.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import usd_crate

import warp_psdr as psdr
from warp_psdr import image_io
from warp_psdr.progress import progress

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "out" / "bunny"
SCENE = "bunny_relight.xml"
#: Cameras whose images the fit is given, and cameras that are kept to judge the result.
GIVEN, KEPT = tuple(range(8)), (8, 9)
#: Texels along a side of the painted texture and of the one that is recovered, and (height, width) of the environment.
PAINTED, RECOVERED, ENVIRONMENT = 256, 128, (16, 32)
#: Empty texels between two charts of the atlas, so that none of them blends into another.
PADDING = 2
#: What the recovery starts from: one grey everywhere.
GREY_ALBEDO, GREY_LIGHT = 0.5, 0.5
#: Samples a pixel of the photographs, and the first of their seeds. No step of the fit uses these seeds.
PHOTO_SPP, PHOTO_SEED = 128, 2**32 - 1000


def read_bunny() -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (N, 3) and triangles (M, 3) of the bunny in the warp-lang wheel."""
    import warp

    file = usd_crate.Crate(Path(warp.__file__).parent / "examples" / "assets" / "bunny.usd")
    return (
        file.array("/root/bunny.points", np.float32, 3),
        file.array("/root/bunny.faceVertexIndices", np.uint32, 3),
    )


def unwrap(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut a mesh into charts and return which old vertex each new one is, the triangles, and texture coordinates."""
    import xatlas

    atlas = xatlas.Atlas()
    atlas.add_mesh(vertices, faces)
    packing = xatlas.PackOptions()
    packing.resolution, packing.padding, packing.bilinear = RECOVERED, PADDING, True
    atlas.generate(pack_options=packing)
    return atlas[0]


def write_ply(file: Path, vertices: np.ndarray, normals: np.ndarray, uvs: np.ndarray, faces: np.ndarray) -> None:
    """Write a binary PLY with normals and texture coordinates."""
    names = ("x", "y", "z", "nx", "ny", "nz", "u", "v")
    header = [
        "ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}",
        *(f"property float {name}" for name in names),
        f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", "",
    ]  # fmt: skip
    rows = np.empty(len(faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, faces
    columns = np.concatenate([vertices, normals, uvs], axis=1).astype("<f4")
    file.write_bytes("\n".join(header).encode() + columns.tobytes() + rows.tobytes())


def bake(vertices: np.ndarray, uvs: np.ndarray, faces: np.ndarray, size: int, paint: Callable) -> np.ndarray:
    """Return a texture (size, size, 3) of what ``paint`` says about the surface point that each texel shows.

    Texels between the charts show the nearest point of a chart, so that a blend across its border stays in colour.
    """
    from scipy.spatial import cKDTree

    steps = 7  # a grid of points on every triangle, denser than the texels
    a, b = (x.reshape(-1) for x in np.mgrid[0 : steps + 1, 0 : steps + 1] / steps)
    weights = np.stack([a, b, 1.0 - a - b], axis=1)[a + b <= 1.0 + 1e-9]
    at, points = (np.einsum("kc,fcd->fkd", weights, x[faces]).reshape(-1, x.shape[1]) for x in (uvs, vertices))
    v, u = (np.mgrid[0:size, 0:size] + 0.5) / size
    nearest = cKDTree(at).query(np.stack([u, v], axis=-1).reshape(-1, 2))[1]
    return paint(points[nearest]).reshape(size, size, 3).astype(np.float32)


def paint(points: np.ndarray) -> np.ndarray:
    """Return the albedo (..., 3) at surface points (..., 3): bands and dots in four glazes."""
    x, y, z = np.moveaxis(points.astype(np.float64), -1, 0)
    smooth = lambda t, width: 0.5 + 0.5 * np.tanh(t / width)  # noqa: E731
    bands = smooth(np.sin(9.0 * y + 2.0 * np.sin(3.0 * x) + 1.5 * np.sin(4.0 * z)), 0.25)[..., None]
    dots = smooth(np.sin(13.0 * x) * np.sin(13.0 * y) * np.sin(13.0 * z) - 0.25, 0.08)[..., None]
    high = smooth(y - 1.12, 0.05)[..., None]
    cream, blue, rust, teal = np.array([[0.82, 0.74, 0.58], [0.10, 0.17, 0.48], [0.70, 0.20, 0.08], [0.08, 0.45, 0.40]])
    body = cream * (1.0 - bands) + (blue * (1.0 - high) + teal * high) * bands
    return body * (1.0 - dots) + rust * dots


def sky(height: int, width: int) -> np.ndarray:
    """Return an environment (height, width, 3), up first: an evening sky, a soft sun, a lamp, and dark ground."""
    theta = (np.arange(height) + 0.5) / height * np.pi
    phi = (np.arange(width) + 0.5) / width * 2.0 * np.pi
    theta, phi = (x[..., None] for x in np.meshgrid(theta, phi, indexing="ij"))
    direction = np.concatenate([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], axis=-1)
    up = direction[..., 1:2]
    horizon = np.exp(-((up / 0.25) ** 2))
    light = np.where(up > 0.0, [0.16, 0.30, 0.62], [0.10, 0.08, 0.06]) + horizon * np.array([0.55, 0.32, 0.18])
    for toward, sharpness, color in (
        ((0.6, 0.7, 0.5), 30.0, (9.0, 7.2, 4.6)),
        ((-0.9, 0.35, -0.3), 18.0, (0.5, 1.4, 2.4)),
    ):
        cosine = direction @ (np.array(toward) / np.linalg.norm(toward))
        light += np.exp(sharpness * (cosine[..., None] - 1.0)) * np.array(color)
    return light.astype(np.float32)


def write_data(folder: Path = FOLDER, spp: int = PHOTO_SPP) -> None:
    """Write everything into ``folder``."""
    from warp_psdr.scene.shapes.meshes import vertex_normals

    folder.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(ROOT / "scenes" / SCENE, folder / SCENE)
    vertices, faces = read_bunny()
    normals = vertex_normals(vertices, faces)  # before the cuts, which would show in the shading
    source, faces, uvs = unwrap(vertices, faces)
    write_ply(folder / "bunny.ply", vertices[source], normals[source], uvs, faces)
    image_io.write_image(folder / "albedo_truth.exr", bake(vertices[source], uvs, faces, PAINTED, paint))
    image_io.write_image(folder / "environment_truth.exr", sky(*ENVIRONMENT))
    image_io.write_image(folder / "albedo_start.exr", np.full((RECOVERED, RECOVERED, 3), GREY_ALBEDO, np.float32))
    image_io.write_image(folder / "environment_start.exr", np.full((*ENVIRONMENT, 3), GREY_LIGHT, np.float32))
    for camera, image in photographs(folder, GIVEN, spp, PHOTO_SEED).items():
        image_io.write_image(folder / f"view_{camera}.exr", image)


def load_truth(folder: Path, **size: int) -> psdr.Scene:
    """Return the scene with what is to be found; ``size`` may be its width and height."""
    return psdr.load_file(folder / SCENE, albedo="albedo_truth.exr", environment="environment_truth.exr", **size)


def photographs(
    folder: Path, cameras: tuple[int, ...], spp: int, seed: int, title: str = "photographs", **size: int
) -> dict[int, np.ndarray]:
    """Return noisy images of the truth by camera, each with its own seed."""
    return render_views(load_truth(folder, **size), cameras, spp, seed, title)


def render_views(scene: psdr.Scene, cameras: tuple[int, ...], spp: int, seed: int, title: str) -> dict[int, np.ndarray]:
    """Return images of a scene by camera, each with its own seed, behind a bar."""
    images = {}
    with progress(title, len(cameras)) as report:
        for done, camera in enumerate(cameras, start=1):
            images[camera] = psdr.render(scene, sensor=camera, spp=spp, seed=seed + camera).numpy()
            report(done, "")
    return images


if __name__ == "__main__":
    write_data()
    print(f"wrote {FOLDER}")

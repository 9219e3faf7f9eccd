"""The shadow edge of a moving mesh: this renderer, unguided and guided, against Mitsuba 3's ``direct_projective``.

    python examples/benchmarks/boundary_soft_shadow.py [--quick] [--output results.jsonl]

A sphere of 32,512 triangles between a floor and a small area light moves; the camera sees the floor with its shadow and
not the sphere. So the derivative image has no other term than the secondary boundary's, in both renderers. Errors are
those of the derivative image, relative to its root mean square, against a long image of the same renderer, ours guided
with seeds of its own. The long images are compared with each other, and with an unguided one of ours. The time to a
given error follows from error^2 ~ 1 / time. A guided first call includes the building of its structure; later ones, at
the same or a nearby scene, use it again. Mitsuba builds its own in every call.
"""

import tempfile
from pathlib import Path

import numpy as np
from boundary_renderers import Ours, Theirs, long_image, measure
from common import Report, arguments, import_mitsuba, psdr

from scenes import write_ply

#: Rings and columns of the sphere: 2 * 128 * 127 triangles.
RINGS = 128
DIRECTION = (1.0, 0.2, 0.3)
SPHERE = "sphere.vertex_positions"
XML = """<scene version="3.0.0">
    <default name="resolution" value="128"/>
    <sensor type="perspective"><float name="fov" value="40"/><transform name="to_world">
        <lookat origin="-1.5, -2.5, 1.6" target="-0.5, 0.1, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="$resolution"/><integer name="height" value="$resolution"/>
        <rfilter type="box"/></film></sensor>
    <shape type="rectangle" id="floor"><transform name="to_world"><scale value="4"/></transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.7"/></bsdf></shape>
    <shape type="ply" id="sphere"><string name="filename" value="sphere.ply"/>
        <boolean name="face_normals" value="true"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf></shape>
    <shape type="rectangle" id="light"><transform name="to_world"><scale value="0.2"/><rotate x="1" angle="180"/>
        <translate x="1.2" y="-0.6" z="3.5"/></transform>
        <emitter type="area"><rgb name="radiance" value="30"/></emitter></shape>
</scene>
"""


def write_scene(folder: Path) -> Path:
    """Write the scene file and its mesh."""
    theta = np.linspace(0.0, np.pi, RINGS + 1)[1:-1, None]
    phi = np.linspace(0.0, 2.0 * np.pi, RINGS, endpoint=False)[None]
    rings = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0.0 * phi], -1)
    vertices = np.concatenate([rings.reshape(-1, 3), [[0, 0, 1], [0, 0, -1]]])
    i, j = np.mgrid[0 : RINGS - 2, 0:RINGS].reshape(2, -1)
    a, b = i * RINGS + j, i * RINGS + (j + 1) % RINGS
    k = np.arange(RINGS)
    after, last, top = (k + 1) % RINGS, (RINGS - 2) * RINGS, len(vertices) - 2
    quads = [np.stack([a, a + RINGS, b], 1), np.stack([b, a + RINGS, b + RINGS], 1)]
    caps = [
        np.stack([np.full(RINGS, top), k, after], 1),
        np.stack([np.full(RINGS, top + 1), last + after, last + k], 1),
    ]
    write_ply(folder / "sphere.ply", 0.4 * vertices + [0.2, 0.0, 1.5], np.concatenate([*quads, *caps]))
    file = folder / "soft_shadow.xml"
    file.write_text(XML)
    return file


def main() -> None:
    """Run and print the tables."""
    parser = arguments(__doc__)
    parser.add_argument("--without-mitsuba", action="store_true", help="our own variants alone")
    options = parser.parse_args()
    repeat = options.repeat or (5 if options.quick else 7)
    resolution, long = (64, 512) if options.quick else (128, 4096)
    psdr.set_workers(options.threads)
    mi, dr = (None, None) if options.without_mitsuba else import_mitsuba(options.threads)
    report = Report("soft shadow of a moving mesh", options.output)
    rows = []
    with tempfile.TemporaryDirectory() as name:
        file = write_scene(Path(name))

        def ours(guiding):
            return Ours(file, resolution, SPHERE, DIRECTION, guiding, depth=2, all_terms=False)

        def theirs_of(guiding):
            # Indirect boundary samples only.
            options = {"type": "direct_projective", "sppc": 0, "sppp": 0, "sppi": None, "guiding": guiding}
            return Theirs(mi, dr, file, resolution, SPHERE, DIRECTION, options)

        reference = long_image(ours(psdr.guiding.KdTree()), long)
        plain = long_image(ours(None), long)
        slopes = {"ours, unguided": float((plain * reference).sum() / (reference * reference).sum())}
        variants = {
            "unguided": (None, 64, False),
            "KdTree": (psdr.guiding.KdTree(), 16, False),
            "KdTree, first call": (psdr.guiding.KdTree(), 16, True),
            "Octree": (psdr.guiding.Octree(), 16, False),
            "Octree, first call": (psdr.guiding.Octree(), 16, True),
        }
        for label, (guiding, spp, first) in variants.items():
            row = measure(ours(guiding), spp, repeat, reference, first=first)
            rows.append({"method": label} | row)
        if mi is not None:
            theirs = long_image(theirs_of("none"), long)
            slopes["Mitsuba"] = float((theirs * reference).sum() / (reference * reference).sum())
            for guiding, spp in (("none", 64), ("octree", 16)):
                row = measure(theirs_of(guiding), spp, repeat, theirs, first=True)
                rows.append({"method": f"Mitsuba, {guiding}"} | row)
    report.table("long images: slope on ours, guided", [slopes])
    times = {row["method"]: row["error^2 x time"] for row in rows}
    base = times["Mitsuba, none"] if mi is not None else times["unguided"]
    for row in rows:
        row["gain"] = base / row["error^2 x time"]
    settings = f"{resolution}^2 pixels, medians of {repeat}, {options.threads} threads"
    report.table(f"derivative images, {settings}; gain over {'Mitsuba, none' if mi else 'unguided'}", rows)


if __name__ == "__main__":
    main()

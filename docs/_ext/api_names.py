"""The order of the API's page: public names by what people call them for, most called first."""

from __future__ import annotations

from collections.abc import Iterable

#: Heading -> names. A name that is not public is left out, and one that is in no group joins the last.
GROUPS: dict[str, tuple[str, ...]] = {
    "Load, edit, render": (
        *("load_file", "load_dict", "traverse", "render", "render_backward", "render_forward"),
        *("bind", "from_newton", "rollout"),
        *("PathIntegrator", "AovIntegrator", "Parameters", "Transform"),
    ),
    "Scenes": ("load_mesh", "preview_scene", "load_string", "cornell_box", "Scene", "SceneWarning"),
    "Plan and cost": (
        *("plan", "coverage", "accuracy", "certify", "certify_function", "compile", "methods"),
        *("Plan", "Coverage", "Certificate", "Compilation"),
    ),
    "Other images": ("render_aov", "render_parts", "render_moment", "Image", "Film"),
    "Photographs": ("Photograph", "Observation", "solve", "Solution"),
    "Pictures and files": ("view", "read_image", "write_image"),
    "More": (
        *("set_workers", "set_vector_width", "set_ray_backend", "invalid_samples", "trace_sample"),
        *("Trace", "BoundaryTrace"),
    ),
}
#: Public modules in the order of their sections.
MODULES = (
    *("losses", "optim", "unknowns", "torch", "fit", "distributed", "interior", "boundary", "guiding", "plots", "sdf"),
    *("cameras", "image_io", "scenes"),
)


def grouped(names: Iterable[str]) -> dict[str, list[str]]:
    """Return headings and the public names below each, every name once."""
    public = list(names)
    groups = {heading: [name for name in group if name in public] for heading, group in GROUPS.items()}
    groups[list(groups)[-1]] += [name for name in public if not any(name in group for group in GROUPS.values())]
    return groups

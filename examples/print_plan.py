"""Prints what a scene calls for, and what each request adds: nothing else is compiled or computed."""

from __future__ import annotations

from pathlib import Path

import warp_psdr as psdr

ROOT = Path(__file__).resolve().parents[1]
REQUESTS = ((), ("red.reflectance.value",), ("*.reflectance.value", "light.emitter.radiance.value"))


def main() -> None:
    scene = psdr.load_file(ROOT / "scenes" / "cornell_box.xml")
    params = psdr.traverse(scene)
    for names in REQUESTS:
        params.requires_grad_only(*names)
        print(f"gradient of {', '.join(names) or 'nothing'}:")
        print(psdr.plan(scene, params), end="\n\n")


if __name__ == "__main__":
    main()

"""Finds the colours of the Cornell box's walls with PyTorch's own optimiser; needs ``pip install torch``."""

from __future__ import annotations

from pathlib import Path

import torch

import warp_psdr as psdr

ROOT = Path(__file__).resolve().parents[1]
NAMES = ("red.reflectance.value", "green.reflectance.value")


def main(folder: Path = ROOT / "out" / "examples", resolution: int = 64, steps: int = 60, spp: int = 16) -> float:
    scene = psdr.load_file(ROOT / "scenes" / "cornell_box.xml", resolution=resolution)
    truth = {name: torch.from_numpy(psdr.traverse(scene)[name].numpy().copy()) for name in NAMES}
    target = psdr.torch.render(scene, truth, spp=16 * spp, seed=2**31)
    # A colour is a sigmoid of what is optimised, so that it stays between 0 and 1.
    folder.mkdir(parents=True, exist_ok=True)
    logits = {name: torch.zeros(3, requires_grad=True) for name in NAMES}
    optimizer = torch.optim.Adam(logits.values(), lr=0.15)
    images = [target]
    for step in range(steps):
        optimizer.zero_grad()
        image = psdr.torch.render(scene, {n: torch.sigmoid(x) for n, x in logits.items()}, spp=spp, seed=step)
        loss = (image - target).square().mean()
        loss.backward()
        optimizer.step()
        images = [target, images[1] if step else image.detach(), image.detach()]
    psdr.plots.side_by_side(
        folder / "torch_wall_color.png", images, ["target", "start", f"after {steps} steps"], columns=3
    )
    found = {name: torch.sigmoid(x).detach() for name, x in logits.items()}
    error = max(float((found[name] - truth[name]).abs().max()) for name in NAMES)
    print(f"largest error of a colour: {error:.3f}; wrote {folder / 'torch_wall_color.png'}")
    return error


if __name__ == "__main__":
    main()

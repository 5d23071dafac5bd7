"""Measure one device in Mpaths/s and Mrays/s, by tensors and by kernels: ``python scripts/bench_device.py [cpu|cuda]``."""

from __future__ import annotations

import sys

import torch

import torchpt
from torchpt.rendering.api import render_scene
from torchpt.scene.formats.description import settings


def main(device: str) -> None:
    """Print a line for each scene, size and mode."""
    print(torch.__version__, torch.cuda.get_device_name() if device == "cuda" else "cpu")
    for name in ("cornell_box", "cornell_bunny"):
        for side, spp in ((256, 64), (1024, 64)):
            for mode in ("off", "on") if device == "cpu" else ("off",):
                scene = torchpt.load(name, device)
                film = {"width": side, "height": side, "filter": "box"}
                wish = {"film": film, "render": {"spp": spp, "compile": mode}, "integrator": {"max_depth": 8}}
                complete = settings(scene.description, wish)
                render_scene(scene, complete)  # warm
                done = render_scene(scene, complete)
                rate = 1e-6 / done.render_seconds
                print(
                    f"{name} {side}^2 x {spp} compile={mode}: {done.render_seconds:.2f} s, {done.paths * rate:.2f} Mpaths/s, "
                    f"{done.rays * rate:.1f} Mrays/s, mean {float(done.image.mean()):.5f}, relmse {done.relmse:.2e}",
                    flush=True,
                )


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "cuda" if torch.cuda.is_available() else "cpu")
